#!/usr/bin/env bash
# Tests existing tus clients against a real server that is killed during the upload. Needs ./target/release/uniground and Python 3.10 or newer, and
# npm for tus-js-client (if it is missing, a line says so); installs tuspy into .venv-tus once (with `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

tuspy=1.1.0
venv=.venv-tus
if ! "$venv/bin/python" -m pip show tuspy 2>/dev/null | grep -qx "Version: $tuspy"; then
    "${PYTHON:-python3}" -m venv $venv
    $venv/bin/python -m pip install --quiet --disable-pip-version-check "tuspy==$tuspy"
fi
[ "${1:-}" != install ] || exit 0
[ -z "$(command -v npm)" ] || scripts/web.sh install
$venv/bin/python tests/tus/run.py
