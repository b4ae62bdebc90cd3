#!/bin/sh
# Prints `--skip NAME` for each module (`backups::`) or test (`backups::a_second_backup_copies_only_new_files`) of tests/integration. Fails on an unknown name,
# because a skip that matches nothing would silently run the test.
set -eu
cd "$(dirname "$0")/.."
for name in "$@"; do
    file=tests/integration/${name%%::*}.rs
    test=${name#*::}
    grep -qs "fn ${test:-}" "$file" || { echo "tests/integration has no test $name" >&2; exit 1; }
    echo "--skip $name"
done
