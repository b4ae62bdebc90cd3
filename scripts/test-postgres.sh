#!/bin/sh
# The tests of the whole service, with their rows in PostgreSQL instead of SQLite: a server of Debian's (postgresql) in a folder of its own, on
# a port the system picks. Left out is what is about SQLite's file itself (backups, old schemas, dry runs over a copy) and what uses no database.
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}

PG_BIN=${PG_BIN:-$(ls -d /usr/lib/postgresql/*/bin 2>/dev/null | sort -V | tail -1)}
[ -x "$PG_BIN/initdb" ] || { echo "PostgreSQL is missing: apt-get install postgresql" >&2; exit 1; }
PATH=$PG_BIN:$PATH

place=$(mktemp -d)
# PostgreSQL does not run as root.
as=
if [ "$(id -u)" = 0 ]; then
    as="setpriv --reuid=postgres --regid=postgres --clear-groups"
    chown postgres "$place"
fi
PORT=$($PYTHON -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
options="-p $PORT -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c max_connections=400 -c fsync=off"
start="$as $PG_BIN/pg_ctl -D $place/data -w -l $place/log -o '$options' start"
stop="$as $PG_BIN/pg_ctl -D $place/data -m immediate stop"
clear() {
    sh -c "$stop" >/dev/null 2>&1 || true
    rm -rf "$place"
}
trap clear EXIT INT TERM

$as "$PG_BIN/initdb" -D "$place/data" -U uniground -A trust -E UTF8 --locale=C.UTF-8 --no-sync >/dev/null
sh -c "$start" >/dev/null
server="postgres://uniground@127.0.0.1:$PORT"

UNIGROUND_TEST_POSTGRES="$server" \
    $CARGO test --release --locked --quiet --test integration -- "$@" \
    --skip backups:: --skip upgrades:: --skip hurry::the_keepers --skip care::what_was_kept_long_enough --skip care::gc_wants \
    --skip chat_models:: --skip conventions:: --skip evaluation:: --skip layering:: --skip language:: --skip neural:: --skip openapi:: \
    --skip pages:: --skip real_models:: --skip shared_scenes:: --skip stage_one::

# A server of PostgreSQL's that goes away and comes back.
$CARGO build --release --locked --quiet
createdb --maintenance-db "$server/postgres" away
$PYTHON tests/cluster/away.py --program target/release/uniground --database "$server/away" --stop "$stop" --start "$start"
