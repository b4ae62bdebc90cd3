#!/usr/bin/env bash
# Scores the annotated rooms with the built-in models and fails on a significant drop against benches/quality.json. The baseline consists of the rooms
# used for development; figures of the others are printed but not checked. UPDATE=1 writes the baseline instead; `baseline` scores only the rooms of
# the baseline.
set -euo pipefail
cd "$(dirname "$0")/.."

rooms=${ROOMS:-../shared/scenes}
baseline=benches/quality.json
if [ ! -d "$rooms" ]; then
    echo "skipped: no annotated rooms in $rooms" >&2
    [ -z "${UNIGROUND_REQUIRE_SHARED:-}" ]
    exit
fi
folders=$(mktemp -d)
trap 'rm -rf "$folders"' EXIT
mkdir "$folders/scenes" "$folders/others" "$folders/named"
for file in "$rooms"/*.zip "$rooms"/*.queries.json "$rooms"/*.scene.json; do
    room=$(basename "$file" | cut -d. -f1)
    if [ ! -f "$rooms/$room.queries.json" ]; then continue; fi
    if grep -q "\"$room#" "$baseline" || [ -n "${UPDATE:-}" ]; then kind=scenes; else kind=others; fi
    ln -s "$(realpath "$file")" "$folders/$kind/"
    ln -s "$(realpath "$file")" "$folders/named/"
done
for file in benches/names/*.names.json; do ln -s "$(realpath "$file")" "$folders/named/"; done
matrix="source=parsed,oracle-boxes,oracle;top_k=10"
only=${1:-all}
label=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)
if [ "$only" != baseline ] && [ -n "$(ls "$folders/others")" ]; then
    echo "Rooms not used for development:"
    ./target/release/uniground eval "$folders/others" --out target/quality-others --matrix "$matrix" --label "$label"
    echo "Rooms of the baseline:"
fi
against=(--baseline "$baseline")
[ -n "${UPDATE:-}" ] && against=(--write-baseline "$baseline")
./target/release/uniground eval "$folders/scenes" --out target/quality --matrix "$matrix" --label "$label" "${against[@]}"
[ "$only" != baseline ] || exit 0
echo "All rooms, with names written by a person (benches/names), and 24 candidates:"
./target/release/uniground eval "$folders/named" --out target/quality-named --matrix "source=parsed,oracle-boxes;names=seen;top_k=24" --label "$label"
