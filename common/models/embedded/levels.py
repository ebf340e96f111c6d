"""Makes levels_f16.onnx and levels_f32.onnx: levels of an image's channels to pixel values, on the device of
the model.

values[n][c][y][x] = levels[n][c][y][x] * scale[c] + offset[c]. Levels come plane by plane: a GPU takes longer to split pixels
into planes than to do everything else.
usage: levels.py FOLDER
needs: onnx 1.23
"""
import sys

from onnx import TensorProto, checker, helper, save

OPSET, IR_VERSION = 17, 8  # understood since ONNX Runtime 1.12

for name, kind in (("f16", TensorProto.FLOAT16), ("f32", TensorProto.FLOAT)):
    nodes = [
        helper.make_node("Cast", ["levels"], ["numbers"], to=kind),
        helper.make_node("Mul", ["numbers", "scale"], ["scaled"]),
        helper.make_node("Add", ["scaled", "offset"], ["values"]),
    ]
    inputs = [
        helper.make_tensor_value_info("levels", TensorProto.UINT8, ["n", 3, "height", "width"]),
        helper.make_tensor_value_info("scale", kind, [3, 1, 1]),
        helper.make_tensor_value_info("offset", kind, [3, 1, 1]),
    ]
    values = helper.make_tensor_value_info("values", kind, ["n", 3, "height", "width"])
    graph = helper.make_graph(nodes, "levels", inputs, [values])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    checker.check_model(model)
    save(model, f"{sys.argv[1]}/levels_{name}.onnx")
