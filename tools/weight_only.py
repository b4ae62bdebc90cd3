#!/usr/bin/env python3
"""Converts a dynamically quantized network to one with 8-bit weights only: weight_only.py IN.onnx OUT.onnx

Dynamic quantization scales activations over the whole batch, so that an embedding depends on its neighbors; uniground then runs one image at
a time. Here the 8-bit weights stay and activations are floats, so batches change nothing."""

import sys

import onnx
from onnx import helper, numpy_helper


def convert(source, target):
    """DynamicQuantizeLinear(x) . MatMulInteger(xq, Wq) . Cast . Mul(scales)  ->  MatMul(x, DequantizeLinear(Wq))"""
    model = onnx.load(source)
    graph = model.graph
    weights = {i.name: i for i in graph.initializer}
    made_by = {output: node for node in graph.node for output in node.output}
    used_by = {}
    for node in graph.node:
        for name in node.input:
            used_by.setdefault(name, []).append(node)
    dropped, replaced = set(), {}
    for node in graph.node:
        if node.op_type != "MatMulInteger":
            continue
        quantized, weight, _, zero = node.input
        source_node = made_by[quantized]
        (cast,) = used_by[node.output[0]]
        (product,) = used_by[cast.output[0]]
        scales = made_by[next(name for name in product.input if name != cast.output[0])]
        scale = next(name for name in scales.input if name != source_node.output[1])
        per_channel = numpy_helper.to_array(weights[scale]).size > 1
        if not per_channel:
            for name in (scale, zero):
                if weights[name].dims:
                    weights[name].CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weights[name]).reshape(()), name))
        plain = f"{weight}_dequantized"
        replaced[id(product)] = [
            helper.make_node("DequantizeLinear", [weight, scale, zero], [plain], name=plain, **({"axis": 1} if per_channel else {})),
            helper.make_node("MatMul", [source_node.input[0], plain], [product.output[0]], name=f"{plain}_product"),
        ]
        dropped |= {id(node), id(cast), id(product), id(scales)}
    nodes = [new for node in graph.node for new in replaced.get(id(node), [] if id(node) in dropped else [node])]
    used = {name for node in nodes for name in node.input} | {output.name for output in graph.output}
    nodes = [node for node in nodes if node.op_type != "DynamicQuantizeLinear" or any(name in used for name in node.output)]
    used = {name for node in nodes for name in node.input}
    kept = [weight for weight in graph.initializer if weight.name in used]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(nodes)
    graph.initializer.extend(kept)
    onnx.checker.check_model(model)
    onnx.save(model, target)
    return len(replaced)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(f"{convert(*sys.argv[1:])} products have 8-bit weights and float activations")
