#!/bin/sh
# Prints a test filter for each module of tests/integration: `batches` becomes `batches::`. Fails on an unknown module, because a filter that matches
# nothing would silently skip its tests.
set -eu
cd "$(dirname "$0")/.."
for module in "$@"; do
    [ -e "tests/integration/$module.rs" ] || { echo "tests/integration has no module $module: $*" >&2; exit 1; }
    echo "$module::"
done
