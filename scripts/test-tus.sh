#!/usr/bin/env bash
# Clients of tus that exist against a real server that is killed in the middle. Needs ./target/release/uniground and Python 3.10 or newer, and
# npm for tus-js-client (where it is missing it says so); installs tuspy into .venv-tus once.
set -euo pipefail
cd "$(dirname "$0")/.."

tuspy=1.1.0
venv=.venv-tus
if ! "$venv/bin/python" -m pip show tuspy 2>/dev/null | grep -qx "Version: $tuspy"; then
    "${PYTHON:-python3}" -m venv $venv
    $venv/bin/python -m pip install --quiet --disable-pip-version-check "tuspy==$tuspy"
fi
if command -v npm >/dev/null && [ ! -d web/node_modules/tus-js-client ]; then
    (cd web && npm ci --no-audit --no-fund --silent && touch node_modules)
fi
$venv/bin/python tests/tus/run.py
