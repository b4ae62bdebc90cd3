#!/usr/bin/env python3
"""A model of segment-anything's kind (SAM, MobileSAM) as a bundle: model.json, encoder.onnx, decoder.onnx.

    export_sam.py models/sam-vit-h  --type vit_h --checkpoint sam_vit_h_4b8939.pth
    export_sam.py models/mobile-sam --module mobile_sam --type vit_t --checkpoint mobile_sam.pt

The decoder takes a batch of prompts and gives low-resolution logits; enlarging them is the caller's work. --int8 puts an encoder with 8-bit
weights into the manifest. Every network written is run against torch; a difference above --parity is a failure. Needs torch, onnx,
onnxruntime and the model's own package.
"""

import argparse
import importlib
import json
import pathlib
import sys

import numpy as np
import onnxruntime
import torch
import weight_only


class Encoder(torch.nn.Module):
    def __init__(self, sam):
        super().__init__()
        self.encoder = sam.image_encoder

    def forward(self, image):
        return self.encoder(image)


class Decoder(torch.nn.Module):
    """(embeddings, points, labels) -> (low-resolution logits, predicted IoUs) for a batch of prompts"""

    def __init__(self, sam):
        super().__init__()
        self.prompts, self.masks = sam.prompt_encoder, sam.mask_decoder
        self.size = float(sam.image_encoder.img_size)
        self.register_buffer("grid", self.prompts.get_dense_pe().detach())

    def tokens(self, coords, labels):
        tokens = self.prompts.pe_layer._pe_encoding((coords + 0.5) / self.size)
        labels = labels.unsqueeze(-1)
        tokens = tokens * (labels != -1) + self.prompts.not_a_point_embed.weight * (labels == -1)
        for label in range(self.prompts.num_point_embeddings):
            tokens = tokens + self.prompts.point_embeddings[label].weight * (labels == label)
        return tokens

    def forward(self, image_embeddings, point_coords, point_labels):
        return self.masks.predict_masks(
            image_embeddings=image_embeddings, image_pe=self.grid,
            sparse_prompt_embeddings=self.tokens(point_coords, point_labels),
            dense_prompt_embeddings=self.prompts.no_mask_embed.weight.reshape(1, -1, 1, 1),
        )  # fmt: skip


def difference(file, inputs, expected, most):
    made = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"]).run(None, {k: v.numpy() for k, v in inputs.items()})
    for own, known in zip(made, expected):
        relative = float(np.abs(own - known.numpy()).max() / np.abs(known.numpy()).max())
        print(f"{file.name} {list(own.shape)}: {file.stat().st_size / 1e6:.1f} MB, differs from torch by {relative:.1e} of the largest value")
        if not relative <= most:
            sys.exit(f"{file.name} is not the model: {relative:.1e}, at most {most:.0e} is asked")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("--module", default="segment_anything")
    arguments.add_argument("--type", default="vit_h", help="key of the module's sam_model_registry")
    weights = arguments.add_mutually_exclusive_group(required=True)
    weights.add_argument("--checkpoint")
    weights.add_argument("--random", type=int, metavar="SEED", help="random weights, for tests")
    arguments.add_argument("--int8", action="store_true")
    arguments.add_argument("--name", help="of the bundle; the folder's name by default")
    arguments.add_argument("--licence", default="Apache-2.0")
    args = arguments.parse_args()

    torch.manual_seed(args.random or 0)
    # Wrappers start in training mode and torch.onnx.export restores it: a parity check would then compare training with inference.
    sam = importlib.import_module(args.module).sam_model_registry[args.type](checkpoint=args.checkpoint).eval()
    encoder, decoder = Encoder(sam).eval(), Decoder(sam).eval()
    args.out.mkdir(parents=True, exist_ok=True)
    size = sam.image_encoder.img_size
    grid, depth = sam.prompt_encoder.image_embedding_size[0], sam.prompt_encoder.embed_dim

    encoder_file, decoder_file = args.out / "encoder.onnx", args.out / "decoder.onnx"
    picture = {"image": torch.randn(1, 3, size, size)}
    prompts = {
        "image_embeddings": torch.randn(1, depth, grid, grid),
        "point_coords": torch.rand(2, 3, 2) * size,
        "point_labels": torch.tensor([[1.0, 0.0, -1.0], [1.0, 1.0, -1.0]]),
    }
    free = {0: "prompts", 1: "points"}
    with torch.no_grad():
        torch.onnx.export(encoder, picture["image"], str(encoder_file), input_names=["image"], output_names=["image_embeddings"],
                          opset_version=17, dynamo=False)  # fmt: skip
        torch.onnx.export(
            decoder, tuple(prompts.values()), str(decoder_file), input_names=list(prompts), output_names=["low_res_masks", "iou_predictions"],
            dynamic_axes={"point_coords": free, "point_labels": free, "low_res_masks": {0: "prompts"}, "iou_predictions": {0: "prompts"}},
            opset_version=17, dynamo=False,
        )  # fmt: skip
        # Other inputs than those used for tracing.
        picture["image"] = torch.randn(1, 3, size, size)
        prompts |= {"point_coords": torch.rand(3, 2, 2) * size, "point_labels": torch.tensor([[1.0, -1.0]] * 3)}
        embedded = [encoder(picture["image"])]
        difference(encoder_file, picture, embedded, 1e-3)
        difference(decoder_file, prompts, decoder(*prompts.values()), 1e-3)
    if args.int8:
        from onnxruntime.quantization import QuantType, quantize_dynamic

        small = encoder_file.with_suffix(".int8.onnx")
        quantize_dynamic(str(encoder_file), str(small), weight_type=QuantType.QInt8, per_channel=True, reduce_range=True,
                         op_types_to_quantize=["MatMul"])  # fmt: skip
        weight_only.convert(str(small), str(small))
        encoder_file = small
        difference(encoder_file, picture, embedded, 0.1)

    manifest = {
        "kind": "promptable-segmenter", "family": "sam", "name": args.name or args.out.resolve().name,
        "encoder": {
            "file": encoder_file.name, "input": "image", "outputs": {"image_embed": "image_embeddings"}, "size": size,
            "resize": "longest-side-pad", "interpolation": "bilinear", "value_range": "0-255",
            "mean": [round(float(v), 3) for v in sam.pixel_mean.flatten()], "std": [round(float(v), 3) for v in sam.pixel_std.flatten()],
        },
        "decoder": {
            "file": decoder_file.name,
            "inputs": {
                "image_embed": "image_embeddings", "high_res_feats_0": None, "high_res_feats_1": None, "point_coords": "point_coords",
                "point_labels": "point_labels", "mask_input": None, "has_mask_input": None, "orig_im_size": None,
            },
            "outputs": {"masks": "low_res_masks", "iou": "iou_predictions"},
            "mask_size": 4 * grid, "multimask": True, "num_masks": 4, "multimask_first": 1, "single_mask": 0,
            "dynamic_batch": True, "max_batch": 2, "accelerated_batch": 64, "pad_point": True, "mask_threshold": 0.0,
        },
        "licence": args.licence,
        "source": f"{args.module} {args.type} " + (pathlib.Path(args.checkpoint).name if args.checkpoint else f"random seed {args.random}"),
    }  # fmt: skip
    (args.out / "model.json").write_text(json.dumps(manifest, indent=1))
    print(f"{args.out}: now `uniground models verify {args.out}`")


if __name__ == "__main__":
    main()
