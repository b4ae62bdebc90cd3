#!/bin/sh
# The service's tests with its rows in PostgreSQL instead of SQLite: a server of Debian's (postgresql) in a folder of its own, on a port the system
# picks. Left out is what is about SQLite's file itself (backups, old schemas, dry runs over a copy) and what uses no database.
#
#   scripts/test-postgres.sh [FILTER...]   the tests, then a database that goes away and comes back
#   scripts/test-postgres.sh contract      only the tests of rows and jobs, which have to hold in every database
#   scripts/test-postgres.sh away          only the database that goes away and comes back
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}
contract="batches care cluster corrections databases growth keeping keys many moving restart resumable rivals uploads webhooks"

. scripts/postgres.sh

run_tests() { # FILTER...
    UNIGROUND_TEST_POSTGRES="$server" \
        $CARGO test --release --locked --quiet --test integration -- "$@" \
        --skip backups:: --skip upgrades:: --skip hurry::the_keepers --skip care::what_was_kept_long_enough --skip care::gc_wants \
        --skip chat_models:: --skip conventions:: --skip evaluation:: --skip layering:: --skip language:: --skip neural:: --skip openapi:: \
        --skip pages:: --skip real_models:: --skip shared_scenes:: --skip stage_one::
}
run_away() {
    createdb --maintenance-db "$server/postgres" away
    $PYTHON tests/cluster/away.py --program target/release/uniground --database "$server/away" --stop "$stop" --start "$start"
}

case "${1:-}" in
contract)
    # shellcheck disable=SC2086
    filters=$(scripts/test-modules.sh $contract)
    # shellcheck disable=SC2086
    run_tests $filters
    ;;
away)
    run_away
    ;;
*)
    run_tests "$@"
    $CARGO build --release --locked --quiet
    run_away
    ;;
esac
