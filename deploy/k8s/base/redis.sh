#!/bin/sh
# Redis with the password of a secret, which stands in no command line that others see. `ping` = the health check.
set -eu
password=$(cat "${REDIS_PASSWORD_FILE:-/run/secrets/redis_password}")
if [ "${1:-}" = ping ]; then
    [ "$(REDISCLI_AUTH=$password redis-cli ping)" = PONG ]
    exit
fi
# EVAL stays allowed: priorities and pace limits are short scripts. What could read or end the server is not.
exec "${REDIS_SERVER:-redis-server}" - "$@" <<CONF
appendonly yes
appendfsync everysec
save ""
maxmemory 256mb
maxmemory-policy noeviction
user default reset resetchannels on >$password ~rsavatar:* &rsavatar:* +@all -@dangerous +info
CONF
