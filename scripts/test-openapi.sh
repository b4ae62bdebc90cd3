#!/usr/bin/env bash
# Checks the committed OpenAPI description with a linter, and with generated clients in two languages, which are compiled.
#
# Needs Python 3, and npm for the linter and the TypeScript client (if npm is missing, a line says so and these are skipped); installs
# openapi-python-client and mypy into .venv-openapi once (with `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

redocly=2.77.0
python_client=0.29.1
mypy=2.4.1
made=$(mktemp -d)
mkdir "$made/types"
trap 'rm -rf "$made"' EXIT

venv=.venv-openapi
if ! "$venv/bin/openapi-python-client" --version 2>/dev/null | grep -qF "$python_client"; then
    "${PYTHON:-python3}" -m venv $venv
    $venv/bin/python -m pip install --quiet --disable-pip-version-check "openapi-python-client==$python_client" "mypy==$mypy"
fi
[ "${1:-}" != install ] || exit 0
PATH=$PWD/$venv/bin:$PATH openapi-python-client generate --path openapi/openapi.json --config openapi/python-client.yaml \
    --output-path "$made/uniground_made" --meta none --fail-on-warning
# The generator's own errors: its handling of httpx's client, and a field with the name of its class.
cat >"$made/mypy.ini" <<'INI'
[mypy]
[mypy-uniground_made.client]
disable_error_code = arg-type
[mypy-uniground_made.models.answer]
disable_error_code = assignment, return-value
INI
(cd "$made" && "$OLDPWD/$venv/bin/mypy" --config-file mypy.ini uniground_made)

command -v npm >/dev/null || { echo "skipped: the linter and the TypeScript client, there is no npm"; exit 0; }
npx --yes "@redocly/cli@$redocly" lint openapi/openapi.json --config openapi/redocly.yaml --format=summary
# The page's types are generated from the description; this checks that they are current and compile.
scripts/web.sh install
(cd web && npx openapi-typescript ../openapi/openapi.json -o "$made/schema.ts" >/dev/null &&
    npx tsc --noEmit --strict --target es2022 --typeRoots "$made/types" "$made/schema.ts")
