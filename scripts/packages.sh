#!/usr/bin/env bash
# Builds what a release publishes, to dist/: an archive with the program and ONNX Runtime, and a
# Python wheel. Then installs each into an empty folder and runs the demo from there.
#
#   scripts/packages.sh            archive and wheel, tried
#   scripts/packages.sh archive    only the archive
#   scripts/packages.sh wheel      only the wheel
set -euo pipefail
cd "$(dirname "$0")/.."
out=$PWD/dist
target=$(rustc -vV | sed -n 's/^host: //p')
version=$(sed -n 's/^version = "\(.*\)"$/\1/p' Cargo.toml | head -n 1)
name=uniground-$version-$target
mkdir -p "$out"

# Without a compiler, a checkout or settings of this shell.
demo() { # PROGRAM
    local folder
    folder=$(mktemp -d)
    (cd "$folder" && env -i HOME="$folder" PATH=/usr/bin:/bin "$1" demo)
    test -s "$folder/demo-out/answer-1.jpg"
    rm -rf "$folder"
}

archive() {
    cargo build --release --locked --bin uniground
    rm -rf "${out:?}/$name"
    mkdir -p "$out/$name/licenses"
    cp target/release/uniground README.md CHANGELOG.md SECURITY.md "$out/$name/"
    cp LICENSE-MIT LICENSE-APACHE crates/uniground-render/assets/fonts/OFL.txt "$out/$name/licenses/"
    cp src/packages/bundles/clip-vitb16-lite/PROVENANCE.md "$out/$name/licenses/clip-vitb16-lite.md"
    # The program looks for ONNX Runtime beside itself. On macOS `models fetch` brings it.
    if [ "$(uname)" = Linux ]; then
        local library
        library=$(mktemp -d)
        "$out/$name/uniground" models fetch --onnxruntime "$library" onnxruntime
        cp "$library/libonnxruntime.so" "$out/$name/"
        mkdir "$out/$name/licenses/onnxruntime"
        cp "$library/LICENSE" "$library/NOTICES" "$out/$name/licenses/onnxruntime/"
        rm -rf "$library"
        "$out/$name/uniground" models verify crates/uniground-models/tests/data/tiny-dual-encoder
    fi
    tar -C "$out" -czf "$out/$name.tar.gz" "$name"
    rm -rf "${out:?}/$name"
    local empty
    empty=$(mktemp -d)
    tar -C "$empty" -xzf "$out/$name.tar.gz"
    demo "$empty/$name/uniground"
    rm -rf "$empty"
}

wheel() {
    local venv=.venv-packages empty
    [ -x $venv/bin/python ] || "${PYTHON:-python3}" -m venv $venv
    $venv/bin/pip install -q 'maturin>=1.9,<2'
    rm -f "$out"/uniground_server-*.whl
    (cd packaging/python-server && ../../$venv/bin/maturin build --release --locked --strip --out "$out")
    empty=$(mktemp -d)
    "${PYTHON:-python3}" -m venv "$empty/venv"
    "$empty/venv/bin/pip" install -q --no-index "$out"/uniground_server-*.whl
    demo "$("$empty/venv/bin/python" -c 'import uniground_server; print(uniground_server.program())')"
    rm -rf "$empty"
}

case "${1:-all}" in
archive) archive ;;
wheel) wheel ;;
all)
    archive
    wheel
    ls -l "$out"
    ;;
*)
    echo "usage: scripts/packages.sh [archive|wheel]" >&2
    exit 2
    ;;
esac
