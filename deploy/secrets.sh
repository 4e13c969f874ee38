#!/bin/sh
# Makes the passwords of docker-compose.yml, once: an existing file is left alone. The folder is for its owner alone; the
# files in it are readable, because the users of the containers have numbers of their own.
set -eu
cd "$(dirname "$0")"
umask 077
mkdir -p secrets
random() { LC_ALL=C tr -dc 'A-Za-z0-9' < /dev/urandom | head -c 40; }
make() { [ -e "secrets/$1" ] || { printf '%s\n' "$2" > "secrets/$1"; chmod 0644 "secrets/$1"; echo "made deploy/secrets/$1"; }; }

make postgres_password "$(random)"
make redis_password "$(random)"
make database_url "postgresql+psycopg://rsavatar:$(cat secrets/postgres_password)@postgres/rsavatar"
make broker_url "redis://:$(cat secrets/redis_password)@redis:6379/0"
# Empty until somebody has issued one: rsavatar token create prometheus --owner monitoring --scope read --days 0
make metrics_token ""
