#!/usr/bin/env bash
# Runs the README's question and its request as printed, the request against a server with built-in models, and checks the answers.
set -euo pipefail
cd "$(dirname "$0")/.."

data=$(mktemp -d)
UNIGROUND_DATA_DIR="$data/data" ./target/release/uniground serve --masks builtin --encoder builtin >"$data/out" 2>"$data/log" &
server=$!
trap 'kill "$server" && wait "$server" || true; rm -rf "$data"' EXIT
for _ in $(seq 100); do grep -q '^listening' "$data/out" && break; sleep 0.1; done
grep -q '^listening' "$data/out" || { cat "$data/log" >&2; exit 1; }

block() { # HEADING: the first sh block under it
    awk -v heading="## $1" '$0 == heading { found = 1 } found && /^```$/ { exit } inside { print } found && /^```sh/ { inside = 1 }' README.md
}

block "One question" >"$data/question.sh"
grep -q "uniground ground" "$data/question.sh"
XDG_CACHE_HOME="$data/cache" bash -euo pipefail "$data/question.sh" | tee "$data/table"
grep -q 'grounded' "$data/table"

block "One request" >"$data/lines.sh"
grep -q curl "$data/lines.sh"
bash -euo pipefail "$data/lines.sh" | tee "$data/answer"
grep -q '"status": "grounded"' "$data/answer"
