#!/bin/sh
# Filters for modules of tests/integration, one a line: `batches` becomes `batches::`. Fails on a name that is no module, whose tests a filter
# would leave out without a word.
set -eu
cd "$(dirname "$0")/.."
for module in "$@"; do
    [ -e "tests/integration/$module.rs" ] || { echo "tests/integration has no module $module: $*" >&2; exit 1; }
    echo "$module::"
done
