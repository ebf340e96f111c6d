"""Drives slag-ros through Cyclone DDS, on this machine only.

python3 against_the_program.py PROGRAM ROBOT_URL WORD DOMAIN_ID humble|jazzy

WORD: something that the robot's scene has. The robot follows, so that it takes positions.
"""

import json
import os
import re
import struct
import subprocess
import sys
import time
import urllib.request

from ros_messages import (
    CancelGoalRequest, Detection3DArray, Duration, FeedbackMessage, FindRequest, FindResponse, GetResultRequest, Header, HumbleResult,
    JazzyResult, MarkerArray, NavigateFeedback, NavSatFix, NavSatStatus, Odometry, Point,
    OccupancyGrid, PointCloud2, Pose, PoseStamped, PoseWithCovariance, Quaternion, SendGoalRequest, SendGoalResponse,
    StandRequest, StandResponse, String,
    TFMessage, Time, Transform, TransformStamped, Twist, TwistWithCovariance, Vector3,
)

LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
os.environ["CYCLONEDDS_URI"] = LOOPBACK

from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402

RELIABLE = Policy.Reliability.Reliable(duration(seconds=5))
# What `ros2 topic` and RViz ask for, and what late joiners ask for.
PLAIN = Qos(RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(10))
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(10))
TIMEOUT_SECS = 20.0


def get(url):
    with urllib.request.urlopen(url, timeout=20) as reply:
        return json.load(reply)


def until(what, ready, timeout=TIMEOUT_SECS):
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        found = ready()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"no {what} within {timeout} s")


class Ros:
    def __init__(self, domain):
        self.participant = DomainParticipant(domain)
        self.kept = []

    def topic(self, name, kind, qos):
        topic = Topic(self.participant, name, kind)
        self.kept.append((topic, qos))
        return topic

    def reader(self, name, kind, qos=PLAIN):
        return DataReader(self.participant, self.topic(name, kind, qos), qos=qos)

    def writer(self, name, kind, qos=PLAIN):
        """Returns a writer that the node hears."""
        writer = DataWriter(self.participant, self.topic(name, kind, qos), qos=qos)
        until(f"reader of {name}", lambda: writer.get_matched_subscriptions())
        return writer


def header(frame):
    return Header(Time(1, 2), frame)


def close(a, b, tolerance=1e-9):
    return all(abs(x - y) <= tolerance for x, y in zip(a, b))


def xyz(v):
    return [v.x, v.y, v.z]


def check_answers(ros, robot, word):
    truth = get(f"{robot}/v1/query?text={word}")["results"][0]["answers"]
    detections = ros.reader("rt/slag/detections", Detection3DArray)
    markers = ros.reader("rt/slag/markers", MarkerArray)
    clouds = ros.reader("rt/slag/points", PointCloud2)
    poses = ros.reader("rt/slag/best_pose", PoseStamped)
    query = ros.writer("rt/slag/query", String)
    for reader in (detections, markers, clouds, poses):
        until("writer", lambda reader=reader: reader.get_matched_publications())
    query.write(String(word))

    [found] = until("detections", detections.take)
    assert found.header.frame_id == "map" and found.header.stamp.sec > 1_600_000_000, found.header
    assert len(found.detections) == len(truth) > 0
    for detection, answer in zip(found.detections, truth):
        box = answer["oriented_box"]
        assert detection.id == answer["id"] and detection.results[0].hypothesis.class_id == word
        assert abs(detection.results[0].hypothesis.score - answer["score"]) < 1e-6
        assert close(xyz(detection.bbox.center.position), box["centre_in_world"]), (detection, answer)
        assert close(xyz(detection.bbox.size), box["size"])
        turned = detection.bbox.center.orientation
        assert close([turned.x, turned.y, turned.z, turned.w], box["rotation_world_from_box"])
        assert list(detection.results[0].pose.covariance) == [0.0] * 36
    [shown] = until("markers", markers.take)
    assert shown.markers[0].action == 3 and len(shown.markers) == 1 + 2 * len(truth)
    boxes = [marker for marker in shown.markers if marker.ns == "boxes"]
    assert all(marker.type == 1 and marker.color.a > 0 for marker in boxes)
    assert close(xyz(boxes[0].pose.position), truth[0]["oriented_box"]["centre_in_world"])
    words = [marker for marker in shown.markers if marker.ns == "words"]
    assert all(marker.type == 9 and marker.text.startswith(word) for marker in words)

    expected = get(f"{robot}/v1/query?text={word}&kind=gaussians&limit=3500")["results"][0]["answers"]
    [cloud] = until("a cloud", clouds.take)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "score"]
    assert cloud.width == len(expected) > 0 and len(cloud.data) == 16 * cloud.width
    for at, point in enumerate(expected):
        x, y, z, score = struct.unpack_from("<4f", bytes(cloud.data), 16 * at)
        assert close([x, y, z, score], [*point["position_in_world"], point["score"]], 1e-5)
    [pose] = until("a pose", poses.take)
    assert close(xyz(pose.pose.position), truth[0]["oriented_box"]["centre_in_world"])

    # Those who join later hear the last answer alone, once those before are acknowledged and dropped (every 6 s).
    query.write(String(word))
    [last] = until("detections again", detections.take)
    assert last.header.stamp != found.header.stamp

    def kept():
        # Every new reader must acknowledge, too.
        time.sleep(6.5)
        reader = ros.reader("rt/slag/detections", Detection3DArray, LATCHED)
        heard = until("kept detections", reader.take)
        time.sleep(0.2)
        heard += reader.take()
        return heard if [one.header.stamp for one in heard] == [last.header.stamp] else None

    [late] = until("the last detections alone", kept, timeout=40)
    assert [one.id for one in late.detections] == [one["id"] for one in truth]
    return len(truth), len(expected)


def check_objects(ros, robot):
    """A node that joins late hears what is on board, once the robot's model has encoded the words for names."""
    objects = ros.reader("rt/slag/objects", Detection3DArray, LATCHED)

    def named():
        truth, heard = get(f"{robot}/v1/objects?limit=45"), objects.take()
        return (truth, heard[-1]) if truth["named"] and heard and heard[-1].detections[0].results else None

    truth, found = until("things with names", named)
    assert found.header.frame_id == "map" and len(found.detections) == len(truth["objects"]) > 0
    for detection, thing in zip(found.detections, truth["objects"]):
        names = [(result.hypothesis.class_id, result.hypothesis.score) for result in detection.results]
        assert detection.id == thing["id"] and names == [(name["name"], name["confidence"]) for name in thing["names"]]
        box = thing["oriented_box"]
        assert close(xyz(detection.bbox.center.position), box["centre_in_world"])
        assert close(xyz(detection.results[0].pose.pose.position), box["centre_in_world"])
    return len(found.detections)


def check_service(ros, word):
    # rmw_cyclonedds_cpp offers Find_Request_ and Find_Response_ on these topics.
    replies = ros.reader("rr/slag/findReply", FindResponse)
    calls = ros.writer("rq/slag/findRequest", FindRequest)
    until("a server", replies.get_matched_publications)
    for number, (text, limit, success) in enumerate([(word, 1, True), (word, 0, True), ("", 0, False)], 7):
        calls.write(FindRequest(0x1234_5678_9ABC_DEF0, number, text, limit))
        [reply] = until(f"a reply to {text!r}", replies.take)
        assert (reply.client, reply.number) == (0x1234_5678_9ABC_DEF0, number), reply
        assert reply.success == success and bool(reply.message) != success, reply
        assert len(reply.detections.detections) == 1 if limit == 1 else success == bool(reply.detections.detections)


BODY = {"radius_m": 0.2, "sensor_height_m": 1.2, "reach_m": 1.5}


def check_places(ros, robot):
    """The node was told BODY, and `check_transforms` told it where it is."""
    robot_parameters = "&".join(f"{name}={value}" for name, value in BODY.items() if name != "reach_m")
    near = "near=2.5,2.25,0"
    words = ["red", "blue", "green", "yellow", "white", "brown", "grey", "black"]
    asked = {word: get(f"{robot}/v1/goal?text={word}&{near}&{robot_parameters}&reach_m={BODY['reach_m']}") for word in words}
    word, truth = next((word, reply) for word, reply in asked.items() if reply["goals"])
    best = truth["goals"][0]
    goals = ros.reader("rt/slag/goal", PoseStamped)
    sent = ros.reader("rt/goal_pose", PoseStamped)
    maps = ros.reader("rt/slag/ground", OccupancyGrid, LATCHED)
    going = ros.writer("rt/slag/go_to", String)
    for reader in (goals, sent, maps):
        until("writer", lambda reader=reader: reader.get_matched_publications())
    going.write(String(word))
    [goal] = until("a goal", goals.take)
    assert goal.header.frame_id == "map", goal
    for pose in (goal.pose, until("a goal for Nav2", sent.take)[0].pose):
        assert close(xyz(pose.position), best["position_in_world"]), (pose, best)
        turned = pose.orientation
        assert close([turned.x, turned.y, turned.z, turned.w], best["orientation_xyzw"]), (pose, best)

    # The map against the robot's own: free is reached or within the radius of it, and never an obstacle.
    [shown] = until("a map", maps.take)
    info, n_free = shown.info, 0
    floor = get(f"{robot}/v1/floor?{near}&{robot_parameters}")
    cells = "".join(letter * int(count) for letter, count in re.findall(r"([a-z])(\d+)", floor["runs"]))
    width, cell = floor["size"][0], floor["cell_m"]
    assert len(shown.data) == info.width * info.height <= 60_000 and set(shown.data) <= {-1, 0, 100}

    def cells_of(x, y):
        """The robot's cells in a cell of the map, by their numbers along x and y."""
        corner = [info.origin.position.x + x * info.resolution, info.origin.position.y + y * info.resolution]
        first = [round((corner[axis] - floor["origin_in_world"][axis]) / cell) for axis in (0, 1)]
        n = round(info.resolution / cell)
        return [(first[0] + i, first[1] + j) for i in range(n) for j in range(n)]

    for at, value in enumerate(shown.data):
        own = [cells[j * width + i] for i, j in cells_of(at % info.width, at // info.width)
               if i < width and j < floor["size"][1]]
        assert (value == 100) == ("o" in own), (at, value, own)
        assert value != 0 or set(own) <= {"r", "g"}, (at, own)
        n_free += value == 0
    assert n_free > 100, n_free
    x, y = [int((best["position_in_world"][axis] - [info.origin.position.x, info.origin.position.y][axis]) / info.resolution)
            for axis in (0, 1)]
    assert shown.data[y * info.width + x] != 100

    replies = ros.reader("rr/slag/standReply", StandResponse)
    calls = ros.writer("rq/slag/standRequest", StandRequest)
    until("a server", replies.get_matched_publications)
    for number, text in enumerate([word, ""], 3):
        calls.write(StandRequest(5, number, text))
        [reply] = until(f"a reply to {text!r}", replies.take)
        assert (reply.client, reply.number) == (5, number) and reply.success == bool(text), reply
        assert bool(reply.message) != reply.success, reply
    calls.write(StandRequest(5, 9, word))
    [reply] = until("a reply", replies.take)
    assert close(xyz(reply.pose.pose.position), best["position_in_world"]), reply
    assert close([reply.clearance_m, reply.visible_share, reply.way_m],
                 [best["clearance_m"], best["visible_share"], best["path_m"]]), (reply, best)
    return n_free, word


def check_action(ros, node, word, distribution):
    """Stands in for Nav2's server: takes a goal, tells how far it is, and ends it; then one that it gives up;
    then rejects. A goal on its way is cancelled where a later wish fails, and where the node ends."""
    action = "navigate_to_pose/_action"
    goals = ros.reader("rt/slag/goal", PoseStamped)
    states = ros.reader("rt/slag/navigation", String)
    going = ros.writer("rt/slag/go_to", String)
    until("writer", goals.get_matched_publications)
    asked = ros.reader(f"rq/{action}/send_goalRequest", SendGoalRequest)
    taken = ros.writer(f"rr/{action}/send_goalReply", SendGoalResponse)
    waiting = ros.reader(f"rq/{action}/get_resultRequest", GetResultRequest)
    kind = JazzyResult if distribution == "jazzy" else HumbleResult
    results = ros.writer(f"rr/{action}/get_resultReply", kind)
    feedback = ros.writer(f"rt/{action}/feedback", FeedbackMessage)
    for reader in (asked, waiting, states):
        until("writer", reader.get_matched_publications)
    failed = "Aborted, error code 9003" if distribution == "jazzy" else "Aborted"
    ends = [(True, 4, 0, f"{word}: reached"), (True, 6, 9003, f"{word}: failed: Nav2 ends the goal: {failed}"),
            (False, 0, 0, f"{word}: failed: Nav2 rejects the goal")]
    for accepted, status, code, said in ends:
        going.write(String(word))
        [goal] = until("a goal", goals.take)
        [request] = until("a goal for the action", asked.take)
        assert request.goal.behavior_tree == "" and request.goal.pose.header.frame_id == "map", request
        place = request.goal.pose.pose
        assert close(xyz(place.position), xyz(goal.pose.position)) and close([place.orientation.z], [goal.pose.orientation.z])
        assert any(request.goal_id.uuid)
        taken.write(SendGoalResponse(request.client, request.number, accepted, Time(1, 2)))
        if accepted:
            [result] = until("a call for the result", waiting.take)
            assert list(result.goal_id.uuid) == list(request.goal_id.uuid)
            told = NavigateFeedback(goal, Duration(1, 0), Duration(2, 0), 0, 1.25)
            feedback.write(FeedbackMessage(request.goal_id, told))
            [state] = until("feedback", states.take)
            assert state.data == f"{word}: 1.25 m remain", state
            own = (code, "too late") if kind is JazzyResult else (0,)
            results.write(kind(result.client, result.number, status, *own))
        [state] = until("the end", states.take)
        assert state.data == said, state

    cancels = ros.reader(f"rq/{action}/cancel_goalRequest", CancelGoalRequest)
    until("writer", cancels.get_matched_publications)

    def drive():
        going.write(String(word))
        [request] = until("a goal for the action", asked.take)
        taken.write(SendGoalResponse(request.client, request.number, True, Time(1, 2)))
        until("a call for the result", waiting.take)
        return list(request.goal_id.uuid)

    def cancelled(goal):
        [cancel] = until("a call to cancel", cancels.take)
        # A time of zero: this goal alone.
        assert (list(cancel.goal_id.uuid), cancel.stamp.sec, cancel.stamp.nanosec) == (goal, 0, 0), cancel

    goal = drive()
    assert not cancels.take()
    going.write(String("?"))
    cancelled(goal)
    said = set()
    until("both ends", lambda: said.update(state.data for state in states.take()) or len(said) == 2)
    assert f"{word}: cancelled" in said and any(text.startswith("?: failed: ") for text in said), said
    # A new wish cancels the goal before, even if Nav2 then rejects what takes its place.
    old = drive()
    going.write(String(word))
    cancelled(old)
    [request] = until("the next goal", asked.take)
    assert list(request.goal_id.uuid) != old
    taken.write(SendGoalResponse(request.client, request.number, False, Time(1, 2)))
    goal = drive()
    node.process.terminate()
    cancelled(goal)
    return len(ends) + 3


def stamped(parent, child, translation, rotation):
    turned = Transform(Vector3(*translation), Quaternion(*rotation))
    return TransformStamped(header(parent), child, turned)


def followed(robot, place):
    """Returns whether the robot knows that it is at a place."""
    position = get(f"{robot}/status")["following"]["position"] or {}
    return "world" in position and close(position["world"], place, 1e-6)


def check_transforms(ros, robot):
    half = 0.5**0.5
    static = ros.writer("rt/tf_static", TFMessage, LATCHED)
    static.write(TFMessage([stamped("map", "odom", (3.0, 2.0, 0.0), (0.0, 0.0, half, half))]))
    moving = ros.writer("rt/tf", TFMessage)

    def there():
        moving.write(TFMessage([stamped("odom", "base_link", (0.25, 0.5, 0.0), (0.0, 0.0, 0.0, 1.0))]))
        time.sleep(0.1)
        return followed(robot, [2.5, 2.25, 0.0])

    until("position from tf", there)


def check_odometry(ros, robot):
    static = ros.writer("rt/tf_static", TFMessage, LATCHED)
    static.write(TFMessage([stamped("map", "odom", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]))
    odometry = ros.writer("rt/odom", Odometry)
    pose = PoseWithCovariance(Pose(Point(2.0, 2.5, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0)), [0.0] * 36)
    twist = TwistWithCovariance(Twist(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0)), [0.0] * 36)

    def there():
        odometry.write(Odometry(header("odom"), "base_link", pose, twist))
        time.sleep(0.1)
        return followed(robot, [3.0, 2.5, 0.0])

    until("position from odometry", there)


def check_fix(ros, robot):
    fixes = ros.writer("rt/fix", NavSatFix)

    def told(status, latitude):
        where = (latitude, 8.5, float("nan"))
        fixes.write(NavSatFix(header("gps"), NavSatStatus(status, 1), *where, [0.0] * 9, 0))
        time.sleep(0.15)
        return get(f"{robot}/status")["following"]["position"].get("geographic", {}).get("latitude_deg") == latitude

    until("position from a fix", lambda: told(0, 47.25))
    # Without a fix the numbers of the receiver are ignored.
    assert not any(told(-1, 47.5) for _ in range(5))


class Node:
    def __init__(self, program, robot, domain, *flags):
        command = [program, "--robot", robot, "--domain-id", str(domain), "--localhost-only", "1"]
        command += ["--rmw", "rmw_cyclonedds_cpp", "--position-period", "0.1", *flags]
        self.process = subprocess.Popen(command)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(10)


def check_absent(program, domain):
    """A robot's program that is not there is reported: topics alone would be silent."""
    command = [program, "--robot", "http://127.0.0.1:9", "--domain-id", str(domain), "--localhost-only", "1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as node:
        said = next(line for line in node.stderr if "does not answer" in line)
        node.terminate()
    assert "slag-edge serve" in said, said


def main(program, robot, word, domain, distribution):
    domain = int(domain)
    body = ["--robot-radius", str(BODY["radius_m"]), "--sensor-height", str(BODY["sensor_height_m"])]
    with Node(program, robot, domain, *body, "--reach", str(BODY["reach_m"]), "--send-goals", "topic"):
        ros = Ros(domain)
        n_things, n_points = check_answers(ros, robot, word)
        n_on_board = check_objects(ros, robot)
        check_service(ros, word)
        check_transforms(ros, robot)
        n_free, place = check_places(ros, robot)
    with Node(program, robot, domain + 3, *body, "--reach", str(BODY["reach_m"]), "--send-goals", "action") as node:
        ros = Ros(domain + 3)
        check_transforms(ros, robot)
        n_goals = check_action(ros, node, place, distribution)
    with Node(program, robot, domain + 1, "--position", "odom"):
        check_odometry(Ros(domain + 1), robot)
    with Node(program, robot, domain + 2, "--position", "fix"):
        check_fix(Ros(domain + 2), robot)
    check_absent(program, domain + 4)
    print(f"{n_on_board} on board, {n_things} things, {n_points} points, service, tf, odometry, fix, {n_free} free cells, {n_goals} goals")


if __name__ == "__main__":
    main(*sys.argv[1:])
