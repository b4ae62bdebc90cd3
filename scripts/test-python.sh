#!/usr/bin/env bash
# Tests the Python package against a real server: generated files, formatting and lints, types, Python 3.9, tests, code blocks of the documentation,
# the notebook, and the ROS 2 example. Needs ./target/release/uniground (or UNIGROUND_PROGRAM) and Python 3.11; installs into .venv-python once (with
# `install` only that).
set -euo pipefail
cd "$(dirname "$0")/.."

venv=.venv-python
packages=$venv/packages
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
# Installed again if the requirements have changed.
if ! cmp -s clients/python/pyproject.toml $packages; then
    $venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --editable 'clients/python[test]'
    cp clients/python/pyproject.toml $packages
fi
[ "${1:-}" != install ] || exit 0

"${PYTHON:-python3}" scripts/python-client.py --check
cd clients/python
run=../../$venv/bin
ours=(. ../../examples/ros2 ../../scripts/python-client.py)
$run/ruff format --config pyproject.toml --check --quiet "${ours[@]}"
$run/ruff check --config pyproject.toml --quiet "${ours[@]}"
$run/mypy
$run/vermin --quiet --target=3.9- --no-tips src
nice $run/python -m pytest "$@"
