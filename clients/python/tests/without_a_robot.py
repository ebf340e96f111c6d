"""Checks what the client sends, without a robot: python3 without_a_robot.py"""

import gzip
import os
import sys
import threading
import time
import urllib.parse
from collections.abc import Callable
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import slag_robot  # noqa: E402
from slag_robot import Robot, SlagError, _is_loopback, _retry_after_secs  # noqa: E402

ASKED: list[tuple[str, str]] = []
TOKENS: list[str | None] = []
# Status, headers and body of the next answers, where they are not the usual ones.
ANSWERS: list[tuple[int, dict[str, str], bytes]] = []


class Listener(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        ASKED.append((self.server.name, self.path))  # type: ignore[attr-defined]
        TOKENS.append(self.headers.get("Authorization"))
        if ANSWERS:
            status, headers, body = ANSWERS.pop(0)
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
            return
        if self.path == "/v1/map":
            self.send_response(302)
            self.send_header("Location", "/elsewhere")
        else:
            self.send_response(503)
        self.end_headers()

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.do_GET()

    def log_message(self, *_: object) -> None:
        pass


def listen(name: str) -> str:
    server = HTTPServer(("127.0.0.1", 0), Listener)
    server.name = name  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


def error_of(call: Callable[[], object]) -> SlagError:
    try:
        found = call()
    except SlagError as error:
        return error
    raise AssertionError(found)


def what_is_no_answer_is_an_error(robot: Robot) -> None:
    html = {"Content-Type": "text/html"}
    calls: list[Callable[[], object]] = [
        robot.map,
        lambda: robot.ask(texts=["chair"]),
        lambda: list(robot.objects()),
        lambda: robot.object("o1"),
        lambda: robot.goal("chair"),
        robot.floor,
        robot.changes,
        lambda: robot.thumbnail("o1"),
        lambda: list(robot.events()),
    ]
    bodies = [b"<html>no robot</html>", b"", gzip.compress(b"{}"), b"\xff\xfe", b"[1]", b"null", b'"x"', b"[" * 100_000]
    for call in calls:
        for body in bodies:
            ANSWERS.append((200, html, body))
            error = error_of(call)
            assert error.status == 200 and "slag-edge serve" in error.detail and not ANSWERS, error
    ANSWERS.append((200, {**html, "Content-Encoding": "gzip"}, gzip.compress(b"{}")))
    assert "text/html in gzip" in error_of(robot.map).detail
    ANSWERS.append((200, html, b"<html>no robot</html>"))
    assert "no robot" in error_of(robot.map).detail, "what came is shown"
    ANSWERS.append((200, {"Content-Length": "9"}, b'{"a"'))
    assert "4 bytes" in error_of(robot.map).detail, "it broke off"
    ANSWERS.append((200, {"Content-Length": "9", "Content-Type": "image/jpeg"}, b"\xff\xd8"))
    assert "a whole JPEG file" in error_of(lambda: robot.thumbnail("o1")).detail, "it broke off"
    longest, slag_robot._LONGEST_ANSWER = slag_robot._LONGEST_ANSWER, 1000
    ANSWERS.append((200, {}, b'{"a": "' + b" " * 5000 + b'"}'))
    assert "1000 bytes" in error_of(robot.map).detail, "not all is read"
    slag_robot._LONGEST_ANSWER = longest
    for generation, after in [(7, '"o1"'), (8, "null")]:
        ANSWERS.append((200, {}, b'{"generation": %d, "objects": [], "next_after": %s}' % (generation, after.encode())))
    try:
        list(robot.objects())
        raise AssertionError("pages of two generations are no list")
    except RuntimeError as error:
        assert "generation 7 became 8" in str(error), error
    for _ in range(2):
        ANSWERS.append((200, {}, b'{"generation": 7, "objects": [], "next_after": "o1"}'))
    assert "'o1' repeats" in error_of(lambda: list(robot.objects())).detail
    for after in (b"o1", b"o2", b"o1"):
        ANSWERS.append((200, {}, b'{"generation": 7, "objects": [], "next_after": "%s"}' % after))
    assert "'o1' repeats" in error_of(lambda: list(robot.objects())).detail
    for odd in (b"null", b"[]", b"[null]", b"[5]", b"5", b'"x"', b"{}", b'[{"answers": 5}]'):
        ANSWERS.append((200, {}, b'{"generation": 7, "scene": "s", "frame": "world", "unit": "m", "results": %s}' % odd))
        assert error_of(lambda: robot.find("chair", near=(1, 2, 3))).status == 200, odd
    for odd in (b"5", b'"x"', b"[]"):
        ANSWERS.append((200, {}, b'{"from": 1, "to": %s, "frame": "world", "none": null}' % odd))
        assert "belongs" in error_of(robot.changes).detail, odd
    ANSWERS.append((200, {}, b'{"generation": 7, "results": []}'))
    assert "lacks members" in error_of(lambda: robot.ask(texts=["chair"])).detail
    ANSWERS.append((200, {}, b'{"other": 1}'))
    assert "objects, next_after" in error_of(lambda: list(robot.objects())).detail
    ANSWERS.append((200, {"Content-Type": "text/event-stream"}, b"data: {no\n\n"))
    assert "events in JSON" in error_of(lambda: list(robot.events())).detail
    for body, detail in [(b"[1]", "[1]"), (b'"busy"', '"busy"'), (b"null", "null"), (b"", "HTTP status 503"), (b"\xff", "\ufffd")]:
        ANSWERS.append((503, {"Retry-After": "soon"}, body))
        error = error_of(robot.map)
        assert (error.status, error.kind, error.retry_after_secs) == (503, "", None), error
        assert detail in error.detail, error.detail
    ANSWERS.append((503, {"Retry-After": "7"}, b'{"type": "urn:slag:problem:overloaded", "detail": "later"}'))
    error = error_of(robot.map)
    assert (error.kind, error.detail, error.retry_after_secs) == ("overloaded", "later", 7.0), error
    in_a_minute = formatdate(time.time() + 60, usegmt=True)
    assert 50.0 < (_retry_after_secs(in_a_minute) or 0.0) <= 61.0, in_a_minute
    for nothing in [None, "", "soon", "nan", "-3", "1e9", "Sun, 06 Nov 1994 08:49:37 GMT", "99 Foo 9999999999 25:61:61"]:
        assert _retry_after_secs(nothing) is None, nothing


def main() -> None:
    robot_url, proxy = listen("robot"), listen("proxy")
    os.environ["http_proxy"] = os.environ["HTTP_PROXY"] = proxy
    robot = Robot(robot_url, token="secret")
    earth = {"lat": 46.8, "lon": -92.0, "height": 180.0}
    calls = [
        (lambda: list(robot.objects(near=[1.0, 2.0, 3.0], radius=4)), {"near": "1.0,2.0,3.0", "radius": "4"}),
        (lambda: robot.floor(near=[1.0, 2.0, 3.0]), {"near": "1.0,2.0,3.0"}),
        (lambda: robot.floor(near=earth), {"near_lat_lon": "46.8,-92.0,180.0"}),
        (lambda: robot.goal("chair", near=earth), {"text": "chair", "near_lat_lon": "46.8,-92.0,180.0"}),
        (lambda: robot.goal(id="o1", near=(0, 0, 0)), {"id": "o1", "near": "0,0,0"}),
        (lambda: robot.changes("chair"), {"text": "chair"}),
        (lambda: robot.changes(["a"], near=earth, from_=3), {"text": "a", "from": "3", "near_lat_lon": "46.8,-92.0,180.0"}),
    ]
    for call, expected in calls:
        ASKED.clear()
        try:
            call()
        except SlagError as error:
            assert error.status == 503, error
        [(name, path)] = ASKED
        assert name == "robot", "a proxy was asked for this machine"
        assert dict(urllib.parse.parse_qsl(urllib.parse.urlsplit(path).query)) == expected, path
    TOKENS.clear()
    ASKED.clear()
    refused = error_of(robot.map)
    assert (refused.status, len(ASKED), TOKENS) == (302, 1, ["Bearer secret"]), "a redirect is not followed"
    assert "redirect to '/elsewhere'" in refused.detail, refused.detail
    what_is_no_answer_is_an_error(robot)
    assert slag_robot.thing("box", by="nearest", from_={"thing": "door"})["pick"] == {"by": "nearest", "from": {"thing": "door"}}
    for wrong in [{"lat": 1.0}, {"x": 1.0, "y": 2.0}, {"lat": 1.0, "lon": 2.0, "alt": 3.0}]:
        try:
            robot.goal("chair", near=wrong)
        except ValueError:
            continue
        raise AssertionError(wrong)
    here = ["http://LOCALHOST:1", "http://127.9.9.9", "http://[::1]:7", "http://0.0.0.0:7", "http://[::ffff:127.0.0.1]:7"]
    there = ["http://10.0.0.1", "http://localhost.example", "http://[fe80::1]", "http://[::ffff:10.0.0.1]"]
    assert [_is_loopback(url) for url in here + there] == [True] * len(here) + [False] * len(there)
    # Another machine is asked through the proxy of the environment.
    ASKED.clear()
    try:
        Robot("http://robot.invalid:7734").map()
    except SlagError:
        pass
    assert [name for name, _ in ASKED] == ["proxy"], ASKED


main()
