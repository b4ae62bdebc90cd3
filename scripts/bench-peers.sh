#!/usr/bin/env bash
# Builds PCL's VCCS, installs Open3D and onnxruntime into .venv-peers once, and times them next to this project: benches/PEERS.md. What cannot be
# built or installed becomes a row that says so. An argument names the folder of the rooms.
set -euo pipefail
cd "$(dirname "$0")/.."

peers=()
if "${MAKE:-make}" --no-print-directory target/peers/vccs; then
    peers+=(--pcl target/peers/vccs)
else
    echo "PCL's VCCS is left out: it needs a C++ compiler and Debian's libpcl-dev" >&2
fi

venv=.venv-peers
pins=benches/peers/requirements.txt
if ! cmp --silent "$pins" "$venv/installed.txt"; then
    "${PYTHON:-python3}" -m venv "$venv" &&
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check -r "$pins" &&
        cp "$pins" "$venv/installed.txt" ||
        echo "some packages of $pins could not be installed" >&2
fi
[ ! -x "$venv/bin/python" ] || peers+=(--python "$venv/bin/python")

"${CARGO:-cargo}" bench --locked --quiet --bench peers -- "${peers[@]}" --write benches/PEERS.md "$@"
