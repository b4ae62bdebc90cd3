#!/usr/bin/env bash
# Tests the page: types, whether web/dist is up to date, and a headless browser against the real server.
#
# Needs Node 20.19 with npm, Debian's chromium (or CHROMIUM=program), and the server built (or UNIGROUND=program).
# If Node or Chromium is missing, a line says so and their tests are skipped. `browser` runs only the browser tests.
set -euo pipefail
cd "$(dirname "$0")/.."

command -v npm >/dev/null || { scripts/web.sh check && echo "skipped: the page's tests, there is no npm" && exit 0; }
if [ "${1:-}" = browser ]; then scripts/web.sh install; else scripts/web.sh check; fi

chromium=${CHROMIUM:-$(command -v chromium || command -v chromium-browser || command -v google-chrome || true)}
[ -n "$chromium" ] || { echo "skipped: the page in a browser, there is no chromium (Debian: apt-get install chromium)"; exit 0; }
program=${UNIGROUND:-$PWD/target/release/uniground}
[ -x "$program" ] || { echo "build the server first: cargo build --release" >&2; exit 1; }
cd web
export CHROMIUM=$chromium UNIGROUND=$program
UNIGROUND_SAMPLE_DATA=$(node tests/support/prepare.js)
export UNIGROUND_SAMPLE_DATA
trap 'rm -rf "$UNIGROUND_SAMPLE_DATA"' EXIT
node --test --test-concurrency=1 --test-timeout=120000 --test-reporter=spec tests/*.test.js
