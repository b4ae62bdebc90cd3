#!/usr/bin/env bash
# Scores the annotated rooms with the built-in parts and fails on a drop against benches/quality.json that is more than luck.
# UPDATE=1 writes the baseline instead.
set -euo pipefail
cd "$(dirname "$0")/.."

rooms=${ROOMS:-../shared/scenes}
baseline=benches/quality.json
if [ ! -d "$rooms" ]; then
    echo "left out: no annotated rooms in $rooms" >&2
    [ -z "${UNIGROUND_REQUIRE_SHARED:-}" ]
    exit
fi
against=(--baseline "$baseline")
[ -n "${UPDATE:-}" ] && against=(--write-baseline "$baseline")
./target/release/uniground eval "$rooms" --out target/quality --matrix "source=parsed,oracle-boxes,oracle;top_k=10" \
    --label "$(git rev-parse --short HEAD 2>/dev/null || echo unknown)" "${against[@]}"
