#!/usr/bin/env python3
"""Converts a model of 32-bit floats to 16 bits for GPUs, with ONNX Runtime's own tools: constants are folded,
attention and normalisations become single operators where onnxruntime.transformers.optimizer knows the model,
weights become float16.

Tensors between programs keep 32 bits with --keep-io: Segment Anything needs that; image encoders of crops are quicker
without it. Write the new files' hashes into model.toml; vectors differ from those of the 32-bit files, and so does the
encoder's id.

usage: half_precision.py IN.onnx OUT.onnx --kind clip|vit --heads N --width N [--keep-io]
CLIP ViT-B/32 image encoder: --kind clip --heads 12 --width 768
Segment Anything ViT-B: vision encoder --kind vit --heads 12 --width 768 --keep-io
                        mask decoder   --kind vit --heads 8 --width 256 --keep-io
needs: onnx 1.23, onnxruntime 1.31 (or onnxruntime-gpu), sympy
"""
import argparse
import tempfile
from pathlib import Path

import onnx
import onnxruntime as ort
from onnxruntime.transformers import float16, optimizer

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("source", metavar="IN.onnx")
parser.add_argument("target", metavar="OUT.onnx")
parser.add_argument("--kind", choices=["clip", "vit"], required=True, help="the optimizer's model type")
parser.add_argument("--heads", type=int, required=True, help="attention heads")
parser.add_argument("--width", type=int, required=True, help="components of a token")
parser.add_argument("--keep-io", action="store_true", help="inputs and outputs keep 32 bits")
args = parser.parse_args()

with tempfile.TemporaryDirectory() as folder:
    # Now, because the runtime has no operators of 16 bits on the processor to fold constants with later.
    folded = str(Path(folder) / "folded.onnx")
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = folded
    ort.InferenceSession(args.source, options, providers=["CPUExecutionProvider"])
    model = onnx.load(folded)
    constants = {constant.name: constant for constant in model.graph.initializer}
    for output in model.graph.output:
        # The conversion expects every output to be a node's.
        if output.name in constants:
            constants[output.name].name = f"{output.name}_constant"
            model.graph.node.append(
                onnx.helper.make_node("Identity", [f"{output.name}_constant"], [output.name])
            )
    onnx.save(model, folded)
    fused = optimizer.optimize_model(
        folded, model_type=args.kind, num_heads=args.heads, hidden_size=args.width, opt_level=0, use_gpu=True
    )
fused.topological_sort()
half = float16.convert_float_to_float16(fused.model, keep_io_types=args.keep_io, disable_shape_infer=True)
onnx.save(half, args.target)
found = {name: n for name, n in fused.get_fused_operator_statistics().items() if n}
print(f"{args.target}: {len(half.graph.node)} nodes; fused {found}")
