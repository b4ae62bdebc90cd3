#!/usr/bin/env bash
# Builds the page into web/dist, which is committed so that cargo alone builds the whole program; or checks that it is up to date.
#
#   scripts/web.sh          builds (needs Node 20.19 or newer and npm)
#   scripts/web.sh install  installs the build's packages (npm) into web/node_modules, unless they are there
#   scripts/web.sh check    compares the hash of the sources with the recorded one; if npm is installed, builds again and compares
set -euo pipefail
cd "$(dirname "$0")/../web"

# Every input of a build.
sum=$(command -v sha256sum || echo shasum -a 256)
hash_of_sources() {
    find src build index.html package.json package-lock.json tsconfig.json vite.config.js -type f -print0 |
        LC_ALL=C sort -z | xargs -0 $sum | $sum | cut -d ' ' -f 1
}

install() { [ -d node_modules ] && [ node_modules -nt package-lock.json ] || { npm ci --no-audit --no-fund --silent && touch node_modules; }; }

build() { # FOLDER
    npx --no-install tsc
    npx --no-install vite build --logLevel warn --outDir "$1"
    hash_of_sources >"$1/SOURCES"
}

case "${1:-build}" in
install)
    if command -v npm >/dev/null; then install; else echo "skipped: packages of the page, there is no npm"; fi
    ;;
build)
    install
    build dist
    node build/sizes.js
    ;;
check)
    if [ "$(hash_of_sources)" != "$(cat dist/SOURCES)" ]; then
        echo "web/dist is not up to date: run scripts/web.sh and commit the result" >&2
        exit 1
    fi
    if command -v npm >/dev/null; then
        install
        again=$(mktemp -d)
        trap 'rm -rf "$again"' EXIT
        build "$again"
        diff -r dist "$again" || { echo "building web/dist again gives different files: run scripts/web.sh and commit the result" >&2; exit 1; }
        npx --no-install openapi-typescript ../openapi/openapi.json -o "$again/schema.d.ts" --alphabetize --default-non-nullable false >/dev/null
        diff -q src/api/schema.d.ts "$again/schema.d.ts" || { echo "web/src/api/schema.d.ts is not up to date with openapi/openapi.json: run npm run types in web/" >&2; exit 1; }
    else
        echo "skipped: building the page again, there is no npm"
    fi
    ;;
*)
    echo "usage: scripts/web.sh [build|install|check]" >&2
    exit 2
    ;;
esac
