#!/usr/bin/env bash
# Sends generated requests from the served OpenAPI description to a real server: every response must match the description. Needs
# ./target/release/uniground and Python 3; installs Schemathesis into .venv once (with `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

version=4.32.5
venv=.venv
if ! "$venv/bin/schemathesis" --version 2>/dev/null | grep -qF "$version"; then
    "${PYTHON:-python3}" -m venv "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "schemathesis==$version"
fi
[ "${1:-}" != install ] || exit 0

data=$(mktemp -d)
server=
trap '[ -z "$server" ] || { kill "$server" && wait "$server" || true; }; rm -rf "$data"' EXIT
# With a key, like a public server.
export UNIGROUND_API_KEY=ug_schemathesis_0123456789
show=(-H "Authorization: Bearer $UNIGROUND_API_KEY")
./target/release/uniground serve --listen 127.0.0.1:0 --data-dir "$data/data" --masks builtin --encoder builtin >"$data/out" 2>"$data/log" &
server=$!
for _ in $(seq 100); do
    url=$(sed -n 's/^listening on //p' "$data/out")
    [ -n "$url" ] && break
    sleep 0.1
done
[ -n "$url" ] || { cat "$data/log" >&2; exit 1; }

# A parsed scene, so that requests reach more than "not found".
scene=$(curl -fsS "${show[@]}" -X POST "$url/v1/scenes?name=fuzz" -H 'content-type: application/zip' --data-binary @examples/living_room.zip |
    "$venv/bin/python" -c 'import json,sys; print(json.load(sys.stdin)["scene"]["id"])')
for _ in $(seq 300); do
    curl -fsS "${show[@]}" "$url/v1/scenes/$scene" | grep -q '"status":"ready"' && break
    sleep 0.1
done
answer=$(curl -fsS "${show[@]}" -X POST "$url/v1/scenes/$scene/ground" -H 'content-type: application/json' -d '{"query":"the sofa"}' |
    "$venv/bin/python" -c 'import json,sys; print(json.load(sys.stdin)["id"])')
job=$(curl -fsS "${show[@]}" "$url/v1/scenes/$scene" | "$venv/bin/python" -c 'import json,sys; print(json.load(sys.stdin)["job_id"])')

upload=$(curl -fsS "${show[@]}" -X POST "$url/v1/uploads" -H 'tus-resumable: 1.0.0' -H 'upload-length: 1000000' |
    "$venv/bin/python" -c 'import json,sys; print(json.load(sys.stdin)["id"])')

cat >"$data/schemathesis.toml" <<TOML
hooks = "$PWD/scripts/schemathesis_hooks.py"
[checks.not_a_server_error]
expected-statuses = ["2xx", "3xx", "4xx"]
[parameters]
"path.scene_id" = "$scene"
"path.answer_id" = "$answer"
"path.job_id" = "$job"
"path.upload_id" = "$upload"
"path.view" = "0.jpg"
# Deleting the scene would leave nothing for the other requests.
[[operations]]
include-name = "DELETE /v1/scenes/{scene_id}"
enabled = false
TOML
"$venv/bin/schemathesis" --config-file "$data/schemathesis.toml" run "$url/openapi.json" "${show[@]}" \
    --checks not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance,response_headers_conformance \
    --phases examples,coverage,fuzzing --max-examples "${EXAMPLES:-30}" --seed 1 --suppress-health-check all --no-color
kill -0 "$server"
