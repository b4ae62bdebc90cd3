#!/bin/sh
# The service with its scans and parses in an object store: the crate s3s-fs, a real S3 server on loopback. It checks signatures and conditions,
# and stores objects as files, so that a killed server still has them after a restart. First the tests of an object store itself (a machine without
# local copies, outages, the limit of local copies, orphans, torn uploads), then the tests of the whole service. Left out are tests of files in the
# data folder (backups, old schemas, dry runs, the quarantine, a lost file, which is fetched again) and tests that use no store.
#
#   scripts/test-objects.sh [FILTER...]   everything
#   scripts/test-objects.sh contract      only the tests of files, which every store must pass
#   scripts/test-objects.sh install       only installs the S3 server
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}
S3S_FS=${S3S_FS:-target/tools/bin/s3s-fs}
contract="corrections data_migration growth maintenance restart resumable_uploads uploads"
skipped="backups:: upgrades:: command_line::maintenance_commands_print_json retention::only_expired_data_is_removed
    maintenance::orphan_folders_are_quarantined maintenance::the_doctor_finds_damage_and_the_next_start_repairs_it
    logs::an_error_is_logged_once_with_route_request_and_cause chat_models:: coordinate_conventions:: evaluation:: layering:: language:: neural::
    openapi:: web_pages:: real_models:: stage_one::"

# Unoptimized and without debug information: this builds faster and is fast enough for tests.
[ -x "$S3S_FS" ] || CARGO_PROFILE_DEV_DEBUG=0 $CARGO install --quiet --root target/tools s3s-fs --version 0.14.1 --features binary --locked --debug

run_tests() { # FILTER...
    # shellcheck disable=SC2086
    skips=$(scripts/test-skips.sh $skipped)
    # shellcheck disable=SC2086
    $PYTHON tests/cluster/object_store.py --server "$S3S_FS" -- \
        "$CARGO" test --release --locked --quiet --test integration -- "$@" $skips
}

case "${1:-}" in
install)
    ;;
contract)
    # shellcheck disable=SC2086
    filters=$(scripts/test-modules.sh $contract)
    # shellcheck disable=SC2086
    run_tests $filters
    ;;
*)
    $CARGO build --release --locked --quiet
    $PYTHON tests/cluster/object_store_outage.py --program target/release/uniground --server "$S3S_FS"
    run_tests "$@"
    ;;
esac
