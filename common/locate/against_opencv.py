"""OpenCV's SIFT with whole descriptors, and poselib, on the photos of `slag-lab eval locate`: the depth is the splat's.

usage: against_opencv.py SCENE DRAWN [SCENE DRAWN ...]    after `slag-encoder draw --depth --out DRAWN` at the scene's poses
Needs numpy, opencv-python-headless and poselib.
"""

import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import poselib

SIFT = cv2.SIFT_create(1200, contrastThreshold=0.02)
MATCHER = cv2.BFMatcher(cv2.NORM_L2)
MAX_RATIO, SAME_PLACE, MIN_INLIERS = 0.85, 0.1, 20


def views(path):
    """Photos with world-to-camera matrices (OpenCV axes) and intrinsics, in the order of names."""
    poses = json.loads(path.read_text())
    for frame in sorted(poses["frames"], key=lambda frame: frame["file_path"]):
        world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        intrinsics = [frame.get(name, poses.get(name)) for name in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
        yield path.parent / frame["file_path"], np.linalg.inv(world_from_camera), intrinsics


def features(photo):
    keypoints, descriptors = SIFT.detectAndCompute(cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE), None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    descriptors = np.sqrt(descriptors / (descriptors.sum(1, keepdims=True) + 1e-9)).astype(np.float32)
    return np.array([keypoint.pt for keypoint in keypoints]) + 0.5, descriptors


def observe(view, drawn):
    """Points in the world and descriptors, where the drawing has a surface."""
    photo, camera_from_world, (width, height, fx, fy, cx, cy) = view
    depth, coverage = (np.load(drawn / name / f"{photo.stem}.npy") for name in ("depth", "coverage"))
    for (x, y), descriptor in zip(*features(photo)):
        column, row = int(x), int(y)
        if not (1 <= column < width - 1 and 1 <= row < height - 1):
            continue
        around = np.s_[row - 1 : row + 2, column - 1 : column + 2]
        near, z = depth[around].min(), depth[row, column]
        if coverage[around].min() >= 0.5 and depth[around].max() - near <= 0.05 * near:
            in_camera = np.array([(x - cx) / fx * z, (y - cy) / fy * z, z])
            yield camera_from_world[:3, :3].T @ (in_camera - camera_from_world[:3, 3]), descriptor


def locate(view, points, descriptors):
    """Errors in metres and degrees; None where too few matches agree."""
    photo, truth, (width, height, fx, fy, cx, cy) = view
    at, found = features(photo)
    pairs = []
    for best, *others in MATCHER.knnMatch(found, descriptors, k=6) if len(found) else []:
        place = points[best.trainIdx]
        rivals = [other for other in others if np.linalg.norm(points[other.trainIdx] - place) > SAME_PLACE]
        if not rivals or best.distance <= MAX_RATIO * rivals[0].distance:
            pairs.append((at[best.queryIdx], place))
    if len(pairs) < 8:
        return None
    camera = {"model": "PINHOLE", "width": width, "height": height, "params": [fx, fy, cx, cy]}
    options = {"max_reproj_error": 5.0, "max_iterations": 10000}
    pose, about = poselib.estimate_absolute_pose(*map(np.array, zip(*pairs)), camera, options, {})
    if about["num_inliers"] < MIN_INLIERS:
        return None
    metres = np.linalg.norm(truth[:3, :3].T @ truth[:3, 3] - pose.R.T @ pose.t)
    cosine = (np.trace(pose.R @ truth[:3, :3].T) - 1) / 2
    return metres, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def judge(scene, drawn):
    all_views = list(views(scene / "transforms.json"))
    mapped = [pair for at, view in enumerate(all_views) if at % 4 != 3 for pair in observe(view, drawn)]
    points, descriptors = (np.array(column) for column in zip(*mapped))
    test = scene / "test/transforms.json"
    queries = all_views[3::4] + (list(views(test)) if test.exists() else [])
    start = time.time()
    found = [locate(view, points, descriptors) for view in queries]
    return {
        "scene": scene.name,
        "n": len(queries),
        "within_25cm_5deg": len([one for one in found if one is not None and one[0] <= 0.25 and one[1] <= 5]),
        "wrong": len([one for one in found if one is not None and (one[0] > 1 or one[1] > 10)]),
        "median_m": float(np.median([one[0] for one in found if one is not None])),
        "mean_secs": (time.time() - start) / len(queries),
        "map_bytes": int(descriptors.size) + 12 * len(points),
    }


for scene, drawn in zip(sys.argv[1::2], sys.argv[2::2]):
    print(json.dumps(judge(Path(scene), Path(drawn))), flush=True)
