#!/bin/sh
# The tests of the whole service, with their rows in PostgreSQL instead of SQLite: a server of Debian's (postgresql) in a folder of its own, on
# a port the system picks. Left out is what is about SQLite's file itself (backups, old schemas, dry runs over a copy) and what uses no database.
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}

. scripts/postgres.sh

UNIGROUND_TEST_POSTGRES="$server" \
    $CARGO test --release --locked --quiet --test integration -- "$@" \
    --skip backups:: --skip upgrades:: --skip hurry::the_keepers --skip care::what_was_kept_long_enough --skip care::gc_wants \
    --skip chat_models:: --skip conventions:: --skip evaluation:: --skip layering:: --skip language:: --skip neural:: --skip openapi:: \
    --skip pages:: --skip real_models:: --skip shared_scenes:: --skip stage_one::

# A server of PostgreSQL's that goes away and comes back.
$CARGO build --release --locked --quiet
createdb --maintenance-db "$server/postgres" away
$PYTHON tests/cluster/away.py --program target/release/uniground --database "$server/away" --stop "$stop" --start "$start"
