#!/bin/sh
# The service's tests with its rows in PostgreSQL instead of SQLite: Debian's postgresql, started in a folder of its own on a free port. Left out
# are tests of the SQLite file itself (backups, old schemas, dry runs on a copy) and tests that use no database.
#
#   scripts/test-postgres.sh [FILTER...]   the tests, then an outage of the database
#   scripts/test-postgres.sh contract      only the tests of rows and jobs, which every database must pass
#   scripts/test-postgres.sh away          only the outage of the database
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}
contract="batches cluster concurrency corrections data_migration databases drafts growth keys maintenance many_scenes restart resumable_uploads retention
    uploads webhooks"
skipped="backups:: upgrades:: command_line::maintenance_commands_print_json retention::only_expired_data_is_removed
    retention::gc_requires_the_folder_of_a_stopped_server chat_models:: coordinate_conventions:: evaluation:: layering:: language:: neural::
    openapi:: web_pages:: real_models:: stage_one::"

. scripts/postgres.sh

run_tests() { # FILTER...
    # shellcheck disable=SC2086
    skips=$(scripts/test-skips.sh $skipped)
    # shellcheck disable=SC2086
    UNIGROUND_TEST_POSTGRES="$server" \
        $CARGO test --release --locked --quiet --test integration -- "$@" $skips
}
run_away() {
    createdb --maintenance-db "$server/postgres" away
    $PYTHON tests/cluster/database_outage.py --program target/release/uniground --database "$server/away" --stop "$stop" --start "$start"
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
