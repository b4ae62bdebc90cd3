#!/usr/bin/env bash
# Runs every fuzz target for this many seconds, starting from the inputs in fuzz/seeds. Findings are stored in fuzz/artifacts.
set -euo pipefail
cd "$(dirname "$0")/../fuzz"
seconds=${1:-60}
for target in $(sed -n 's/^name = "\(.*\)"$/\1/p' Cargo.toml | tail -n +2); do
    mkdir -p "corpus/$target" "seeds/$target"
    # The seeds are only read; new inputs go to the corpus.
    cargo +nightly fuzz run "$target" "corpus/$target" "seeds/$target" -- -max_total_time="$seconds" -max_len=65536 -rss_limit_mb=1024 -timeout=20
done
