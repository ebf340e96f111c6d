"""Reads a file of slag-mcap with the library of the MCAP project; the robot's own answers are the truth.

python3 against_the_file.py FILE ROBOT_URL
"""

import base64
import json
import struct
import sys
import urllib.request

from mcap.reader import make_reader


def get(url):
    with urllib.request.urlopen(url, timeout=20) as reply:
        return json.load(reply)


def near(a, b, by=1e-6):
    return all(abs(x - y) <= by for x, y in zip(a, b, strict=True))


def xyz(vector):
    return [vector["x"], vector["y"], vector["z"]]


def main():
    path, robot = sys.argv[1:]
    found = {}
    with open(path, "rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema.encoding == "jsonschema" and channel.message_encoding == "json", channel
            said = json.loads(message.data)
            # The schema names every member that the message has.
            described = set(json.loads(schema.data)["properties"])
            assert set(said) <= described, set(said) - described
            found[channel.topic] = (schema.name, said, message.log_time)

    name, said, time_ns = found["/slag/things/red"]
    assert name == "foxglove.SceneUpdate", name
    reply = get(f"{robot}/v1/query?text=red&limit=20")
    answers = reply["results"][0]["answers"]
    assert answers and len(said["entities"]) == len(answers), said
    for entity, answer in zip(said["entities"], answers):
        [cube], [words], box = entity["cubes"], entity["texts"], answer["oriented_box"]
        assert entity["frame_id"] == reply["frame"], entity
        assert entity["timestamp"] == {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}, entity
        assert near(xyz(cube["pose"]["position"]), box["centre_in_world"]) and near(xyz(cube["size"]), box["size"]), cube
        turned = cube["pose"]["orientation"]
        assert near([*xyz(turned), turned["w"]], box["rotation_world_from_box"]), cube
        assert words["text"] == f"red {answer['score']:.2f}", words
        assert {"key": "id", "value": answer["id"]} in entity["metadata"], entity
    # A relation has things and no points.
    assert len(found["/slag/things/largest blue"][1]["entities"]) == 1 and "/slag/points/largest blue" not in found

    name, said, _ = found["/slag/points/red"]
    assert name == "foxglove.PointCloud" and said["point_stride"] == 16, said
    assert [(f["name"], f["offset"], f["type"]) for f in said["fields"]] == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("score", 12, 7)]
    points = list(struct.iter_unpack("<4f", base64.b64decode(said["data"])))
    truth = get(f"{robot}/v1/query?text=red&kind=gaussians&limit=50")["results"][0]["answers"]
    assert truth and len(points) == len(truth), (len(points), len(truth))
    origin = xyz(said["pose"]["position"])
    for point, answer in zip(points, truth):
        point = [a + b for a, b in zip(point, [*origin, 0.0])]
        assert near(point, [*answer["position_in_world"], answer["score"]], 1e-5), (point, answer)

    name, said, _ = found["/slag/ground"]
    floor = get(f"{robot}/v1/floor")
    cells = base64.b64decode(said["data"])
    columns, rows = floor["size"]
    assert name == "foxglove.Grid" and (said["column_count"], said["row_stride"], said["cell_stride"]) == (columns, columns, 1)
    assert len(cells) == columns * rows and near(xyz(said["pose"]["position"]), floor["origin_in_world"]), said["pose"]
    assert said["cell_size"] == {"x": floor["cell_m"], "y": floor["cell_m"]}
    expected, rest = b"", floor["runs"]
    while rest:
        n = len(rest[1:]) - len(rest[1:].lstrip("0123456789"))
        expected += bytes(["ugro".index(rest[0])]) * int(rest[1 : n + 1])
        rest = rest[n + 1 :]
    assert cells == expected
    print(f"read {len(found)} topics: things, points, ground")


main()
