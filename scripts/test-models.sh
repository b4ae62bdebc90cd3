#!/usr/bin/env bash
# Tests with real weights: downloads what is available, then checks parity with the Python runtime, annotated rooms, and real servers of both
# protocols. `golden` stops after SAM 2 tiny and CLIP against the Python runtime, which takes half a minute instead of ten. The golden outputs and
# rooms are in a folder next to the checkout.
set -euo pipefail
cd "$(dirname "$0")/.."
shared=../shared/models
if [ ! -d "$shared/golden" ]; then
    echo "skipped: no golden outputs in $shared" >&2
    [ -z "${UNIGROUND_REQUIRE_SHARED:-}" ]
    exit
fi

# Builds the program and the tests together.
${CARGO:-cargo} test --release --locked --quiet --test integration --no-run
./target/release/uniground models fetch
if [ "${1:-}" = golden ]; then
    ${CARGO:-cargo} test --release --locked --quiet --test integration -- --ignored --show-output \
        clip_embeddings_equal_the_python_runtime sam2_masks_equal_the_python_reference | tee target/golden
    # A renamed test would silently be skipped.
    grep -q '^test result: ok. 2 passed' target/golden
    exit
fi

venv=.venv-models
[ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
$venv/bin/pip install -q kserve==0.21.0 onnx==1.23.2 onnxruntime==1.31.1 pillow==13.0.0 tokenizers==0.23.2
rm -rf target/quantized
for bundle in models/sam2-hiera-tiny crates/uniground-models/tests/data/tiny-segmenter-sam; do
    $venv/bin/python tools/quantize_segmenter.py "$bundle" "target/quantized/$(basename "$bundle")-int8"
done
./target/release/uniground models verify --models target/quantized
if [ ! -f models/pe-tokenizer.json ]; then
    work=$(mktemp -d)
    $venv/bin/pip download -q --no-deps --only-binary=:all: -d "$work" open_clip_torch==3.3.0
    $venv/bin/python -m zipfile -e "$work"/*.whl "$work/x"
    $venv/bin/python tools/clip_tokenizer.py "$work/x/open_clip/bpe_simple_vocab_16e6.txt.gz" 32 models/pe-tokenizer.json
    rm -rf "$work"
fi

# A chat server in an environment of its own, because it pins other versions than the inference server needs.
litellm=.venv-litellm
[ -x $litellm/bin/python ] || "${PYTHON:-python3}" -m venv $litellm
$litellm/bin/pip install -q "litellm[proxy]==1.106.2"

logs=$(mktemp -d)
free_port() { $venv/bin/python -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'; }
# Waits until the server with this process id answers at this address; prints its log if it ends.
ready() {
    for _ in $(seq 120); do
        curl -sf "$3" >/dev/null && return
        kill -0 "$1" 2>/dev/null || break
        sleep 1
    done
    cat "$logs/$2" >&2
    return 1
}
kserve_port=$(free_port)
data=crates/uniground-models/tests/data
rm -rf target/kserve
for added in siglip-split:siglip clip-joint:clip-joint sam-split:sam sam2:sam2; do
    ./target/release/uniground models add "$data/hub/${added%:*}" --as "${added#*:}" --models target/kserve
done
$venv/bin/python tests/kserve/server.py "$kserve_port" $data/tiny-dual-encoder $data/tiny-segmenter target/kserve/siglip \
    target/kserve/clip-joint target/kserve/sam target/kserve/sam2 >"$logs/kserve" 2>&1 &
kserve=$!
litellm_port=$(free_port)
$litellm/bin/litellm --config tests/litellm/config.yaml --host 127.0.0.1 --port "$litellm_port" --telemetry False >"$logs/litellm" 2>&1 &
proxy=$!
trap 'kill $kserve $proxy 2>/dev/null || true; rm -rf "$logs"' EXIT
ready $kserve kserve "http://127.0.0.1:$kserve_port/v2/health/ready"
ready $proxy litellm "http://127.0.0.1:$litellm_port/health/liveliness"
KSERVE_URL=http://127.0.0.1:$kserve_port LITELLM_URL=http://127.0.0.1:$litellm_port \
    ${CARGO:-cargo} test --release --locked --quiet --test integration -- --ignored --show-output --test-threads 1 "$@"
