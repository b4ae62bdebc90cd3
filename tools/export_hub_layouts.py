#!/usr/bin/env python3
"""Tiny random networks in the layouts of the Hugging Face hub, with answers of torch beside them, for tests.

    export_hub_layouts.py crates/uniground-models/tests/data/hub
    export_hub_layouts.py OUT --only sam2,edgetam

One folder per layout: what Transformers.js or Optimum write (config.json, preprocessor_config.json, tokenizer.json, ONNX), pictures, and
golden.json, whose values come from torch through transformers' own tokenizers and image processors. Every network is run in ONNX Runtime
on the same inputs; a difference above 1e-4 is a failure. Nothing is fetched: configurations, tokenizers and weights are made here, from
seeds. Run again with the same versions, it writes the same bytes.

Versions (Python 3.11):
    torch==2.15.0 torchvision==0.29.2 transformers==4.57.6 optimum==2.1.0 optimum-onnx==0.1.0 timm==1.0.31 tokenizers==0.22.2
    onnx==1.23.2 onnxruntime==1.32.0 onnxscript==0.7.2 pillow==13.0.0 numpy==2.4.6 segment-anything==1.0
"""

import argparse
import json
import logging
import math
import os
import pathlib
import shutil
import sys
import tempfile
import unittest.mock
import warnings

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["TOKENIZERS_PARALLELISM"] = "false"

import numpy as np
import onnx
import onnxruntime
import optimum.utils.logging
import torch
import transformers
from clip_tokenizer import bytes_to_unicode
from onnxruntime.quantization import QuantType, quantize_dynamic
from onnxruntime.transformers.float16 import convert_float_to_float16
from onnxruntime.transformers.onnx_model import OnnxModel
from optimum.exporters.onnx import export, main_export
from optimum.exporters.onnx.model_configs import (
    CLIPTextWithProjectionOnnxConfig,
    CLIPVisionModelOnnxConfig,
    SiglipTextOnnxConfig,
    SiglipVisionModelOnnxConfig,
)
from PIL import Image, ImageDraw
from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, processors
from torch.nn.functional import normalize

MOST = 1e-4  # Largest difference to torch.
CONTEXT = 16  # Tokens of a text.
WORDS = ["a", "red", "blue", "chair", "table", "the", "lamp", "next", "to", "on", "it", "is", "photo", "of"]
TEXTS = [
    "a red chair next to the table",
    "The BLUE Lamp",
    "it's a lamp, isn't it?! (12 photos)",
    "",
    "the red chair next to the blue table next to the lamp on the table next to the red photo of a chair",
    "un café façade, ü",
]
SMALL, LARGE = 32, 64  # Pictures of dual encoders and of segmenters.
PATCH = 16


# Pictures


def noise(size, seed):
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (size, size, 3), dtype=np.uint8))


def scene(width, height, seed):
    """Returns a smooth gradient with a disc and two boxes."""
    y, x = np.mgrid[0:height, 0:width]
    slopes = np.random.default_rng(seed).uniform(-1, 1, (3, 2))
    planes = [a * x / width + b * y / height for a, b in slopes]
    planes = [(p - p.min()) / (np.ptp(p) or 1) * 200 + 25 for p in planes]
    picture = Image.fromarray(np.stack(planes, -1).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    draw.ellipse([width * 0.1, height * 0.2, width * 0.45, height * 0.8], fill=(220, 40, 60))
    draw.rectangle([width * 0.55, height * 0.1, width * 0.9, height * 0.5], fill=(30, 70, 200))
    draw.rectangle([width * 0.6, height * 0.65, width * 0.75, height * 0.95], fill=(240, 230, 90))
    return picture


def save_pictures(folder, pictures):
    named = {f"picture_{i}.png": picture for i, picture in enumerate(pictures)}
    for name, picture in named.items():
        picture.save(folder / name)
    return named


# Networks


def randomize(model, seed):
    """Gives every parameter random values, large enough that different inputs come out different.

    Seeds below were picked among ten to forty tried per layout: for inputs that come out different, and for a difference to torch well below MOST.
    """
    generator = torch.Generator().manual_seed(seed)
    tables = {id(module.weight) for module in model.modules() if isinstance(module, torch.nn.Embedding)}
    with torch.no_grad():
        for name, value in sorted(model.named_parameters()):
            made = torch.randn(value.shape, generator=generator)
            if id(value) in tables:
                # Prompts are few tokens among many.
                value.copy_(made * (2.0 if "point" in name else 1.0))
            elif name.endswith("weight") and value.dim() == 1:
                value.copy_(1 + 0.1 * made)
            elif name.endswith("weight"):
                # Attention counts for more than in a real network and a picture's features for less, else prompts hardly change anything.
                gain = 2.2 if "_attn" in name else 0.3 if "neck.convs" in name else 1.4
                value.copy_(made * gain / math.sqrt(value[0].numel()))
            elif value.dim() > 0:
                value.copy_(0.1 * made if name.endswith("bias") else 0.3 * made)
    return model.eval()


def strip(file):
    """Rewrites a network without what only tells how it was exported: half of so small a file is names of what lies within."""
    model = onnx.load(str(file))
    public = {value.name for value in [*model.graph.input, *model.graph.output]}
    short = {"": ""}
    name = lambda long: long if long in public else short.setdefault(long, f"v{len(short)}")

    def within(graph):
        for value in [*graph.initializer, *graph.input, *graph.output]:
            value.name, value.doc_string = name(value.name), ""
        for value in [*graph.input, *graph.output]:
            del value.metadata_props[:]
        for node in graph.node:
            node.name = node.doc_string = ""
            del node.metadata_props[:]
            for values in (node.input, node.output):
                values[:] = [name(value) for value in values]
            for attribute in node.attribute:
                if attribute.type == onnx.AttributeProto.GRAPH:
                    within(attribute.g)
        graph.doc_string = ""
        del graph.value_info[:], graph.metadata_props[:]

    within(model.graph)
    model.doc_string = ""
    del model.metadata_props[:]
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(file))


def quantized(file):
    """8-bit weights as Transformers.js writes them (q8): unsigned where the network has convolutions, activations dynamic."""
    made = file.with_name(f"{file.stem}_quantized.onnx")
    kinds = {node.op_type for node in onnx.load(str(file)).graph.node}
    quantize_dynamic(str(file), str(made), weight_type=QuantType.QUInt8 if "Conv" in kinds else QuantType.QInt8,
                     extra_options={"EnableSubgraph": True, "MatMulConstBOnly": True})  # fmt: skip
    strip(made)
    return made


def halved(file):
    """Half precision within, float inputs and outputs, as Transformers.js writes it (fp16)."""
    made = file.with_name(f"{file.stem}_fp16.onnx")
    model = OnnxModel(convert_float_to_float16(onnx.load(str(file)), keep_io_types=True))
    # The converter puts its casts last.
    model.topological_sort()
    onnx.save(model.model, str(made))
    strip(made)
    return made


def run(file, inputs):
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    taken = {name: np.asarray(value) for name, value in inputs.items()}
    return dict(zip(names, session.run(names, taken), strict=True))


class Checks:
    """Compares what a network gives with what torch gave, and remembers the largest difference."""

    def __init__(self):
        self.worst = 0.0

    def __call__(self, what, made, known):
        known = known.detach().numpy() if isinstance(known, torch.Tensor) else known
        if made.shape != known.shape:
            sys.exit(f"{what}: {made.shape} instead of {known.shape}")
        difference = float(np.abs(made - known).max())
        self.worst = max(self.worst, difference)
        if not difference < MOST:
            sys.exit(f"{what} differs from torch by {difference:.1e}")


def traced(module, inputs, file, outputs, free, opset=18):
    file.parent.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        torch.onnx.export(module.eval(), tuple(inputs.values()), str(file), input_names=list(inputs), output_names=outputs,
                          dynamic_axes=free, opset_version=opset, dynamo=False)  # fmt: skip
    strip(file)


# Files


def digits(values, count):
    values = values.detach().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    return np.round(values.astype(np.float64), count).tolist()


def write_golden(folder, golden):
    lines = [f"{json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in golden.items()]
    (folder / "golden.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")


def keep(folder, *names):
    """Deletes what an exporter wrote besides these."""
    for path in folder.iterdir():
        if path.is_file() and path.suffix != ".onnx" and path.name not in names:
            path.unlink()


SIDE_FILES = ("config.json", "preprocessor_config.json", "tokenizer.json", "tokenizer_config.json")


# Tokenizers


def bpe_merges(words, symbols):
    """Merges that join each word from its left, in the order of the words; symbols: a word's letters as tokens."""
    merges = []
    for word in words:
        parts = symbols(word)
        for i in range(1, len(parts)):
            merge = ("".join(parts[:i]), parts[i])
            if merge not in merges:
                merges.append(merge)
    return merges


def clip_tokenizer():
    letters = list(bytes_to_unicode().values())
    merges = bpe_merges(WORDS, lambda word: [*word[:-1], word[-1] + "</w>"])
    tokens = letters + [letter + "</w>" for letter in letters] + ["".join(merge) for merge in merges] + ["<|startoftext|>", "<|endoftext|>"]
    with tempfile.TemporaryDirectory() as temporary:
        vocabulary, rules = pathlib.Path(temporary, "vocab.json"), pathlib.Path(temporary, "merges.txt")
        vocabulary.write_text(json.dumps({token: i for i, token in enumerate(tokens)}, ensure_ascii=False))
        # CLIP's reader leaves the first line out.
        rules.write_text("#version: 0.2\n" + "\n".join(" ".join(merge) for merge in merges) + "\n")
        return transformers.CLIPTokenizerFast(str(vocabulary), str(rules), model_max_length=CONTEXT)


def unigram(specials, unknown):
    """Words and letters with scores, as sentencepiece has them."""
    letters = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.,!?'()"
    pieces = [(token, 0.0) for token in specials] + [("▁", -4.0)]
    pieces += [("▁" + word, -5.0 - 0.1 * i) for i, word in enumerate(WORDS)]
    pieces += [("▁" + c, -7.0 - 0.01 * i) for i, c in enumerate(letters) if c not in WORDS]
    pieces += [(c, -8.0 - 0.01 * i) for i, c in enumerate(letters)]
    tokenizer = Tokenizer(models.Unigram(pieces, unk_id=specials.index(unknown)))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace(replacement="▁", prepend_scheme="always")
    tokenizer.decoder = decoders.Metaspace(replacement="▁", prepend_scheme="always")
    return tokenizer


def siglip_tokenizer():
    """Of SigLIP's kind: small letters, no punctuation, an end that is also what texts are filled up with."""
    tokenizer = unigram(["<pad>", "</s>", "<unk>"], "<unk>")
    punctuation = Regex(r"[!\"#$%&'()*+,\-./:;<=>?@\[\\\]^_`{|}~]")
    tokenizer.normalizer = normalizers.Sequence(
        [normalizers.Lowercase(), normalizers.Replace(punctuation, ""), normalizers.Replace(Regex(r"\s+"), " "), normalizers.Strip()]
    )
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    return transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, model_max_length=CONTEXT, eos_token="</s>", pad_token="</s>",
                                                unk_token="<unk>", model_input_names=["input_ids"])  # fmt: skip


def gemma_tokenizer():
    """Of SigLIP 2's kind: Gemma's byte pairs with bytes for what is unknown, letters as they are, an end and a filler of its own."""
    specials = ["<pad>", "<eos>", "<bos>", "<unk>"]
    letters = "▁abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.,!?'()"
    merges = bpe_merges([word + "▁" for word in WORDS] + WORDS, list)
    tokens = specials + [f"<0x{byte:02X}>" for byte in range(256)] + list(letters)
    tokens += [token for token in dict.fromkeys("".join(merge) for merge in merges) if token not in tokens]
    tokenizer = Tokenizer(
        models.BPE(vocab={token: i for i, token in enumerate(tokens)}, merges=merges, unk_token="<unk>", fuse_unk=True, byte_fallback=True)
    )
    tokenizer.normalizer = normalizers.Replace(" ", "▁")
    tokenizer.pre_tokenizer = pre_tokenizers.Split(" ", behavior="merged_with_previous")
    tokenizer.decoder = decoders.Sequence([decoders.Replace("▁", " "), decoders.ByteFallback(), decoders.Fuse()])
    return transformers.GemmaTokenizerFast(tokenizer_object=tokenizer, add_bos_token=False, add_eos_token=True, padding_side="right",
                                           model_max_length=CONTEXT, model_input_names=["input_ids"])  # fmt: skip


def xlm_tokenizer():
    """Of MetaCLIP 2's kind: XLM's."""
    tokenizer = unigram(["<s>", "<pad>", "</s>", "<unk>"], "<unk>")
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Replace(Regex(" {2,}"), " ")])
    tokenizer.post_processor = processors.TemplateProcessing(
        single="<s> $A </s>", pair="<s> $A </s> </s> $B </s>", special_tokens=[("<s>", 0), ("</s>", 2)]
    )
    return transformers.XLMRobertaTokenizerFast(tokenizer_object=tokenizer, model_max_length=CONTEXT)


# Dual encoders


def towers(vocabulary, **text):
    shared = {"hidden_size": 24, "intermediate_size": 48, "num_hidden_layers": 1, "num_attention_heads": 2}
    return {
        "text_config": {**shared, "vocab_size": vocabulary, "max_position_embeddings": CONTEXT, **text},
        "vision_config": {**shared, "image_size": SMALL, "patch_size": 8},
    }


def dual_encoder(kind, config, seed, scale, bias=None):
    model = randomize(kind(config), seed)
    with torch.no_grad():
        model.logit_scale.fill_(math.log(scale))
        if bias is not None:
            model.logit_bias.fill_(bias)
    return model


def clip_processor():
    return transformers.CLIPImageProcessor(size={"shortest_edge": SMALL}, crop_size={"height": SMALL, "width": SMALL})


def siglip_processor(resample):
    return transformers.SiglipImageProcessor(size={"height": SMALL, "width": SMALL}, resample=resample)


def save_sides(folder, model, tokenizer, processor):
    model.config.architectures = [type(model).__name__]
    model.config.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    processor.save_pretrained(folder)


def dual_golden(folder, model, tokenizer, processor, mask, **more):
    """Writes golden.json, and returns the inputs and all that torch makes of them."""
    pictures = save_pictures(folder, [noise(SMALL, 1), scene(75, 41, 2), scene(39, 70, 3)])
    words = tokenizer(TEXTS, padding="max_length", truncation=True, max_length=CONTEXT, return_tensors="pt", return_attention_mask=True)
    pixels = processor(images=list(pictures.values()), return_tensors="pt")["pixel_values"]
    inputs = {"input_ids": words["input_ids"], "pixel_values": pixels}
    if mask:
        inputs["attention_mask"] = words["attention_mask"]
    with torch.no_grad():
        made = model(**inputs)
    texts, images = normalize(made.text_embeds, dim=-1), normalize(made.image_embeds, dim=-1)
    golden = {
        "dim": texts.shape[1],
        "context": CONTEXT,
        "pad_id": tokenizer.pad_token_id,
        **more,
        "logit_scale": float(model.logit_scale.exp()),
        "logit_bias": float(model.logit_bias) if hasattr(model, "logit_bias") else None,
        "texts": [{"text": text, "ids": ids.tolist(), "embedding": digits(row, 7)} for text, ids, row in zip(TEXTS, inputs["input_ids"], texts)],
        "pictures": [{"file": name, "embedding": digits(row, 7)} for name, row in zip(pictures, images)],
        "logits": digits(made.logits_per_image, 5),
    }
    write_golden(folder, golden)
    return inputs, made


def alike(rows):
    rows = normalize(torch.as_tensor(rows), dim=-1)
    cosines = (rows @ rows.T)[~torch.eye(len(rows), dtype=torch.bool)]
    return f"{cosines.min():.3f} to {cosines.max():.3f}"


def nearest(rows, known):
    return float((normalize(torch.as_tensor(rows), dim=-1) * normalize(known, dim=-1)).sum(-1).min())


class ClipVisionConfig(CLIPVisionModelOnnxConfig):
    """As Optimum's, of the model with its projection."""

    @property
    def outputs(self):
        return {"image_embeds": {0: "batch_size"}, "last_hidden_state": {0: "batch_size"}}


class ClipTextConfig(CLIPTextWithProjectionOnnxConfig):
    """As Optimum's, whose embeddings would be named as if they had one per token."""

    @property
    def outputs(self):
        return {"text_embeds": {0: "batch_size"}, "last_hidden_state": {0: "batch_size", 1: "sequence_length"}}


def part(model, kind, config, make, file):
    """Exports one tower with the weights that it has in the whole model."""
    tower = kind(config).eval()
    missing = tower.load_state_dict(model.state_dict(), strict=False).missing_keys
    if [name for name in missing if not name.endswith("position_ids")]:
        sys.exit(f"{file.name}: no weights for {missing}")
    file.parent.mkdir(parents=True, exist_ok=True)
    export(model=tower, config=make(config, task="feature-extraction"), output=file)
    strip(file)
    return tower


def clip_split(folder, check):
    tokenizer, processor = clip_tokenizer(), clip_processor()
    # 2 is what OpenAI's configurations have, though it is not the tokenizer's: the network then looks for the largest id.
    config = transformers.CLIPConfig(**towers(len(tokenizer), eos_token_id=2, bos_token_id=0, pad_token_id=1), projection_dim=24)
    model = dual_encoder(transformers.CLIPModel, config, 20, 100.0)
    save_sides(folder, model, tokenizer, processor)
    keep(folder, *SIDE_FILES)
    vision, text = folder / "onnx/vision_model.onnx", folder / "onnx/text_model.onnx"
    config.vision_config.projection_dim = config.text_config.projection_dim = config.projection_dim
    part(model, transformers.CLIPVisionModelWithProjection, config.vision_config, ClipVisionConfig, vision)
    part(model, transformers.CLIPTextModelWithProjection, config.text_config, ClipTextConfig, text)
    inputs, known = dual_golden(folder, model, tokenizer, processor, True, lowercased_by_tokenizer=True)
    pictures, texts = {"pixel_values": inputs["pixel_values"]}, {"input_ids": inputs["input_ids"]}
    made = run(vision, pictures)["image_embeds"]
    check("image_embeds", made / np.linalg.norm(made, axis=-1, keepdims=True), known.image_embeds)
    made = run(text, texts)["text_embeds"]
    check("text_embeds", made / np.linalg.norm(made, axis=-1, keepdims=True), known.text_embeds)
    notes = [f"pictures {alike(known.image_embeds)}, texts {alike(known.text_embeds)}"]
    for lessen in (quantized, halved):
        # One at a time: dynamic quantization depends on its batch.
        eye, ear = lessen(vision), lessen(text)
        images = np.concatenate([run(eye, {"pixel_values": row[None]})["image_embeds"] for row in inputs["pixel_values"]])
        words = np.concatenate([run(ear, {"input_ids": row[None]})["text_embeds"] for row in inputs["input_ids"]])
        notes.append(f"{lessen.__name__}: cosine to torch {nearest(images, known.image_embeds):.4f}, {nearest(words, known.text_embeds):.4f}")
    return "; ".join(notes)


def siglip_split(folder, check):
    tokenizer, processor = siglip_tokenizer(), siglip_processor(Image.Resampling.BICUBIC)
    config = transformers.SiglipConfig(**towers(len(tokenizer), pad_token_id=1))
    model = dual_encoder(transformers.SiglipModel, config, 15, 117.33, -12.93)
    save_sides(folder, model, tokenizer, processor)
    settings = json.loads((folder / "tokenizer_config.json").read_text())
    settings |= {"tokenizer_class": "SiglipTokenizer", "do_lower_case": True}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings, indent=2, ensure_ascii=False) + "\n")
    keep(folder, *SIDE_FILES)
    vision, text = folder / "onnx/vision_model.onnx", folder / "onnx/text_model.onnx"
    image_tower = part(model, transformers.SiglipVisionModel, config.vision_config, SiglipVisionModelOnnxConfig, vision)
    text_tower = part(model, transformers.SiglipTextModel, config.text_config, SiglipTextOnnxConfig, text)
    inputs, known = dual_golden(folder, model, tokenizer, processor, False, lowercased_by_tokenizer=True)
    for file, tower, name, unit in [
        (vision, image_tower, "pixel_values", known.image_embeds), (text, text_tower, "input_ids", known.text_embeds),
    ]:  # fmt: skip
        made = run(file, {name: inputs[name]})
        with torch.no_grad():
            expected = tower(inputs[name])
        check(f"{file.name} last_hidden_state", made["last_hidden_state"], expected.last_hidden_state)
        check(f"{file.name} pooler_output", made["pooler_output"], expected.pooler_output)
        pooled = made["pooler_output"]
        check(f"{file.name} embedding", pooled / np.linalg.norm(pooled, axis=-1, keepdims=True), unit)
    return f"pictures {alike(known.image_embeds)}, texts {alike(known.text_embeds)}"


def by_optimum(folder, model, tokenizer, processor, variant="default"):
    """Exports with Optimum's command, from a folder as a user has it."""
    with tempfile.TemporaryDirectory() as temporary:
        model.save_pretrained(temporary)
        tokenizer and tokenizer.save_pretrained(temporary)
        processor.save_pretrained(temporary)
        shapes = {"sequence_length": CONTEXT} if tokenizer else {}
        main_export(temporary, output=folder, task="feature-extraction", _variant=variant, do_validation=False, **shapes)
    keep(folder, *SIDE_FILES)
    for file in folder.glob("*.onnx"):
        strip(file)
    settings = json.loads((folder / "config.json").read_text())
    # Of the folder it was exported from, which has another name each time.
    settings.pop("_name_or_path", None)
    (folder / "config.json").write_text(json.dumps(settings, indent=2, sort_keys=True) + "\n")


def joint(folder, check, model, tokenizer, processor, mask, **more):
    by_optimum(folder, model, tokenizer, processor)
    inputs, known = dual_golden(folder, model, tokenizer, processor, mask, **more)
    made = run(folder / "model.onnx", inputs)
    for name in ("logits_per_image", "logits_per_text", "text_embeds", "image_embeds"):
        check(name, made[name], known[name])
    return f"pictures {alike(known.image_embeds)}, texts {alike(known.text_embeds)}"


def clip_joint(folder, check):
    tokenizer = clip_tokenizer()
    ids = {"bos_token_id": tokenizer.bos_token_id, "eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id}
    config = transformers.CLIPConfig(**towers(len(tokenizer), **ids), projection_dim=24)
    model = dual_encoder(transformers.CLIPModel, config, 13, 37.5)
    return joint(folder, check, model, tokenizer, clip_processor(), True, lowercased_by_tokenizer=True)


def siglip_joint(folder, check):
    tokenizer = gemma_tokenizer()
    config = transformers.SiglipConfig(**towers(len(tokenizer), pad_token_id=0, bos_token_id=2, eos_token_id=1))
    model = dual_encoder(transformers.SiglipModel, config, 11, 112.67, -16.77)
    return joint(folder, check, model, tokenizer, siglip_processor(Image.Resampling.BILINEAR), False, lowercased_by_tokenizer=False)


def metaclip2_split(folder, check):
    tokenizer, processor = xlm_tokenizer(), clip_processor()
    ids = {"bos_token_id": 0, "eos_token_id": 2, "pad_token_id": 1}
    config = transformers.MetaClip2Config(**towers(len(tokenizer), **ids), projection_dim=24)
    model = dual_encoder(transformers.MetaClip2Model, config, 17, 100.0)
    by_optimum(folder, model, tokenizer, processor, "split")
    inputs, known = dual_golden(folder, model, tokenizer, processor, True, lowercased_by_tokenizer=False)
    images = run(folder / "vision_model.onnx", {"pixel_values": inputs["pixel_values"]})["image_embeds"]
    words = {name: inputs[name] for name in ("input_ids", "attention_mask")}
    texts = run(folder / "text_model.onnx", words)["text_embeds"]
    check("image_embeds", images / np.linalg.norm(images, axis=-1, keepdims=True), known.image_embeds)
    check("text_embeds", texts / np.linalg.norm(texts, axis=-1, keepdims=True), known.text_embeds)
    return f"pictures {alike(known.image_embeds)}, texts {alike(known.text_embeds)}"


# Segmenters


def segmenter_pictures(folder):
    return save_pictures(folder, [noise(LARGE, 4), scene(90, 63, 5)])


def prompts_of(picture, box):
    """One point, one to have and one to leave, and a box as points labelled 2 and 3, in pixels of the picture."""
    width, height = picture.size
    prompts = [
        ([[width // 4, height // 2]], [1]),
        ([[width // 4, height // 2], [(width * 7) // 10, height // 3]], [1, 0]),
    ]
    if box:
        prompts.append(([[width // 10, height // 5], [width // 2, (height * 4) // 5]], [2, 3]))
    return prompts


def described(points, labels, iou, masks, **more):
    """iou: one value per mask, masks: one low-resolution picture of logits per value."""
    return {"points": points, "labels": labels, "iou": digits(iou, 6), "masks": digits(masks.reshape(len(iou), -1), 5), **more}


def apart(found):
    """How alike the first masks of different prompts and pictures are."""
    return alike(np.stack([np.array(prompt["masks"][0]) for picture in found for prompt in picture["prompts"]]))


def sam_split(folder, check):
    config = transformers.SamConfig(
        vision_config={
            "hidden_size": 16, "output_channels": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": LARGE,
            "patch_size": PATCH, "window_size": 3, "global_attn_indexes": [1], "mlp_dim": 32, "num_pos_feats": 16,
        },
        prompt_encoder_config={"hidden_size": 32, "image_size": LARGE, "patch_size": PATCH, "mask_input_channels": 8},
        mask_decoder_config={"hidden_size": 32, "mlp_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "iou_head_hidden_dim": 32},
    )  # fmt: skip
    torch.manual_seed(16)
    model = randomize(transformers.SamModel(config), 17)
    images = transformers.SamImageProcessor(
        size={"longest_edge": LARGE}, mask_size={"longest_edge": 4 * LARGE // PATCH}, pad_size={"height": LARGE, "width": LARGE},
        mask_pad_size={"height": 4 * LARGE // PATCH, "width": 4 * LARGE // PATCH},
    )  # fmt: skip
    processor = transformers.SamProcessor(images)
    by_optimum(folder, model, None, processor)
    found, box_equal = [], []
    for name, picture in segmenter_pictures(folder).items():
        entry = {"file": name}
        for points, labels in prompts_of(picture, box=False):
            inputs = processor(picture, input_points=[[points]], input_labels=[[labels]], return_tensors="pt")
            # The processor makes doubles of coordinates.
            inputs["input_points"] = inputs["input_points"].float()
            sizes = inputs["reshaped_input_sizes"][0].tolist()
            entry |= {"scale_x": sizes[1] / picture.width, "scale_y": sizes[0] / picture.height, "resized": sizes[::-1]}
            with torch.no_grad():
                known = model(inputs["pixel_values"], inputs["input_points"], inputs["input_labels"])
            embedded = run(folder / "vision_encoder.onnx", {"pixel_values": inputs["pixel_values"]})
            prompt = {"input_points": inputs["input_points"], "input_labels": inputs["input_labels"]}
            made = run(folder / "prompt_encoder_mask_decoder.onnx", {**embedded, **prompt})
            check("iou_scores", made["iou_scores"], known.iou_scores)
            check("pred_masks", made["pred_masks"], known.pred_masks)
            scaled = digits(inputs["input_points"][0, 0], 4)
            entry.setdefault("prompts", []).append(described(points, labels, known.iou_scores[0, 0], known.pred_masks[0, 0], network_points=scaled))
        corners = prompts_of(picture, box=True)[2][0]
        inputs = processor(
            picture, input_points=[[corners]], input_labels=[[[2, 3]]], input_boxes=[[[*corners[0], *corners[1]]]], return_tensors="pt"
        )
        with torch.no_grad():
            as_box = model(inputs["pixel_values"], input_boxes=inputs["input_boxes"].float())
            as_points = model(inputs["pixel_values"], inputs["input_points"].float(), inputs["input_labels"])
        box_equal.append(torch.allclose(as_box.pred_masks, as_points.pred_masks, atol=MOST))
        found.append(entry)
    golden = {
        "size": LARGE, "mask_size": 4 * LARGE // PATCH, "num_masks": 3, "box_as_points_equal": all(box_equal),
        "coordinates": "network pixels = picture pixels * (scale_x, scale_y), where scale is the rounded resized side over the picture's; "
        "the network adds 0.5 itself, and a padding point (label -1) itself",
        "resize": "longest side to size, the other to int(side * scale + 0.5); bilinear; normalized; then padded with zeros right and below",
        "pictures": found,
    }  # fmt: skip
    write_golden(folder, golden)
    return f"masks {apart(found)}; a box as points labelled 2, 3 {'equals' if all(box_equal) else 'is not'} a box"


class Sam2Vision(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        return tuple(self.model.get_image_embeddings(pixel_values))


class Sam2Decoder(torch.nn.Module):
    """One prompt of points, or as many prompts as there are boxes, or one of points and a box, as the files for Transformers.js take them.

    Points without a box get no padding point here: transformers adds it only where boxes are None, which a network's input cannot be.
    """

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, input_points, input_labels, input_boxes, *embeddings):
        model, batch = self.model, embeddings[-1].shape[0]
        # ONNX Runtime's Concat makes room for a tensor of no elements where its other sides differ, and leaves there whatever the memory had.
        # So there is always one box, and where none was given its corners are cut off. Slices end where there is nothing more.
        boxes = input_boxes.shape[1]
        some = input_boxes[:, :1].shape[1]
        padded = torch.cat([input_boxes, input_boxes.new_zeros(batch, 1 - some, 4)], dim=1)
        corners = model.prompt_encoder._embed_boxes(padded)[:, :, : 3 * some]
        points = model.prompt_encoder._embed_points(input_points, input_labels, pad=False)
        sparse = torch.cat([points.expand(-1, boxes + 1 - some, -1, -1), corners], dim=2)
        side = model.prompt_encoder.image_embedding_size
        dense = model.prompt_encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(batch, -1, *side)
        masks, iou, _, present = model.mask_decoder(
            image_embeddings=embeddings[-1],
            image_positional_embeddings=model.get_image_wide_positional_embeddings().repeat(batch, 1, 1, 1),
            sparse_prompt_embeddings=sparse, dense_prompt_embeddings=dense, multimask_output=True,
            high_resolution_features=list(embeddings[:-1]),
        )  # fmt: skip
        return iou, masks, present


def sam2_like(folder, check, model):
    """What SAM 2 and its likes have in common: files, names, golden answers."""
    model.config.architectures = [type(model).__name__]
    model.config.save_pretrained(folder)
    side = 4 * LARGE // PATCH
    images = transformers.Sam2ImageProcessorFast(size={"height": LARGE, "width": LARGE}, mask_size={"height": side, "width": side})
    processor = transformers.Sam2Processor(images)
    processor.save_pretrained(folder)
    keep(folder, "config.json", "preprocessor_config.json")
    encoder, decoder = folder / "onnx/vision_encoder.onnx", folder / "onnx/prompt_encoder_mask_decoder.onnx"
    levels = [f"image_embeddings.{i}" for i in range(3)]
    generator = torch.Generator().manual_seed(1)
    example = torch.randn(2, 3, LARGE, LARGE, generator=generator)
    batch = {0: "batch_size"}
    traced(Sam2Vision(model), {"pixel_values": example}, encoder, levels, {name: batch for name in ["pixel_values", *levels]})
    with torch.no_grad():
        embedded = model.get_image_embeddings(example)
    prompts = {
        "input_points": torch.rand(2, 1, 2, 2, generator=generator) * LARGE,
        "input_labels": torch.ones(2, 1, 2, dtype=torch.int64),
        "input_boxes": torch.rand(2, 3, 4, generator=generator) * LARGE,
    }
    many = {0: "batch_size", 1: "num_boxes_or_points"}
    free = {
        "input_points": {0: "batch_size", 2: "num_points_per_image"},
        "input_labels": {0: "batch_size", 2: "num_points_per_image"},
        "input_boxes": {0: "batch_size", 1: "num_boxes_per_image"},
        **{name: batch for name in levels}, "iou_scores": many, "pred_masks": many, "object_score_logits": many,
    }  # fmt: skip
    answers = ["iou_scores", "pred_masks", "object_score_logits"]
    traced(Sam2Decoder(model), prompts | dict(zip(levels, embedded)), decoder, answers, free)

    def compare(what, made, known):
        for name in answers:
            check(f"{what} {name}", made[name], known[name])

    found, box_equal, unpadded = [], [], []
    for name, picture in segmenter_pictures(folder).items():
        entry = {"file": name, "scale_x": LARGE / picture.width, "scale_y": LARGE / picture.height, "prompts": []}
        for points, labels in prompts_of(picture, box=True):
            boxed = labels == [2, 3]
            inputs = processor(picture, input_points=[[points]], input_labels=[[labels]], input_boxes=[[[*points[0], *points[1]]]] if boxed else None,
                               return_tensors="pt")  # fmt: skip
            pixels, points_in, labels_in = inputs["pixel_values"], inputs["input_points"], inputs["input_labels"]
            with torch.no_grad():
                # transformers adds a padding point where there is no box.
                known = model(pixels, points_in.clone(), labels_in)
                bare = dict(zip(answers, Sam2Decoder(model)(points_in, labels_in, torch.zeros(1, 0, 4), *known.image_embeddings)))
            made = run(encoder, {"pixel_values": pixels})
            for level, expected in zip(levels, known.image_embeddings):
                check(level, made[level], expected)
            no_boxes = np.zeros((1, 0, 4), np.float32)
            padded = {
                "input_points": torch.nn.functional.pad(points_in, (0, 0, 0, 1)), "input_labels": torch.nn.functional.pad(labels_in, (0, 1), value=-1),
                "input_boxes": no_boxes,
            }  # fmt: skip
            compare("padded points", run(decoder, made | padded), known)
            compare("points", run(decoder, made | {"input_points": points_in, "input_labels": labels_in, "input_boxes": no_boxes}), bare)
            unpadded.append(float((bare["iou_scores"] - known.iou_scores).abs().max()))
            more = {"object_score_logit": digits(known.object_score_logits[0, 0, 0], 6), "iou_without_pad": digits(bare["iou_scores"][0, 0], 6)}
            if boxed:
                with torch.no_grad():
                    as_box = model(pixels, input_boxes=inputs["input_boxes"].clone())
                box_equal.append(torch.allclose(as_box.pred_masks, known.pred_masks, atol=MOST))
                none = {"input_points": np.zeros((1, 1, 0, 2), np.float32), "input_labels": np.zeros((1, 1, 0), np.int64)}
                compare("box", run(decoder, made | none | {"input_boxes": inputs["input_boxes"]}), as_box)
            scaled = digits(points_in[0, 0], 4)
            entry["prompts"].append(described(points, labels, known.iou_scores[0, 0], known.pred_masks[0, 0], network_points=scaled, **more))
        found.append(entry)
    golden = {
        "size": LARGE, "mask_size": side, "num_masks": 3, "box_as_points_equal": all(box_equal), "pad_point": True,
        "coordinates": "network pixels = picture pixels * (scale_x, scale_y) = (size / width, size / height); the network adds 0.5 itself, but no "
        "padding point: to these values belong the points and one more at (0, 0), labelled -1, with input_boxes of shape [1, 0, 4]; "
        "iou_without_pad is what comes out without it",
        "resize": "squashed to size x size, bilinear",
        "pictures": found,
    }  # fmt: skip
    write_golden(folder, golden)
    return (
        f"masks {apart(found)}; a box as points labelled 2, 3 {'equals' if all(box_equal) else 'is not'} a box; "
        f"without a padding point iou differs by up to {max(unpadded):.3f}"
    )


def sam2_parts(config, **vision):
    return config(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 32, "image_size": LARGE, "patch_size": PATCH, "mask_input_channels": 8},
        mask_decoder_config={"hidden_size": 32, "mlp_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "iou_head_hidden_dim": 32},
    )  # fmt: skip


SAM2_NECK = {"backbone_feature_sizes": [[LARGE // 4] * 2, [LARGE // 8] * 2, [LARGE // 16] * 2], "fpn_hidden_size": 32}


def tie(model):
    """The prompts' grid of frequencies is the pictures', as in every checkpoint."""
    model.prompt_encoder.shared_embedding.positional_embedding.copy_(model.shared_image_embedding.positional_embedding)
    return model


def sam2(folder, check):
    backbone = {
        "hidden_size": 8, "image_size": [LARGE, LARGE], "embed_dim_per_stage": [8, 16, 32, 64], "blocks_per_stage": [1, 1, 2, 1],
        "num_attention_heads_per_stage": [1, 2, 2, 4], "window_size_per_stage": [8, 4, 3, 2], "global_attention_blocks": [3], "mlp_ratio": 2.0,
    }  # fmt: skip
    config = sam2_parts(transformers.Sam2Config, backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], **SAM2_NECK)
    torch.manual_seed(17)
    return sam2_like(folder, check, tie(randomize(transformers.Sam2Model(config), 20)))


def edgetam(folder, check):
    # RepViT as EdgeTAM has it, thinner and with fewer blocks.
    arguments = {"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3], "embed_dim": [8, 16, 32, 48], "depth": [1, 1, 1, 1]}
    backbone = {"model_type": "timm_wrapper", "architecture": "repvit_m1", "model_args": arguments}
    config = sam2_parts(transformers.EdgeTamConfig, backbone_config=backbone, backbone_channel_list=[48, 32, 16, 8], **SAM2_NECK)
    torch.manual_seed(18)
    model = tie(randomize(transformers.EdgeTamModel(config), 25))
    # Batch normalization needs to have seen something, else numbers grow from layer to layer.
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = None
    with torch.no_grad():
        model.vision_encoder.train()(torch.randn(4, 3, LARGE, LARGE, generator=torch.Generator().manual_seed(3)))
    # Saved as a difference to what is usual, which would be fetched.
    usual = transformers.TimmWrapperConfig(architecture="repvit_m1", model_args=arguments)
    with unittest.mock.patch("transformers.AutoConfig.from_pretrained", return_value=usual):
        return sam2_like(folder, check, model.eval())


class PixelEncoder(torch.nn.Module):
    """An encoder that reads pixels [height, width, 3], 0 to 255, whose longer side has the network's size."""

    def __init__(self, sam):
        super().__init__()
        self.sam = sam

    def forward(self, input_image):
        planes = input_image.permute(2, 0, 1)[None]
        planes = (planes - self.sam.pixel_mean) / self.sam.pixel_std
        height, width = planes.shape[-2:]
        return self.sam.image_encoder(torch.nn.functional.pad(planes, (0, LARGE - width, 0, LARGE - height)))


def sam_official(folder, check):
    from segment_anything.modeling import ImageEncoderViT, MaskDecoder, PromptEncoder, Sam, TwoWayTransformer
    from segment_anything.utils.onnx import SamOnnxModel
    from segment_anything.utils.transforms import ResizeLongestSide

    class Decoder(SamOnnxModel):
        """With the repair that segment_anything got after 1.0, where the exported network cut masks as for the picture it was traced with."""

        def mask_postprocessing(self, masks, orig_im_size):
            masks = torch.nn.functional.interpolate(masks, size=(self.img_size, self.img_size), mode="bilinear", align_corners=False)
            size = self.resize_longest_image_size(orig_im_size, self.img_size).to(torch.int64)
            masks = masks[..., : size[0], : size[1]]
            height, width = orig_im_size.to(torch.int64)
            return torch.nn.functional.interpolate(masks, size=(height, width), mode="bilinear", align_corners=False)

    depth, grid = 32, LARGE // PATCH
    torch.manual_seed(19)
    sam = Sam(
        ImageEncoderViT(
            depth=2, embed_dim=16, img_size=LARGE, mlp_ratio=2, num_heads=2, patch_size=PATCH, qkv_bias=True, use_rel_pos=True,
            global_attn_indexes=[1], window_size=3, out_chans=depth,
        ),
        PromptEncoder(embed_dim=depth, image_embedding_size=(grid, grid), input_image_size=(LARGE, LARGE), mask_in_chans=8),
        MaskDecoder(
            num_multimask_outputs=3, transformer=TwoWayTransformer(depth=1, embedding_dim=depth, mlp_dim=32, num_heads=2),
            transformer_dim=depth, iou_head_depth=3, iou_head_hidden_dim=32,
        ),
        [123.675, 116.28, 103.53], [58.395, 57.12, 57.375],
    )  # fmt: skip
    sam = randomize(sam, 18)
    folder.mkdir(parents=True, exist_ok=True)
    encoder, decoder = folder / "encoder.onnx", folder / "decoder.onnx"
    generator = torch.Generator().manual_seed(2)
    traced(sam.image_encoder, {"images": torch.randn(1, 3, LARGE, LARGE, generator=generator)}, encoder, ["image_embeddings"], None, 17)
    # As MobileSAM is published: the network normalizes and pads itself. The answers are the same.
    mobile = folder.parent / "mobile-sam"
    shutil.rmtree(mobile, ignore_errors=True)
    pixels = torch.randint(0, 256, (45, LARGE, 3), generator=generator).float()
    free = {"input_image": {0: "image_height", 1: "image_width"}}
    traced(PixelEncoder(sam), {"input_image": pixels}, mobile / "mobile_sam_image_encoder.onnx", ["image_embeddings"], free, 17)

    # As scripts/export_onnx_model.py does it.
    inputs = {
        "image_embeddings": torch.randn(1, depth, grid, grid, generator=generator),
        "point_coords": torch.randint(0, LARGE, (1, 5, 2), generator=generator).float(),
        "point_labels": torch.randint(0, 4, (1, 5), generator=generator).float(),
        "mask_input": torch.randn(1, 1, 4 * grid, 4 * grid, generator=generator),
        "has_mask_input": torch.tensor([1.0]),
        "orig_im_size": torch.tensor([63.0, 90.0]),
    }
    free = {"point_coords": {1: "num_points"}, "point_labels": {1: "num_points"}}
    own = Decoder(sam, return_single_mask=False).eval()
    traced(own, inputs, decoder, ["masks", "iou_predictions", "low_res_masks"], free, 17)
    shutil.copy(decoder, mobile / "sam_mask_decoder_multi.onnx")

    transform = ResizeLongestSide(LARGE)
    found, box_equal, unpadded = [], [], []
    for name, picture in segmenter_pictures(folder).items():
        size = (picture.height, picture.width)
        resized = transform.apply_image(np.array(picture))
        pixels = sam.preprocess(torch.as_tensor(resized).permute(2, 0, 1)[None].float())
        with torch.no_grad():
            embedding = sam.image_encoder(pixels)
        made = run(encoder, {"images": pixels})
        check("image_embeddings", made["image_embeddings"], embedding)
        entry = {"file": name, "scale_x": resized.shape[1] / picture.width, "scale_y": resized.shape[0] / picture.height}
        entry |= {"resized": [resized.shape[1], resized.shape[0]], "prompts": []}
        for points, labels in prompts_of(picture, box=True):
            boxed = labels == [2, 3]
            coords = torch.as_tensor(transform.apply_coords(np.array(points), size), dtype=torch.float32)[None]
            given = torch.tensor([labels])
            with torch.no_grad():
                sparse, dense = sam.prompt_encoder(points=None, boxes=coords.reshape(1, 4), masks=None) if boxed else sam.prompt_encoder(
                    points=(coords, given), boxes=None, masks=None
                )  # fmt: skip
                low, iou = sam.mask_decoder.predict_masks(embedding, sam.prompt_encoder.get_dense_pe(), sparse, dense)
                masks = sam.postprocess_masks(low, resized.shape[:2], size)
            fixed = {
                "mask_input": torch.zeros(1, 1, 4 * grid, 4 * grid), "has_mask_input": torch.zeros(1),
                "orig_im_size": torch.tensor([float(side) for side in size]),
            }  # fmt: skip
            bare = {"point_coords": coords, "point_labels": given.float()}
            padded = {
                "point_coords": torch.nn.functional.pad(coords, (0, 0, 0, 1)),
                "point_labels": torch.nn.functional.pad(given.float(), (0, 1), value=-1),
            }
            answer = run(decoder, {**made, **(bare if boxed else padded), **fixed})
            check("low_res_masks", answer["low_res_masks"], low)
            check("iou_predictions", answer["iou_predictions"], iou)
            check("masks", answer["masks"], masks)
            _, bare_iou, bare_low = own(embedding, **bare, **fixed)
            if boxed:
                box_equal.append(torch.allclose(bare_low, low, atol=MOST))
            else:
                unpadded.append(float((bare_iou - iou).abs().max()))
            more = {"pad_point": not boxed, "iou_without_pad": digits(bare_iou[0], 6)}
            entry["prompts"].append(described(points, labels, iou[0], low[0], network_points=digits(coords[0], 4), **more))
        found.append(entry)
    golden = {
        "size": LARGE, "mask_size": 4 * grid, "num_masks": 4, "box_as_points_equal": all(box_equal),
        "mean": [123.675, 116.28, 103.53], "std": [58.395, 57.12, 57.375],
        "coordinates": "network pixels = picture pixels * (scale_x, scale_y), where scale is the rounded resized side over the picture's; the network "
        "adds 0.5 itself, but no padding point: where pad_point is true, one more at (0, 0), labelled -1, belongs to these values",
        "resize": "longest side to size, the other to int(side * scale + 0.5); bilinear; (pixel - mean) / std; then padded with zeros right and below",
        "pictures": found,
    }  # fmt: skip
    write_golden(folder, golden)
    return (
        f"masks {apart(found)}; a box as points labelled 2, 3 {'equals' if all(box_equal) else 'is not'} a box; "
        f"without a padding point iou differs by up to {max(unpadded):.3f}"
    )


LAYOUTS = {
    "clip-split": clip_split, "siglip-split": siglip_split, "sam-split": sam_split, "sam2": sam2, "clip-joint": clip_joint,
    "siglip-joint": siglip_joint, "metaclip2-split": metaclip2_split, "edgetam": edgetam, "sam-official": sam_official,
}  # fmt: skip


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("out", type=pathlib.Path, metavar="OUT")
    arguments.add_argument("--only", metavar="NAMES", help=f"some of {','.join(LAYOUTS)}")
    args = arguments.parse_args()
    names = args.only.split(",") if args.only else list(LAYOUTS)
    if unknown := [name for name in names if name not in LAYOUTS]:
        arguments.error(f"no layout {unknown[0]}; there are {', '.join(LAYOUTS)}")

    warnings.filterwarnings("ignore")
    logging.getLogger().setLevel(logging.ERROR)
    transformers.logging.set_verbosity_error()
    optimum.utils.logging.set_verbosity_error()
    torch.set_num_threads(1)
    for name in names:
        folder, check = args.out / name, Checks()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        notes = LAYOUTS[name](folder, check)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        print(f"{name}: {size} bytes, differs from torch by {check.worst:.1e}; cosines between different inputs: {notes}")


if __name__ == "__main__":
    main()
