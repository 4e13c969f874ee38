#!/bin/sh
# Makes a verified backup and forgets old ones. For cron, or as `docker compose run --rm backup`.
#   BACKUPS=/backups KEEP=14 deploy/backup/backup.sh
# The settings are the service's own (RSAVATAR_HOME, RSAVATAR_DATABASE_URL, ...). Exit status 0: made and read again.
set -eu
BACKUPS=${BACKUPS:?folder of the backups}
KEEP=${KEEP:-14}
PYTHON=${PYTHON:-python}

case $KEEP in *[!0-9]* | '' | 0) echo "KEEP: expected a number of at least 1, got '$KEEP'" >&2; exit 2 ;; esac
umask 077
mkdir -p "$BACKUPS"

"$PYTHON" -m services.backup create "$BACKUPS"

# Names sort by their time. Only whole backups count, so that failures never push a good one out.
whole=$(cd "$BACKUPS" && ls -d ????-??-??T??-??-??Z/manifest.json 2>/dev/null | sort -r)
oldest_kept=$(printf '%s\n' "$whole" | sed -n "${KEEP}p")
[ -n "$oldest_kept" ] || exit 0
oldest_kept=${oldest_kept%/manifest.json}
cd "$BACKUPS"
for folder in ????-??-??T??-??-??Z; do
    if [ "$(printf '%s\n%s\n' "$folder" "$oldest_kept" | sort | head -n 1)" != "$oldest_kept" ]; then
        rm -rf -- "$folder"
        echo "forgot $folder"
    fi
done

# Bytes that no manifest names any more.
named=$(mktemp)
trap 'rm -f "$named"' EXIT
cat ????-??-??T??-??-??Z/manifest.json | grep -oE '"[0-9a-f]{64}"' | tr -d '"' | sort -u > "$named"
[ -d pool ] || exit 0
find pool -type f ! -name '*.part' | while read -r file; do
    hash=$(printf '%s' "${file#pool/}" | tr -d /)
    grep -qxF "$hash" "$named" || rm -f -- "$file"
done
