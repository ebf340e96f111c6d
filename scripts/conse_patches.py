"""Makes a model with vectors of patches of the ConSE encoder: what its classes say at each place, as class activation maps
do (Zhou et al. 2016), before the average over the photo. With it `encode --regions patches|both` was measured against crops
(docs/accuracy.md).

    conse_patches.py MODELS OUT SIZE_PX    # MODELS: the folder with image_encoder/ and clip_text/; SIZE_PX: a multiple of 224

Needs onnx and numpy. Crops are seen at 224 pixels as without patches: they are halved until they have that size.
"""
import hashlib
import pathlib
import sys

import numpy as np
import onnx
from onnx import helper, numpy_helper

STRIDE_PX, CROP_PX = 32, 224
models, out, size_px = pathlib.Path(sys.argv[1]).resolve(), pathlib.Path(sys.argv[2]), int(sys.argv[3])
out.mkdir(parents=True, exist_ok=True)
graph = onnx.load(models / "image_encoder/conse_mnv2_int8.onnx").graph
weights = {tensor.name for tensor in graph.initializer}
[pool] = [node for node in graph.node if node.op_type == "GlobalAveragePool"]
constants = [numpy_helper.from_array(np.array(value, np.int64), name) for name, value in [("last", [-1]), ("row", [2])]]


def patches():
    """The network without its pooling; from its logits on, along the last axis of [n, places, classes]."""
    rename, nodes = {pool.output[0]: pool.input[0]}, []
    of = lambda name: name if name in weights or name == "image" else rename.get(name, f"p_{name}")
    rename = {name: f"p_{to}" for name, to in rename.items()}
    for node in graph.node:
        if node is pool:
            continue
        made = helper.make_node(node.op_type, [of(x) for x in node.input], [of(x) for x in node.output])
        made.attribute.extend(node.attribute)
        attributes = {a.name: a for a in made.attribute}
        if node.op_type == "Flatten":
            flat, turned = f"{made.output[0]}_flat", made.output[0]
            nodes.append(helper.make_node("Reshape", [made.input[0], "places"], [flat]))
            nodes.append(helper.make_node("Transpose", [flat], [turned], perm=[0, 2, 1]))
            continue
        if node.op_type in ("TopK", "Softmax") or (node.op_type == "Gather" and node.input[0].startswith("flatten")):
            helper_axis = [attribute for attribute in made.attribute if attribute.name != "axis"]
            del made.attribute[:]
            made.attribute.extend([*helper_axis, helper.make_attribute("axis", -1)])
        if node.op_type in ("Unsqueeze", "Squeeze"):
            made.input[1] = "row"
        if node.op_type == "ReduceL2":
            attributes["axes"].ints[:] = [-1]
        nodes.append(made)
    nodes[-1].output[0] = "patch_embeddings"
    return nodes


crops = []
halves = "image"
for k in range((size_px // CROP_PX).bit_length() - 1):
    crops.append(helper.make_node("AveragePool", [halves], [f"half_{k}"], kernel_shape=[2, 2], strides=[2, 2]))
    halves = f"half_{k}"
for node in graph.node:
    node.input[:] = [halves if name == "image" else name for name in node.input]
crops += list(graph.node)
for node in graph.node:
    node.input[:] = ["image" if name == halves else name for name in node.input]
dense = patches()
for node in crops:
    node.input[:] = [halves if name == "image" and node.op_type != "AveragePool" else name for name in node.input]
side = size_px // STRIDE_PX
constants.append(numpy_helper.from_array(np.array([0, 0, side * side], np.int64)[[0, 0, 2]], "places"))
