#!/usr/bin/env python3
"""A model repository for Triton, made of bundles: each network with the name uniground asks for, and its tensors written down.

usage: make_repository.py REPOSITORY BUNDLE... [--cpu] [--instances 1]

Needs the Python package onnx. Then:
    tritonserver --model-repository=REPOSITORY --disable-auto-complete-config
    uniground serve --inference-url http://HOST:8000 --masks BUNDLE --encoder BUNDLE

A bundle that is there already is written anew. Networks are linked where they lie on the same disk, copied otherwise.
"""
import argparse
import json
import os
import shutil
import sys
from pathlib import Path

import onnx

# What a bundle's networks may take and give.
TYPES = {onnx.TensorProto.FLOAT: "TYPE_FP32", onnx.TensorProto.INT64: "TYPE_INT64"}
PARTS = {"dual-encoder": ["image", "text"], "promptable-segmenter": ["encoder", "decoder"]}


class Wrong(Exception):
    """What is wrong with a bundle, in a sentence."""


def wanted_tensors(part):
    """Names of the tensors that uniground gives to a network, and takes from it, by its part of the manifest."""
    named = lambda field: [name for name in field.values() if name] if isinstance(field, dict) else [field]
    given = [name for key in ("input", "inputs", "input_ids", "attention_mask") if part.get(key) for name in named(part[key])]
    return given, [name for key in ("output", "outputs") if part.get(key) for name in named(part[key])]


def tensors(values, file):
    """Name, type and sizes of a network's tensors; -1 where a size may be any."""
    for value in values:
        tensor = value.type.tensor_type
        if tensor.elem_type not in TYPES:
            datatype = onnx.TensorProto.DataType.Name(tensor.elem_type)
            raise Wrong(f"{file}: the tensor {value.name} has the type {datatype}; {', '.join(TYPES.values())} are known")
        yield value.name, TYPES[tensor.elem_type], [size.dim_value if size.HasField("dim_value") else -1 for size in tensor.shape.dim]


def stored(graph):
    """Every tensor that is part of a network, those of networks within it included."""
    yield from graph.initializer
    for attribute in (attribute for node in graph.node for attribute in node.attribute):
        yield attribute.t
        yield from attribute.tensors
        for within in [attribute.g, *attribute.graphs]:
            yield from stored(within)


def configuration(name, network, file, kind, instances):
    """The text of config.pbtxt. Sizes are whole, their first included: Triton puts no requests together. Prompts and pictures come many at
    once already, and what an embedding is must not depend on who else asks at that moment."""
    # What is trained has a value of its own beside its name, and is no input.
    trained = {value.name for value in network.graph.initializer}
    inputs = [value for value in network.graph.input if value.name not in trained]
    lines = [f'name: "{name}"', 'backend: "onnxruntime"', f'default_model_filename: "{file.name}"', "max_batch_size: 0"]
    for word, values in (("input", inputs), ("output", network.graph.output)):
        lines += [f'{word} [ {{ name: "{tensor}" data_type: {datatype} dims: {sizes} }} ]' for tensor, datatype, sizes in tensors(values, file)]
    return "\n".join([*lines, f"instance_group [ {{ kind: {kind} count: {instances} }} ]"]) + "\n"


def place(source, target):
    """The same file at another place."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def add(repository, bundle, kind, instances):
    """Puts the networks of a bundle there; their names."""
    try:
        manifest = json.loads((bundle / "model.json").read_text())
    except (OSError, ValueError) as error:
        raise Wrong(f"{bundle / 'model.json'}: {error}") from error
    if manifest.get("kind") not in PARTS:
        raise Wrong(f"{bundle / 'model.json'}: kind is {manifest.get('kind')!r}; {', '.join(PARTS)} are known")
    for part in PARTS[manifest["kind"]]:
        file = bundle / manifest[part]["file"]
        try:
            network = onnx.load(file, load_external_data=False)
        except Exception as error:  # whatever protobuf says
            raise Wrong(f"{file}: this is no ONNX network: {error}") from error
        for wanted, there in zip(wanted_tensors(manifest[part]), (network.graph.input, network.graph.output)):
            missing = set(wanted) - {value.name for value in there}
            if missing:
                raise Wrong(f"{file}: model.json names {', '.join(sorted(missing))}, which the network does not have")
        # As uniground calls it: crates/uniground-endpoints/src/inference/kserve.rs.
        name = f"{manifest['name']}-{file.name.split('.')[0]}"
        version = repository / name / "1"
        version.mkdir(parents=True, exist_ok=True)
        # Weights beside a network lie beside it there, too.
        beside = {entry.value for tensor in stored(network.graph) for entry in tensor.external_data if entry.key == "location"}
        for needed in [file.name, *sorted(beside)]:
            place(bundle / needed, version / needed)
        (repository / name / "config.pbtxt").write_text(configuration(name, network, file, kind, instances))
        yield name


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("repository", type=Path)
    parser.add_argument("bundles", type=Path, nargs="+", metavar="bundle")
    parser.add_argument("--cpu", action="store_true", help="compute on processors instead of cards")
    parser.add_argument("--instances", type=int, default=1, help="of each network, on each card: how many requests are computed at once")
    args = parser.parse_args()
    try:
        for bundle in args.bundles:
            for name in add(args.repository, bundle, "KIND_CPU" if args.cpu else "KIND_GPU", args.instances):
                print(name)
    except Wrong as wrong:
        sys.exit(str(wrong))


if __name__ == "__main__":
    main()
