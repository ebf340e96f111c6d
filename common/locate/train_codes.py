"""Learns the directions of codes from descriptors: descriptors PHOTO... | python train_codes.py src/codes-1.bin (numpy 2.4.6).

Version 1: 48 photos of the development scene house_a (every second) and the 18 of brighton. Principal axes, each
divided by the fourth root of its variance, then turned at random so that all bits carry as much. On photo pairs of yard_d
(nearest neighbours, mutual, ratio 0.8): 753 of 4,083 matches agree with the true epipolar geometry; without the division
830 of 6,580, turned by iterative quantisation instead 756 of 4,424, full descriptors 910 of 3,493.
"""
import sys

import numpy as np

descriptors = np.frombuffer(sys.stdin.buffer.read(), "<f4").reshape(-1, 128).astype(np.float64)
mean = np.round(descriptors.mean(0) * 1000)
centred = descriptors - mean / 1000
variances, axes = np.linalg.eigh(centred.T @ centred / len(centred))
scales = np.maximum(variances, variances.max() * 1e-4) ** -0.25
turn = np.linalg.qr(np.random.default_rng(1).normal(size=(128, 128)))[0]
directions = (axes * scales @ turn).T
directions = np.round(directions / np.abs(directions).max(1, keepdims=True) * 127)
with open(sys.argv[1], "wb") as out:
    out.write(mean.astype(np.uint8).tobytes() + directions.astype(np.int8).tobytes())
