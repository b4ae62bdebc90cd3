#!/bin/sh
# Several processes over one PostgreSQL, killed and stopped at random: tests/cluster/kills.py, with its flags (--full, --seed N, --blobs s3://…).
set -eu
cd "$(dirname "$0")/.."
. scripts/postgres.sh
createdb --maintenance-db "$server/postgres" cluster
chmod 755 "$place"
${PYTHON:-python3} tests/cluster/kills.py --program target/release/uniground --database "$server/cluster" --log "$log" "$@"
