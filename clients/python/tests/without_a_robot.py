"""Checks what the client sends, without a robot: python3 without_a_robot.py"""

import os
import sys
import threading
import urllib.parse
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slag_robot import Robot, SlagError  # noqa: E402

ASKED: list[tuple[str, str]] = []
TOKENS: list[str | None] = []


class Listener(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        ASKED.append((self.server.name, self.path))  # type: ignore[attr-defined]
        TOKENS.append(self.headers.get("Authorization"))
        if self.path == "/v1/map":
            self.send_response(302)
            self.send_header("Location", "/elsewhere")
        else:
            self.send_response(503)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def listen(name: str) -> str:
    server = HTTPServer(("127.0.0.1", 0), Listener)
    server.name = name  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


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
    try:
        robot.map()
    except SlagError as error:
        assert error.status == 503, error
    assert TOKENS == ["Bearer secret", None], "a redirect takes no token along"
    for wrong in [{"lat": 1.0}, {"x": 1.0, "y": 2.0}, {"lat": 1.0, "lon": 2.0, "alt": 3.0}]:
        try:
            robot.goal("chair", near=wrong)
        except ValueError:
            continue
        raise AssertionError(wrong)
    # Another machine is asked through the proxy of the environment.
    ASKED.clear()
    try:
        Robot("http://robot.invalid:7734").map()
    except SlagError:
        pass
    assert [name for name, _ in ASKED] == ["proxy"], ASKED


main()
