#!/bin/sh
# The service with its scans and parses in an object store: the crate s3s-fs, a real S3 server on loopback (it checks signatures and
# conditions, and what it keeps are files: killed and started again it has what it had). First what is about an object store (a machine without
# its copies, outages, the bound of copies, orphans, torn uploads), then the tests of the whole service. Left out of those is what is about
# files in the data folder itself (backups, old schemas, dry runs, the quarantine; a file that is lost there, which is brought anew) and what uses
# no store.
#
#   scripts/test-objects.sh [FILTER...]   all of that
#   scripts/test-objects.sh contract      only the tests of files, which have to hold in every store
#   scripts/test-objects.sh install       only the S3 server
set -eu
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
PYTHON=${PYTHON:-python3}
S3S_FS=${S3S_FS:-target/tools/bin/s3s-fs}
contract="corrections growth keeping moving restart resumable uploads"

# Unoptimised and without debug information: that is built sooner, and quick enough for tests.
[ -x "$S3S_FS" ] || CARGO_PROFILE_DEV_DEBUG=0 $CARGO install --quiet --root target/tools s3s-fs --version 0.14.1 --features binary --locked --debug

run_tests() { # FILTER...
    $PYTHON tests/cluster/object_store.py --server "$S3S_FS" -- \
        "$CARGO" test --release --locked --quiet --test integration -- "$@" \
        --skip backups:: --skip upgrades:: --skip hurry::the_keepers --skip care::what_was_kept_long_enough \
        --skip keeping::what_no_record_speaks_of --skip keeping::the_doctor_finds_damage --skip logs::an_error_is_told_once \
        --skip chat_models:: --skip conventions:: --skip evaluation:: --skip layering:: --skip language:: --skip neural:: --skip openapi:: \
        --skip pages:: --skip real_models:: --skip shared_scenes:: --skip stage_one::
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
    $PYTHON tests/cluster/objects.py --program target/release/uniground --server "$S3S_FS"
    run_tests "$@"
    ;;
esac
