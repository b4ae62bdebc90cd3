#!/bin/sh
# Several processes over one PostgreSQL: killed and frozen at random (tests/cluster/kills.py, which takes the flags: --quick, --full, --seed N, --keep FOLDER,
# --store S3S_FS), and behind the proxy of deploy/ (tests/cluster/proxy.py).
#
# Needs ./target/release/uniground, Python 3, and Debian's postgresql and caddy.
set -eu
cd "$(dirname "$0")/.."
command -v caddy >/dev/null || { echo "caddy is missing: apt-get install caddy" >&2; exit 1; }
. scripts/postgres.sh
# Its log is read by other users than PostgreSQL's.
chmod 755 "$place"
for database in proxy kills; do createdb --maintenance-db "$server/postgres" $database; done
${PYTHON:-python3} tests/cluster/test_cluster_checks.py
${PYTHON:-python3} tests/cluster/proxy.py --program target/release/uniground --database "$server/proxy"
${PYTHON:-python3} tests/cluster/kills.py --program target/release/uniground --database "$server/kills" --log "$log" --stop "$stop" --start "$start" "$@"
