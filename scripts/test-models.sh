#!/usr/bin/env bash
# Tests with real weights: what can be fetched is fetched, then parity with the Python runtime, annotated rooms, and a real inference server.
# The golden outputs and rooms lie beside the checkout where this project is built.
set -euo pipefail
cd "$(dirname "$0")/.."
shared=../shared/models
[ -d "$shared/golden" ] || { echo "test-models: $shared/golden is not there" >&2; exit 1; }

scripts/fetch-models.sh onnxruntime sam2 clip-image
cp "$shared"/clip-vitb16-lite/{model.json,text.onnx,tokenizer.json} models/clip-vitb16-lite/
chmod u+w models/clip-vitb16-lite/*

venv=.venv-models
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q kserve==0.21.0 onnxruntime==1.31.1 tokenizers==0.23.2
if [ ! -f models/pe-tokenizer.json ]; then
    work=$(mktemp -d)
    $venv/bin/pip download -q --no-deps --only-binary=:all: -d "$work" open_clip_torch==3.3.0
    $venv/bin/python -m zipfile -e "$work"/*.whl "$work/x"
    $venv/bin/python tools/clip_tokenizer.py "$work/x/open_clip/bpe_simple_vocab_16e6.txt.gz" 32 models/pe-tokenizer.json
    rm -rf "$work"
fi

log=$(mktemp)
port=$($venv/bin/python -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
$venv/bin/python tests/kserve/server.py "$port" tests/data/tiny-dual-encoder tests/data/tiny-segmenter >"$log" 2>&1 &
server=$!
trap 'kill $server 2>/dev/null || true; rm -f "$log"' EXIT
for _ in $(seq 60); do
    curl -sf "http://127.0.0.1:$port/v2/health/ready" >/dev/null && break
    kill -0 $server 2>/dev/null || { cat "$log" >&2; exit 1; }
    sleep 1
done
KSERVE_URL=http://127.0.0.1:$port ${CARGO:-cargo} test --release --locked --quiet --test integration -- --ignored --show-output --test-threads 1 "$@"
