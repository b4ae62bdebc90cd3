#!/usr/bin/env bash
# Runs the README's request lines as printed, against a server with built-in parts, and checks the answer.
set -euo pipefail
cd "$(dirname "$0")/.."

data=$(mktemp -d)
UNIGROUND_DATA_DIR="$data/data" ./target/release/uniground serve --masks builtin --encoder builtin >"$data/out" 2>"$data/log" &
server=$!
trap 'kill "$server" && wait "$server" || true; rm -rf "$data"' EXIT
for _ in $(seq 100); do grep -q '^listening' "$data/out" && break; sleep 0.1; done
grep -q '^listening' "$data/out" || { cat "$data/log" >&2; exit 1; }

# The sh block under "One request".
awk '/^## One request/ { found = 1 } found && /^```$/ { exit } inside { print } found && /^```sh/ { inside = 1 }' README.md >"$data/lines.sh"
grep -q curl "$data/lines.sh"
bash -euo pipefail "$data/lines.sh" | tee "$data/answer"
grep -q '"status": "grounded"' "$data/answer"
