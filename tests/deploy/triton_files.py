"""Builds a Triton model repository from the tests' small bundles and reads it with Triton's own schema."""
import shutil
import sys
import tempfile
from pathlib import Path

import onnx
from google.protobuf import text_format
from tritonclient.grpc.model_config_pb2 import DataType, ModelConfig

from tools import complaints

DATA = Path(__file__).resolve().parents[2] / "crates" / "uniground-models" / "tests" / "data"
BUNDLES = ["tiny-dual-encoder", "tiny-segmenter", "tiny-segmenter-sam"]
NETWORKS = {f"{bundle}-{part}" for bundle in BUNDLES for part in (("image", "text") if "dual" in bundle else ("encoder", "decoder"))}
TYPES = {onnx.TensorProto.FLOAT: DataType.TYPE_FP32, onnx.TensorProto.INT64: DataType.TYPE_INT64}


def repository(deploy):
    tool = [sys.executable, deploy / "triton" / "make_repository.py"]
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "repository"
        wrong = complaints([*tool, made, *[DATA / bundle for bundle in BUNDLES], "--cpu", "--instances", "2"])
        if wrong:
            return wrong
        if {folder.name for folder in made.iterdir()} != NETWORKS:
            wrong.append(f"there are {sorted(folder.name for folder in made.iterdir())}, uniground asks for {sorted(NETWORKS)}")
        for folder in sorted(made.iterdir()):
            wrong += [f"{folder.name}: {what}" for what in network(folder)]
        return wrong + beside(tool, Path(scratch)) + refusals(tool, Path(scratch))


def network(folder):
    """Returns the errors of one network of the repository."""
    try:
        config = text_format.Parse((folder / "config.pbtxt").read_text(), ModelConfig())
    except text_format.ParseError as error:
        return [f"config.pbtxt: {error}"]
    file = folder / "1" / config.default_model_filename
    if not file.is_file():
        return [f"{file.name} is not there"]
    graph = onnx.load(file, load_external_data=False).graph
    wrong = []
    for word, told, there in (("input", config.input, graph.input), ("output", config.output, graph.output)):
        described = [(tensor.name, tensor.data_type, list(tensor.dims)) for tensor in told]
        real = [(value.name, TYPES[value.type.tensor_type.elem_type], [size.dim_value or -1 for size in value.type.tensor_type.shape.dim]) for value in there]
        if described != real:
            wrong.append(f"{word}: {described} is told, the network has {real}")
    if (config.name, config.backend, config.max_batch_size) != (folder.name, "onnxruntime", 0):
        wrong.append(f"name, backend and batch: {config.name}, {config.backend}, {config.max_batch_size}")
    if [(group.kind, group.count) for group in config.instance_group] != [(config.instance_group[0].KIND_CPU, 2)]:
        wrong.append(f"instances: {config.instance_group}")
    return wrong


def beside(tool, scratch):
    """Checks that a network with external weights includes them."""
    bundle, made = scratch / "large", scratch / "with-weights"
    shutil.copytree(DATA / "tiny-segmenter", bundle)
    for file in ("decoder.onnx", "decoder.onnx.data"):
        shutil.copyfile(DATA / "external-weights" / file, bundle / file)
    wrong = complaints([*tool, made, bundle])
    there = {file.name for file in (made / "tiny-segmenter-decoder" / "1").glob("*")}
    return wrong or [] if there == {"decoder.onnx", "decoder.onnx.data"} else [*wrong, f"weights beside a network: there is {sorted(there)}"]


# Faults of a bundle: the file, the text to replace, its replacement, and what the tool must name.
WRONG = {
    "a tensor that is not there": ("model.json", '"point_coords": "point_coords"', '"point_coords": "points"', "decoder.onnx: model.json names points"),
    "a kind that is not known": ("model.json", "promptable-segmenter", "segmenter", "model.json: kind is 'segmenter'"),
    "a network that is none": ("encoder.onnx", None, "no network", "encoder.onnx"),
    "no manifest": ("model.json", None, "", "model.json"),
}


def refusals(tool, scratch):
    """Checks that an invalid bundle is refused with a message that names the file."""
    wrong = []
    for what, (file, old, new, named) in WRONG.items():
        bundle = scratch / what
        shutil.copytree(DATA / "tiny-segmenter", bundle)
        (bundle / file).write_text(new if old is None else (bundle / file).read_text().replace(old, new))
        said = complaints([*tool, scratch / "refused", bundle])
        wrong += [] if len(said) == 1 and named in said[0] else [f"{what}: {said or 'nothing is said'}"]
    return wrong
