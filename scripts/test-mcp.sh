#!/usr/bin/env bash
# Tests existing MCP clients against the real server. Needs ./target/release/uniground and Python 3.10 or newer, and npx for the inspector (if it is
# missing, a line says so); installs the Python SDK into .venv-mcp once (with `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

sdk=2.3.0
venv=.venv-mcp
if ! "$venv/bin/python" -m pip show mcp 2>/dev/null | grep -qx "Version: $sdk"; then
    "${PYTHON:-python3}" -m venv $venv
    $venv/bin/python -m pip install --quiet --disable-pip-version-check "mcp==$sdk"
fi
[ "${1:-}" != install ] || exit 0
$venv/bin/python tests/mcp/run.py
