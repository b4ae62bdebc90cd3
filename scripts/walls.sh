#!/usr/bin/env bash
# Checks forbidden dependencies between packages, also transitive ones: a robot's process needs no server, a client no pipelines.
set -euo pipefail
cd "$(dirname "$0")/.."

wall() { # PACKAGE STRANGERS
    local tree found
    tree=$(${CARGO:-cargo} tree --locked -p "$1" -e normal --prefix none --format '{p}')
    found=$(cut -d' ' -f1 <<<"$tree" | sort -u | grep -vx "$1" | grep -xE "$2" || true)
    [ -z "$found" ] && return
    echo "$1 depends on" $found >&2
    exit 1
}
# Crates that a robot runs in its own process.
method='uniground-(client|telemetry|storage|jobs|isolation|endpoints|service|evaluation)|tokio|reqwest|hyper|sqlx|axum|clap|utoipa'
wall uniground-types 'uniground-.*|tokio|ort|image|rayon|utoipa'
wall uniground-core "$method"
wall uniground-geometry "uniground-(ingest|models|render|parsing|language|grounding)|ort|$method"
wall uniground-ingest "uniground-(models|render|parsing|language|grounding)|ort|$method"
wall uniground-language "uniground-(ingest|render|parsing|grounding)|$method"
wall uniground-client 'uniground-(geometry|core)|ort|sqlx|axum|clap|image|rayon|utoipa'
wall uniground-storage 'uniground-(jobs|service|grounding|language)|axum|clap|utoipa'
wall uniground-service 'uniground-evaluation|axum|clap'
