#!/usr/bin/env python3
"""Makes a segmenter bundle whose picture encoder computes with 8-bit integers: faster on CPUs with VNNI or similar instructions.

usage: quantize_segmenter.py BUNDLE OUT [--pictures FOLDER]

BUNDLE is the folder of a promptable segmenter, such as models/sam2-hiera-tiny. OUT must not exist. Weights of matrix products are quantized per
channel, activations while the network runs. The decoder and everything else stay as they are.

Both encoders then run on a few pictures, and the decoder on a grid of points in each. The tool prints the time of a picture and how well the masks
agree (IoU), and fails if the mean is below 0.95.

Requires: numpy, onnx, onnxruntime, pillow.
"""
import argparse
import json
import logging
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnxruntime
from onnxruntime.quantization import QuantType, quantize_dynamic
from PIL import Image

LEAST_AGREEMENT = 0.95
# Points per side of the grid, and pictures that are compared at most.
GRID, PICTURES = 8, 4
RESIZE = {"bilinear": Image.BILINEAR, "bicubic": Image.BICUBIC}


def session(file, save_to=None):
    options = onnxruntime.SessionOptions()
    if save_to:
        # As it was exported: optimizations for this machine do not belong into the file.
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.optimized_model_filepath = str(save_to)
        options.add_session_config_entry("session.save_model_format", "ONNX")
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def quantize(source, target):
    """Quantizes a network in ONNX or ORT format to a file in ONNX format."""
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "encoder.onnx"
        session(source, save_to=plain)
        # It recommends shape inference, which changes nothing for matrix products.
        logging.getLogger().setLevel(logging.ERROR)
        quantize_dynamic(str(plain), str(target), op_types_to_quantize=["MatMul"], per_channel=True, weight_type=QuantType.QInt8)


def pictures(folder):
    """Returns pictures of the folder, or generated ones: shapes of several colors with noise."""
    files = sorted(file for file in Path(folder).rglob("*") if file.suffix.lower() in {".jpg", ".jpeg", ".png"}) if folder else []
    if folder and not files:
        sys.exit(f"{folder}: no JPEG or PNG picture")
    if files:
        return [Image.open(file).convert("RGB") for file in files[:: -(-len(files) // PICTURES)]]
    dice, made = np.random.default_rng(7), []
    rows, columns = np.mgrid[:480, :640]
    for _ in range(PICTURES):
        picture = np.full((480, 640, 3), dice.integers(40, 200, 3), np.float64)
        for _ in range(25):
            x, y, reach = dice.integers(0, 640), dice.integers(0, 480), dice.integers(15, 110)
            inside = np.hypot(columns - x, rows - y) < reach if dice.random() < 0.5 else (abs(columns - x) < reach) & (abs(rows - y) < reach / 2)
            picture[inside] = dice.integers(0, 255, 3)
        made.append(Image.fromarray(np.clip(picture + dice.normal(0, 6, picture.shape), 0, 255).astype(np.uint8)))
    return made


def to_input(picture, encoder):
    """Returns the network's input of a picture, as uniground prepares it (`resize` squash or longest-pad)."""
    size = encoder["size"]
    scale = [size / picture.width, size / picture.height] if encoder["resize"] == "squash" else [size / max(picture.size)] * 2
    fitted = picture.resize((round(picture.width * scale[0]), round(picture.height * scale[1])), RESIZE[encoder["interpolation"]])
    values = np.asarray(fitted, np.float32) / (1 if encoder["value_range"] == "0-255" else 255)
    values = (values - np.float32(encoder["mean"])) / np.float32(encoder["std"])
    padded = np.zeros((3, size, size), np.float32)
    padded[:, : values.shape[0], : values.shape[1]] = values.transpose(2, 0, 1)
    return padded[None], (fitted.width, fitted.height)


def masks(decoder, manifest, features, reach):
    """Returns the masks of a grid of points, and their predicted qualities."""
    names, outputs, side = manifest["inputs"], manifest["outputs"], manifest["mask_size"]
    inputs = {names[role]: value for role, value in features.items()}
    if names.get("mask_input"):
        inputs |= {names["mask_input"]: np.zeros((1, 1, side, side), np.float32), names["has_mask_input"]: np.zeros(1, np.float32)}
    if names.get("orig_im_size"):
        inputs[names["orig_im_size"]] = np.float32([side, side])
    found = []
    for step in range(GRID * GRID):
        point = [(step % GRID + 0.5) * reach[0] / GRID, (step // GRID + 0.5) * reach[1] / GRID]
        points, labels = [point], [1.0]
        if manifest["pad_point"]:
            points, labels = points + [[0.0, 0.0]], labels + [-1.0]
        prompt = {names["point_coords"]: np.float32([points]), names["point_labels"]: np.float32([labels])}
        found.append(decoder.run([outputs["masks"], outputs["iou"]], inputs | prompt))
    threshold = manifest["mask_threshold"]
    return np.concatenate([logits > threshold for logits, _ in found]), np.concatenate([quality for _, quality in found])


def compare(bundle, out, manifest, folder):
    """Returns the mean IoU of confident masks with both encoders, and the seconds of a picture with each."""
    encoder = manifest["encoder"]
    networks = [session(place / read(place)["encoder"]["file"]) for place in (bundle, out)]
    decoder = session(bundle / manifest["decoder"]["file"])
    agreement, seconds = [], [[], []]
    for picture in pictures(folder):
        values, reach = to_input(picture, encoder)
        seen = []
        for network, times in zip(networks, seconds):
            start = time.perf_counter()
            features = network.run(list(encoder["outputs"].values()), {encoder["input"]: values})
            times.append(time.perf_counter() - start)
            seen.append(masks(decoder, manifest["decoder"], dict(zip(encoder["outputs"], features)), reach))
        (exact, quality), (fast, _) = seen
        union = (exact | fast).sum((2, 3))
        sure = (quality > np.quantile(quality, 0.5)) & (union > 0)
        agreement.extend(((exact & fast).sum((2, 3))[sure] / union[sure]).tolist())
    return float(np.mean(agreement)), [min(times) for times in seconds]


def read(bundle):
    return json.loads((bundle / "model.json").read_text())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--pictures", metavar="FOLDER", help="pictures to compare masks in; generated ones if not given")
    options = parser.parse_args()
    if not (options.bundle / "model.json").is_file():
        sys.exit(f"{options.bundle}: no model.json; expected the folder of a model bundle")
    manifest = read(options.bundle)
    if manifest["kind"] != "promptable-segmenter":
        sys.exit(f"{options.bundle}: this is a {manifest['kind']}; expected a promptable-segmenter")
    if options.out.exists():
        sys.exit(f"{options.out} exists already")
    encoder = manifest["encoder"]["file"]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(options.bundle, options.out, ignore=shutil.ignore_patterns(encoder, f"{encoder}.data"))
    quantized = Path(encoder).with_suffix(".onnx").name
    quantize(options.bundle / encoder, options.out / quantized)
    changed = manifest | {"name": f"{manifest['name']}-int8", "encoder": manifest["encoder"] | {"file": quantized}}
    changed["source"] = f"{manifest.get('source', 'unknown')}; encoder quantized by tools/quantize_segmenter.py (dynamic int8)"
    (options.out / "model.json").write_text(json.dumps(changed, indent=1) + "\n")
    agreement, (before, after) = compare(options.bundle, options.out, manifest, options.pictures)
    print(f"masks agree with IoU {agreement:.3f}; a picture takes {after:.2f} s, {before:.2f} s before ({options.out})")
    if agreement < LEAST_AGREEMENT:
        shutil.rmtree(options.out)
        sys.exit(f"the masks agree with less than {LEAST_AGREEMENT}; nothing is kept")


if __name__ == "__main__":
    main()
