"""Drives slag-mcp with the client of the MCP project.

python3 against_the_program.py PROGRAM ROBOT_URL WORD STORE_URL MCP_URL

WORD: something that the robot's scene has. STORE_URL: the service of its store, whose shards carry pictures.
MCP_URL: slag-mcp over HTTP, in front of the same robot.
"""

import asyncio
import base64
import json
import struct
import sys
import urllib.error
import urllib.request
import zlib

from mcp import Client, StdioServerParameters


def get(url):
    with urllib.request.urlopen(url, timeout=20) as reply:
        return json.load(reply)


def post(url, body, media_type):
    request = urllib.request.Request(url, body, {"content-type": media_type})
    with urllib.request.urlopen(request, timeout=20) as reply:
        return json.load(reply)


def png(width, height):
    """Returns a grey picture."""
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\x80" * width) * height)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


async def check(client, robot, word):
    assert client.server_info.name == "slag-mcp", client.server_info
    assert "world frame" in client.instructions
    tools = {tool.name: tool for tool in (await client.list_tools()).tools}
    assert sorted(tools) == ["describe_place", "find", "list", "picture", "what_changed", "where_am_i", "where_to_stand"], sorted(tools)
    for tool in tools.values():
        assert tool.description and tool.annotations.read_only_hint, tool
        assert tool.name == "picture" or tool.output_schema["type"] == "object", tool.output_schema

    # The robot's own answers are the oracle. The client checks them against the tool's schema.
    truth = get(f"{robot}/v1/query?text={word}&near=1,2,0&limit=2")
    found = await client.call_tool("find", {"what": word, "near": [1, 2, 0], "limit": 2})
    assert not found.is_error, found
    found = found.structured_content
    assert found["generation"] == truth["generation"] and found["unit"] == truth["unit"]
    answers = truth["results"][0]["answers"]
    assert answers and len(found["things"]) == len(answers), found
    for thing, answer in zip(found["things"], answers):
        for member in ("id", "position_in_world", "size", "distance"):
            assert thing[member] == answer[member], (member, thing, answer)
    assert found["more"] == (truth["results"][0]["next_offset"] is not None)

    # A ball around the best one holds it, a ball far away holds nothing and says why.
    centre = answers[0]["position_in_world"]
    inside = await client.call_tool("find", {"what": word, "near": centre, "radius": 1.0})
    assert answers[0]["id"] in [thing["id"] for thing in inside.structured_content["things"]], inside
    away = [centre[0] + 1000, centre[1], centre[2]]
    outside = await client.call_tool("find", {"what": word, "near": away, "radius": 1.0})
    outside = outside.structured_content
    assert outside["things"] == [] and outside["none"]["kind"] and outside["none"]["detail"], outside

    related = await client.call_tool("find", {"what": f"nearest {word}", "near": [1, 2, 0]})
    related = related.structured_content
    assert related["understood"]["pick"]["by"] == "nearest" and len(related["things"]) == 1, related
    assert related["things"][0]["related_to"][0]["thing"] == "me", related

    # The site is encoded with its places: the robot's own answer is the truth, poses or the reason.
    truth = get(f"{robot}/v1/goal?text={word}&near=1,2,0&radius_m=0.2")
    stand = await client.call_tool("where_to_stand", {"what": word, "near": [1, 2, 0], "radius_m": 0.2})
    assert not stand.is_error, stand
    stand = stand.structured_content
    assert bool(stand["places"]) != ("none" in stand), stand
    assert [place["position_in_world"] for place in stand["places"]] == \
        [goal["position_in_world"] for goal in truth["goals"]], (stand, truth)
    if truth["none"] is not None:
        assert stand["none"]["kind"] == truth["none"]["kind"], (stand, truth)

    # The robot has had two generations; its own ids, places and words are the oracle.
    truth = get(f"{robot}/v1/changes?text={word}&text=blue")
    changed = await client.call_tool("what_changed", {"words": [word, "blue"]})
    assert not changed.is_error, changed
    changed = changed.structured_content
    assert changed["from_generation"] == truth["from"]["generation"] < changed["to_generation"] == truth["to"]["generation"]
    assert "none" not in changed and truth["appeared"] and truth["went"], (changed, truth)
    for name in ("appeared", "went"):
        told = [(one["id"], one["position_in_world"], one["most_like"]) for one in changed[name]]
        assert told == [(one["id"], one["position_in_world"], one["like"]["text"]) for one in truth[name]], (told, truth)
    assert [move["distance"] for move in changed["moved"]] == [move["distance"] for move in truth["moved"]]
    assert changed["n_unchanged"] == truth["n_same"] + truth["n_stayed"], (changed, truth)
    beyond = await client.call_tool("what_changed", {"near": away, "radius": 1.0})
    beyond = beyond.structured_content
    assert beyond["appeared"] == beyond["went"] == beyond["moved"] == [], beyond

    # The robot's own list is the oracle, page by page.
    truth = get(f"{robot}/v1/objects?sort=area")
    listed, after = [], None
    while after is not None or not listed:
        page = (await client.call_tool("list", {"limit": 2, **({"after": after} if after else {})})).structured_content
        assert page["n_things"] == truth["n_objects"] and page["named"] and page["things"], page
        listed, after = listed + page["things"], page.get("next_after")
    told = [(one["id"], one["names"], one["position_in_world"]) for one in listed]
    assert told == [(one["id"], one["names"], one["position_in_world"]) for one in truth["objects"]], (told, truth)
    assert any(one["names"][0]["name"] == word for one in listed), (word, listed)
    nothing = (await client.call_tool("list", {"near": away, "radius": 1.0})).structured_content
    assert nothing["n_things"] == 0 and nothing["things"] == [], nothing

    place = get(f"{robot}/v1/map")
    here = (await client.call_tool("describe_place", {"words": [word]})).structured_content
    assert here["n_things"] == place["n_objects"] and here["scene"] == place["scene"], here
    assert here["is_complete"] == (not any(cell["is_wanted"] for cell in place["missing"]))
    assert here["box_in_world"][0][0] == min(cell["box_min_in_world"][0] for cell in place["cells"])
    assert here["kinds"][0]["word"] == word and here["kinds"][0]["n"] >= len(answers), here
    there = await client.call_tool("describe_place", {"near": away, "radius": 1.0})
    there = there.structured_content
    assert there["n_things"] == 0 and not there["is_complete"] and there["kinds"] == [], there

    # The robot's own answer to the same photo is the truth.
    photo = png(96, 64)
    truth = post(f"{robot}/v1/locate?focal_px=80", photo, "image/png")
    seen = {"photo_base64": base64.b64encode(photo).decode(), "focal_px": 80}
    here = (await client.call_tool("where_am_i", seen)).structured_content
    assert here["state"] == truth["state"] == "lost" and here["reason"] == truth["reason"], (here, truth)
    as_url = {**seen, "photo_base64": "data:image/png;base64," + base64.encodebytes(photo).decode()}
    assert (await client.call_tool("where_am_i", as_url)).structured_content == here

    # Errors go to the model, which can correct its request.
    for name, asked, expected in [
        ("find", {"what": word, "limit": 0}, "expected 1 to 50"),
        ("find", {"what": word, "radius": 1.0}, "radius needs near"),
        ("find", {"what": ""}, "text"),
        ("find", {"what": word, "near": [0, 0, 0], "radius": -1.0}, "radius"),
        ("describe_place", {"near": [0, 0, 0]}, "go together"),
        ("list", {"radius": 1.0}, "go together"),
        ("list", {"limit": 1000}, "expected 1 to 200"),
        ("list", {"after": "3"}, "after"),
        ("where_to_stand", {"what": word, "radius_m": 9.0}, "radius_m"),
        ("picture", {"id": listed[0]["id"]}, "no small picture"),
        ("picture", {"id": "o0123456789abcdef"}, "has no object o0123456789abcdef"),
        ("picture", {"id": "../map?"}, "no id of a thing"),
        ("what_changed", {"from_generation": 10**6}, "generation"),
        ("where_am_i", {"photo_base64": "no base64!", "focal_px": 80}, "photo_base64"),
        ("where_am_i", {**seen, "near": [0, 0, 0]}, "sigma"),
        ("where_am_i", {**seen, "photo_base64": "A" * 8_000_001}, "8000000 characters"),
        ("what_changed", {"radius": 1.0}, "near"),
    ]:
        refused = await client.call_tool(name, asked)
        assert refused.is_error and expected in refused.content[0].text, (asked, refused)
    return len(found["things"])


async def check_pictures(client, robot, store):
    """The service of the store has the pictures that a robot with balanced shards has."""
    for thing in get(f"{robot}/v1/objects?limit=3")["objects"]:
        with urllib.request.urlopen(f"{store}/v1/objects/{thing['id']}/thumbnail", timeout=20) as reply:
            truth = reply.read()
        [shown] = (await client.call_tool("picture", {"id": thing["id"]})).content
        assert shown.mime_type == "image/jpeg" and base64.b64decode(shown.data) == truth, shown
        assert truth.startswith(b"\xff\xd8\xff"), truth[:8]


def status(url, headers):
    body = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": {
        "protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "page", "version": "1"}}}
    headers = {"content-type": "application/json", "accept": "application/json, text/event-stream", **headers}
    request = urllib.request.Request(url, json.dumps(body).encode(), headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as reply:
            return reply.status
    except urllib.error.HTTPError as error:
        return error.code


def check_strangers(url):
    """Pages of strangers, and pages whose name was made to point here, are refused."""
    assert status(url, {}) == 200
    assert status(url, {"host": "evil.example"}) == 403
    assert status(url, {"origin": "http://evil.example"}) == 403
    assert status(url, {"origin": "null"}) == 403


async def main(program, robot, word, store, url):
    over_stdio = StdioServerParameters(command=program, args=["--robot", robot])
    async with Client(over_stdio) as client:
        n = await check(client, robot, word)
        # Longer than any line that the library reads.
        seen = {"photo_base64": "A" * 20_000_000, "focal_px": 80}
        refused = await asyncio.wait_for(client.call_tool("where_am_i", seen), 60)
        assert refused.is_error and "8000000 characters" in refused.content[0].text, refused
    said = [f"stdio: {n} things"]
    async with Client(url) as client:
        n = await check(client, robot, word)
    check_strangers(url)
    said.append(f"http: {n} things")
    async with Client(StdioServerParameters(command=program, args=["--robot", store])) as client:
        await check_pictures(client, robot, store)
    # A robot that does not answer is an error of the call; the door stays open.
    async with Client(StdioServerParameters(command=program, args=["--robot", "http://127.0.0.1:9"])) as client:
        refused = await client.call_tool("find", {"what": word})
        assert refused.is_error and "slag-edge serve" in refused.content[0].text, refused
    print(", ".join(said))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
