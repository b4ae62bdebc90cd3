#!/usr/bin/env bash
# Questions per second over HTTP with the built-in models: a fresh server, the sample scene, sixteen connections (Debian's wrk).
set -euo pipefail
cd "$(dirname "$0")/.."
command -v wrk >/dev/null || { echo "skipped: wrk is not installed" >&2; exit 1; }

work=$(mktemp -d)
"${PROGRAM:-./target/release/uniground}" serve --listen 127.0.0.1:0 --data-dir "$work/data" --masks builtin --encoder builtin >"$work/out" 2>"$work/log" &
server=$!
trap 'kill $server 2>/dev/null; rm -rf "$work"' EXIT
until grep -q "listening on" "$work/out"; do sleep 0.1; done
url=$(sed -n 's/.*listening on \(http[^ ]*\).*/\1/p' "$work/out")

created=$(curl -s -X POST "$url/v1/scenes" -H 'content-type: application/zip' --data-binary @examples/living_room.zip)
scene=$(echo "$created" | python3 -c 'import json, sys; print(json.load(sys.stdin)["scene"]["id"])')
job=$(echo "$created" | python3 -c 'import json, sys; print(json.load(sys.stdin)["job"]["id"])')
curl -sN "$url/v1/jobs/$job/events" >/dev/null

cat >"$work/ask.lua" <<'LUA'
wrk.method = "POST"
wrk.headers["Content-Type"] = "application/json"
wrk.body = [[{"query": "the mug on the coffee table"}]]
LUA
wrk -t1 -c16 -d8s --latency -s "$work/ask.lua" "$url/v1/scenes/$scene/ground"
