"""Photos of a camera through Cyclone DDS: does slag-ros tell where the robot is, and where the scene lies?

python3 against_locating.py PROGRAM ROBOT_URL PHOTOS DOMAIN_ID

PHOTOS: a folder with transforms.json, of photos that the robot's landmarks were not made from. The robot stands where
each was taken, and its odometry is turned and moved against the scene.
"""

import json
import math
import sys
import time
from pathlib import Path

from against_the_program import LATCHED, Node, Ros, header, stamped, until, xyz
from ros_messages import CameraInfo, CompressedImage, PoseWithCovarianceStamped, RegionOfInterest, TFMessage

MAX_OFF_M = 0.05
MAX_TURNED = math.radians(1)
# The node takes a photo every two seconds.
PERIOD_SECS = 2.2


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def inverse(a):
    turned = [[a[j][i] for j in range(3)] for i in range(3)]
    moved = [-sum(turned[i][k] * a[k][3] for k in range(3)) for i in range(3)]
    return [[*turned[i], moved[i]] for i in range(3)] + [[0, 0, 0, 1]]


def quaternion(a):
    """x, y, z, w by the largest of the four (Shepperd 1978)."""
    xx, yy, zz = a[0][0], a[1][1], a[2][2]
    squares = [1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz]
    most = max(range(4), key=squares.__getitem__)
    s = 2 * math.sqrt(squares[most])
    sums = {(0, 1): a[1][0] + a[0][1], (0, 2): a[0][2] + a[2][0], (1, 2): a[2][1] + a[1][2],
            (0, 3): a[2][1] - a[1][2], (1, 3): a[0][2] - a[2][0], (2, 3): a[1][0] - a[0][1]}
    return [s / 4 if i == most else sums[min(i, most), max(i, most)] / s for i in range(4)]


def differ(transform, expected):
    """Returns how far a pose is from a matrix, and by how much it is turned against it."""
    at, turned = transform
    off = math.dist(xyz(at), [expected[i][3] for i in range(3)])
    dot = sum(p * q for p, q in zip([turned.x, turned.y, turned.z, turned.w], quaternion(expected)))
    return off, 2 * math.acos(min(1.0, abs(dot)))


def main(program, robot, photos, domain):
    photos = Path(photos)
    poses = json.loads((photos / "transforms.json").read_text())
    turn, half = 0.7, 0.5
    odom_from_scene = [[math.cos(turn), -math.sin(turn), 0, 5], [math.sin(turn), math.cos(turn), 0, -3], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    # REP-103: the camera looks forward, 0.3 m ahead and 0.4 m up.
    base_from_optical = [[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]]
    focal, centre = poses["fl_x"], (poses["cx"], poses["cy"])
    size = [int(2 * c) for c in centre]
    p = [focal, 0, centre[0], 0, 0, focal, centre[1], 0, 0, 0, 1, 0]
    k, r = [focal, 0, centre[0], 0, focal, centre[1], 0, 0, 1], [1, 0, 0, 0, 1, 0, 0, 0, 1]
    camera = CameraInfo(header("camera"), size[1], size[0], "plumb_bob", [0.0] * 5, k, r, p, 0, 0, RegionOfInterest(0, 0, 0, 0, False))
    with Node(program, robot, domain, "--camera", "/eye", "--scene-frame", "scene"):
        ros = Ros(int(domain))
        found = ros.reader("rt/slag/pose", PoseWithCovarianceStamped)
        told = ros.reader("rt/tf", TFMessage)
        static, moving = ros.writer("rt/tf_static", TFMessage, LATCHED), ros.writer("rt/tf", TFMessage)
        info, images = ros.writer("rt/eye/camera_info", CameraInfo), ros.writer("rt/eye/image_rect/compressed", CompressedImage)
        static.write(TFMessage([stamped("base_link", "camera", (0.3, 0.0, 0.4), (-half, half, -half, half))]))
        until("writer", found.get_matched_publications)
        worst = (0.0, 0.0)
        for n, frame in enumerate(poses["frames"]):
            gl = frame["transform_matrix"]
            scene_from_optical = [[row[0], -row[1], -row[2], row[3]] for row in gl]
            scene_from_base = product(scene_from_optical, inverse(base_from_optical))
            odom_from_base = product(odom_from_scene, scene_from_base)
            at = tuple(odom_from_base[i][3] for i in range(3))
            moving.write(TFMessage([stamped("odom", "base_link", at, quaternion(odom_from_base))]))
            info.write(camera)
            time.sleep(0.3)
            images.write(CompressedImage(header("camera"), "png", (photos / frame["file_path"]).read_bytes()))
            [pose] = until(f"a pose of photo {n}", found.take)
            assert pose.header.frame_id == "scene" and pose.pose.covariance[0] > 0, pose
            off = differ((pose.pose.pose.position, pose.pose.pose.orientation), scene_from_base)
            worst = max(worst[0], off[0]), max(worst[1], off[1])
            time.sleep(PERIOD_SECS)
            # The second photo that agrees is believed.
            moved = [one for message in told.take(100) for one in message.transforms if one.child_frame_id == "scene"]
            assert bool(moved) == (n > 0), (n, moved)
            # At the scene's origin, the turn of the photo's pose counts by its distance.
            lever_m = math.hypot(*(scene_from_base[i][3] for i in range(3)))
            for one in moved:
                off = differ((one.transform.translation, one.transform.rotation), odom_from_scene)
                max_off_m = MAX_OFF_M + lever_m * off[1]
                assert one.header.frame_id == "odom" and off[0] <= max_off_m and off[1] <= MAX_TURNED, (one, off)
        assert worst[0] <= MAX_OFF_M and worst[1] <= MAX_TURNED, worst
        # A photo of nothing moves nothing.
        images.write(CompressedImage(header("camera"), "png", b"no photo"))
        time.sleep(1)
        assert not found.take() and not [one for one in told.take(100) if one.transforms[0].child_frame_id == "scene"]
    print(f"{len(poses['frames'])} photos, at most {1000 * worst[0]:.0f} mm and {math.degrees(worst[1]):.2f} degrees off")


if __name__ == "__main__":
    main(*sys.argv[1:])
