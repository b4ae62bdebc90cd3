#!/usr/bin/env bash
# Changes the method's code in small ways, one at a time, and counts the changes that a unit test
# notices. All of them take hours: a shard K/N takes every Nth change, starting with the Kth.
set -euo pipefail
cd "$(dirname "$0")/.."
shard=${1:-0/12}
tools=$PWD/target/tools
[ -x "$tools/bin/cargo-mutants" ] ||
    cargo install --quiet --locked cargo-mutants --version 27.1.0 --root "$tools"
files=(
    'crates/uniground-parsing/src/{affinity,lifting,merging}.rs'
    'crates/uniground-parsing/src/instances/bounds.rs'
    'crates/uniground-grounding/src/{relations,assess,fit}.rs'
    'crates/uniground-grounding/src/vlm/{reply,consistency,decision}.rs'
    'crates/uniground-models/src/calibration.rs'
    'crates/uniground-storage/src/{jobs,blobs/mod,blobs/stages,blobs/growing}.rs'
    'crates/uniground-jobs/src/queue.rs'
)
out=target/mutants
mkdir -p $out
"$tools/bin/cargo-mutants" mutants --workspace "${files[@]/#/--file=}" --shard "$shard" \
    --sharding round-robin --baseline skip --timeout 300 --no-shuffle --output $out \
    -- --lib || [ $? -lt 4 ]
python3 - $out/mutants.out/outcomes.json "$shard" <<'EOF'
import json, sys
found = json.load(open(sys.argv[1]))
caught, missed = found["caught"] + found["timeout"], found["missed"]
print(f"shard {sys.argv[2]}: {caught} of {caught + missed} changes noticed by unit tests "
      f"({100 * caught / max(caught + missed, 1):.1f} %), {found['timeout']} of them by a timeout; "
      f"{found['unviable']} did not compile")
EOF
