# shellcheck shell=sh disable=SC2034,SC2012
# Sourced by scripts that need PostgreSQL: starts Debian's postgresql in a folder of its own on a free port, and stops it when the script ends.
# Sets $server, its URL; $log, its log; $start and $stop, commands that start and stop it.
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
PORT=$(${PYTHON:-python3} -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
options="-p $PORT -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c max_connections=400 -c fsync=off"
log=$place/log
start="$as $PG_BIN/pg_ctl -D $place/data -w -l $log -o '$options' start"
stop="$as $PG_BIN/pg_ctl -D $place/data -m immediate stop"
clear() {
    sh -c "$stop" >/dev/null 2>&1 || true
    rm -rf "$place"
}
trap clear EXIT INT TERM

$as "$PG_BIN/initdb" -D "$place/data" -U uniground -A trust -E UTF8 --locale=C.UTF-8 --no-sync >/dev/null
sh -c "$start" >/dev/null
server="postgres://uniground@127.0.0.1:$PORT"
