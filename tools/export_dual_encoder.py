#!/usr/bin/env python3
"""A model of open_clip (Perception Encoder, CLIP, SigLIP-like) as a bundle: model.json, image.onnx, text.onnx, tokenizer.json.

    export_dual_encoder.py models/pe-b16     --model PE-Core-B-16      --pretrained meta
    export_dual_encoder.py models/pe-l14     --model PE-Core-L-14-336  --pretrained meta
    export_dual_encoder.py models/pe-g14     --model PE-Core-bigG-14-448 --pretrained meta --int8 weight-only
    export_dual_encoder.py models/clip-b32   --model ViT-B-32          --pretrained checkpoint.pt

--int8 writes 8-bit networks next to the float ones and puts them into the manifest: "dynamic" is fastest, but embeddings depend on their
batch (uniground then runs one image at a time); "weight-only" is as small and does not. Every network written is run against torch on
inputs it was not traced with; a cosine below --parity is a failure. Needs torch, open_clip_torch, onnx, onnxruntime, tokenizers.
"""

import argparse
import json
import pathlib
import sys

import clip_tokenizer
import numpy as np
import onnxruntime
import open_clip
import torch
import weight_only
from torch.nn.functional import normalize

RESIZE = {"shortest": "shortest-center-crop", "squash": "squash", "longest": "longest-pad"}
PARITY = {"float": 0.9999, "int8": 0.99}


class ImageTower(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        return normalize(self.model.encode_image(pixel_values), dim=-1)


class TextTower(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, input_ids):
        return normalize(self.model.encode_text(input_ids), dim=-1)


def preprocessing(model, name, tag):
    """Returns the model's image preprocessing from its published recipe."""
    recipe = dict(getattr(model.visual, "preprocess_cfg", {}) or {})
    tags = open_clip.list_pretrained_tags_by_model(name)
    published = tag if tag in tags else next(iter(tags), None)
    if published:
        known = open_clip.get_pretrained_cfg(name, published) or {}
        recipe |= {key: known[key] for key in ("mean", "std", "interpolation", "resize_mode") if key in known}
    size = model.visual.image_size
    return {
        "size": list(size) if isinstance(size, (tuple, list)) else [size, size],
        "resize": RESIZE[recipe.get("resize_mode") or "shortest"],
        "interpolation": recipe.get("interpolation") or "bicubic",
        "mean": list(recipe.get("mean") or open_clip.OPENAI_DATASET_MEAN),
        "std": list(recipe.get("std") or open_clip.OPENAI_DATASET_STD),
    }


def tokenizer_of(name):
    own = open_clip.get_tokenizer(name)
    if not isinstance(own, open_clip.tokenizer.SimpleTokenizer):
        sys.exit(f"{name} has a {type(own).__name__}: put its own tokenizer.json into the bundle, padded and cut to {own.context_length} tokens")
    clean = "canonicalize" if "canonicalize" in own.clean_fn.__name__ else "lower"
    tokenizer = clip_tokenizer.build(open_clip.tokenizer.default_bpe(), own.context_length, clean=clean)
    sentences = ["a red chair next to the dining table", "Don't stop!", "", "3 chairs, 12 cups & 1 TV", "naïve façade", "日本語", "the " * 90]
    wrong = [text for text in sentences if tokenizer.encode(text).ids != own([text])[0].tolist()]
    if wrong:
        sys.exit(f"the tokenizer differs from open_clip's on {wrong}")
    return tokenizer, own.context_length


def export(tower, example, file, names):
    (source, target) = names
    with torch.no_grad():
        torch.onnx.export(
            tower, example, str(file), input_names=[source], output_names=[target], opset_version=17, dynamo=False,
            dynamic_axes={source: {0: "batch"}, target: {0: "batch"}},
        )  # fmt: skip


def quantize(file, kind):
    from onnxruntime.quantization import QuantType, quantize_dynamic

    small = file.with_suffix(".int8.onnx")
    quantize_dynamic(str(file), str(small), weight_type=QuantType.QInt8, per_channel=True, reduce_range=True,
                     op_types_to_quantize=["MatMul", "Gemm", "Gather"])  # fmt: skip
    if kind == "weight-only":
        weight_only.convert(str(small), str(small))
    return small


def parity(tower, file, source, inputs, least):
    """Returns the lowest cosine between torch and the written network, on inputs that were not used for tracing."""
    with torch.no_grad():
        expected = tower(inputs).numpy()
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    # One at a time: this is not a test of how dynamic quantization behaves with batches.
    made = np.concatenate([session.run(None, {source: row[None].numpy()})[0] for row in inputs])
    cosine = (expected * made).sum(1) / np.linalg.norm(expected, axis=1) / np.linalg.norm(made, axis=1)
    apart = min(float(expected[i] @ expected[j]) for i in range(len(expected)) for j in range(i))
    print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB, cosine to torch {cosine.min():.6f} (between inputs {apart:.2f})")
    if not cosine.min() >= least:
        sys.exit(f"{file.name} is not the model: cosine {cosine.min():.6f}, at least {least} is asked")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("--model", required=True, help="open_clip's name")
    weights = arguments.add_mutually_exclusive_group(required=True)
    weights.add_argument("--pretrained", help="open_clip's tag, or a checkpoint")
    weights.add_argument("--random", type=int, metavar="SEED", help="random weights, for tests")
    arguments.add_argument("--int8", choices=["dynamic", "weight-only"])
    arguments.add_argument("--name", help="of the bundle; the folder's name by default")
    arguments.add_argument("--template", default="a photo of a {}.", help="what nouns are put into")
    arguments.add_argument("--licence", default="")
    args = arguments.parse_args()

    # Has no ONNX form.
    torch.backends.mha.set_fastpath_enabled(False)
    torch.manual_seed(args.random or 0)
    model = open_clip.create_model(args.model, pretrained=args.pretrained).eval()
    tokenizer, context = tokenizer_of(args.model)
    image = preprocessing(model, args.model, args.pretrained)
    width, height = image["size"]
    args.out.mkdir(parents=True, exist_ok=True)

    words = lambda texts: torch.tensor([encoding.ids for encoding in tokenizer.encode_batch(texts)])
    towers = {
        "image": (ImageTower(model).eval(), "pixel_values", torch.randn(2, 3, height, width), torch.randn(3, 3, height, width)),
        "text": (TextTower(model).eval(), "input_ids", words(["a photo of a cat", "two chairs"]), words(["a red mug", "the sofa by the window", "x"])),
    }  # fmt: skip
    files = {}
    for part, (tower, source, example, others) in towers.items():
        file = args.out / f"{part}.onnx"
        export(tower, example, file, (source, f"{part}_embeds"))
        parity(tower, file, source, others, PARITY["float"])
        if args.int8:
            file = quantize(file, args.int8)
            parity(tower, file, source, others, PARITY["int8"])
        files[part] = file.name
    tokenizer.save(str(args.out / "tokenizer.json"))
    with torch.no_grad():
        dimensions = towers["text"][0](words(["a"])).shape[1]
    manifest = {
        "kind": "dual-encoder",
        "name": args.name or args.out.resolve().name,
        "embedding_dim": dimensions,
        "logit_scale": round(float(model.logit_scale.exp()), 3) if args.random is None else 100.0,
        "image": {"file": files["image"], "input": "pixel_values", "output": "image_embeds", **image, "dynamic_batch": True},
        "text": {
            "file": files["text"], "input_ids": "input_ids", "attention_mask": None, "output": "text_embeds",
            "tokenizer": "tokenizer.json", "context_length": context, "pad_id": 0, "template": args.template,
        },
        "licence": args.licence,
        "source": f"open_clip {args.model} " + (args.pretrained or f"random seed {args.random}"),
    }  # fmt: skip
    (args.out / "model.json").write_text(json.dumps(manifest, indent=1))
    print(f"{args.out}: now `uniground models verify {args.out}`")


if __name__ == "__main__":
    main()
