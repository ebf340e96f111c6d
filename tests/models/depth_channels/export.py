"""Writes what the segmenter's training makes of depths, by `depth_channels` of
common/models/embedded/train_segmenter.py itself: maps of several sizes, with ramps, steps, unknown depths, and
depths far from the median.

    export.py OUT        # golden.json

Needs torch and numpy.
"""
import ast
import json
import pathlib
import sys

import numpy as np
import torch
import torch.nn.functional as F

root = pathlib.Path(__file__).resolve().parents[3]
source = (root / "common/models/embedded/train_segmenter.py").read_text()
of_training = [node for node in ast.parse(source).body if getattr(node, "name", "") == "depth_channels"]
scope = {"torch": torch, "F": F}
exec(compile(ast.Module(of_training, []), "train_segmenter.py", "exec"), scope)

rng = np.random.default_rng(4)
maps = []
for width, height, scale in [(9, 7, 1.0), (6, 8, 40.0), (3, 5, 0.02), (1, 1, 2.0)]:
    # Slopes from far below to far above the scale at which they saturate, and an outlier on each side of the
    # clamp.
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    logs = 0.02 * x - 0.005 * y * y + 0.004 * rng.standard_normal((height, width)) + 1.2 * (x > 6) + 0.3 * (y > 4)
    logs[height // 2, width // 2] += 9.0
    logs[0, width - 1] -= 9.0
    depth = (scale * np.exp(logs)).astype(np.float32)
    depth.ravel()[rng.permutation(depth.size)[:depth.size // 6]] = np.resize([0.0, -1.0, np.nan], depth.size // 6)
    channels = scope["depth_channels"](torch.from_numpy(depth)[None, None])[0]
    maps.append({
        "width_px": width,
        "depth_m": [None if np.isnan(d) else float(d) for d in depth.ravel()],
        "channels": [[round(float(v), 7) for v in pixel] for pixel in channels.permute(1, 2, 0).reshape(-1, 4)],
    })
pathlib.Path(sys.argv[1], "golden.json").write_text(json.dumps(maps, separators=(",", ":")) + "\n")
