#!/bin/sh
# Fills an empty home and an empty database from a backup, after reading every byte of it; then migrates.
#   deploy/backup/restore.sh /backups/2026-01-31T12-00-00Z
# Stop the API and the workers first. Nothing is overwritten: a database with tables is refused.
set -eu
FOLDER=${1:?folder of one backup}
PYTHON=${PYTHON:-python}

"$PYTHON" -m services.backup restore "$FOLDER"
"$PYTHON" -m services.migrate
