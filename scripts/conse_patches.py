"""Makes a model with vectors of patches of the ConSE encoder: the words of its classes at each place, as class
activation maps show them (Zhou et al. 2016), before the average over the photo. Patches were measured against
crops with it (docs/decisions.md).

    conse_patches.py MODELS CONSE OUT SIZE_PX

MODELS: the folder with image_encoder/ and clip_text/; CONSE: the model.toml of the encoder; SIZE_PX: 224 times a power of 2.
Needs onnx and numpy. Crops are halved to 224 pixels, the size of the encoder, so their vectors hardly change.
"""
import hashlib
import pathlib
import re
import shutil
import sys

import numpy as np
import onnx
from onnx import helper, numpy_helper

STRIDE_PX, CROP_PX = 32, 224
models, conse, out = (pathlib.Path(path).resolve() for path in sys.argv[1:4])
size_px = int(sys.argv[4])
side = size_px // STRIDE_PX
out.mkdir(parents=True, exist_ok=True)
model = onnx.load(models / "image_encoder/conse_mnv2_int8.onnx")
graph = model.graph
weights = {tensor.name for tensor in graph.initializer}
nodes = []


def copied(node, prefix, entry, axis=None, inputs=None):
    """Adds a node whose tensors, but for weights, get a prefix; `entry` stands for the photo."""
    named = lambda name: name if name in weights else entry if name == "image" else f"{prefix}{name}"
    made = helper.make_node(node.op_type, inputs or [named(x) for x in node.input], [named(x) for x in node.output])
    made.attribute.extend(a for a in node.attribute if axis is None or a.name not in ("axis", "axes"))
    if axis is not None:
        made.attribute.append(helper.make_attribute("axes" if node.op_type == "ReduceL2" else "axis", axis))
    nodes.append(made)
    return named


# Crops: halved, then as they were.
entry = "image"
for k in range((size_px // CROP_PX).bit_length() - 1):
    nodes.append(helper.make_node("AveragePool", [entry], [f"half_{k}"], kernel_shape=[2, 2], strides=[2, 2]))
    entry = f"half_{k}"
for node in graph.node:
    copied(node, "crop_", entry)
# Patches: all places of the last feature map in place of their mean; then [n, places, classes], and the
# classes' axis is the last.
is_head = False
for node in graph.node:
    if node.op_type == "GlobalAveragePool":
        nodes.append(helper.make_node("Identity", [f"at_{node.input[0]}"], [f"at_{node.output[0]}"]))
    elif node.op_type == "Flatten":
        is_head = True
        nodes.append(helper.make_node("Reshape", [f"at_{node.input[0]}", "places"], ["at_flat"]))
        nodes.append(helper.make_node("Transpose", ["at_flat"], [f"at_{node.output[0]}"], perm=[0, 2, 1]))
    elif is_head and node.op_type in ("Unsqueeze", "Squeeze"):
        copied(node, "at_", "image", inputs=[f"at_{node.input[0]}", "row"])
    elif is_head and node.op_type == "ReduceL2":
        copied(node, "at_", "image", axis=[-1])
    elif is_head and (node.op_type in ("TopK", "Softmax") or node.op_type == "Gather" and node.input[1].startswith("keep")):
        copied(node, "at_", "image", axis=-1)
    else:
        copied(node, "at_", "image")
made = helper.make_graph(
    nodes, "conse_patches",
    [helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, ["N", 3, size_px, size_px])],
    [helper.make_tensor_value_info("crop_embedding", onnx.TensorProto.FLOAT, ["N", 512]),
     helper.make_tensor_value_info("at_embedding", onnx.TensorProto.FLOAT, ["N", side * side, 512])],
    [*graph.initializer, numpy_helper.from_array(np.array([0, -1, side * side], np.int64), "places"),
     numpy_helper.from_array(np.array([2], np.int64), "row")])
path = out / "image.onnx"
onnx.save(helper.make_model(made, opset_imports=model.opset_import, ir_version=model.ir_version), path)

text = conse.read_text()
shutil.copytree(models / "clip_text", out / "clip_text", dirs_exist_ok=True)
sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
text = re.sub(r"files_root = .*\n", "", text)
text = re.sub(r'file = { path = "image_encoder[^}]*}', f'file = {{ path = "image.onnx", sha256 = "{sha256}" }}', text)
text = text.replace('output = "embedding"', 'output = "crop_embedding"').replace("size_px = 224", f"size_px = {size_px}")
text = text.replace("normalise = false\n", f'normalise = false\npatches = {{ output = "at_embedding", patch_px = {STRIDE_PX} }}\n')
text = text.replace('name = "conse-mobilenetv2"', f'name = "conse-patches-{size_px}"').replace("batch = 16\n", "batch = 4\n")
(out / "model.toml").write_text(text)
