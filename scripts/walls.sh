#!/usr/bin/env bash
# What a package must not lean on, however many others stand between: a robot's process needs no server, a client no pipelines.
set -euo pipefail
cd "$(dirname "$0")/.."

wall() { # PACKAGE STRANGERS
    local tree found
    tree=$(${CARGO:-cargo} tree --locked -p "$1" -e normal --prefix none --format '{p}')
    found=$(cut -d' ' -f1 <<<"$tree" | sort -u | grep -xE "$2" || true)
    [ -z "$found" ] && return
    echo "$1 depends on" $found >&2
    exit 1
}
wall uniground-types 'uniground-core|uniground-geometry|uniground-client|tokio|ort|image|rayon|utoipa'
wall uniground-core 'uniground-client|tokio|reqwest|hyper|sqlx|axum|clap|utoipa'
wall uniground-client 'uniground-core|ort|sqlx|axum|clap|image|rayon|utoipa'
