"""Asks slag-edge, the program on a robot, where things are.

>>> robot = Robot("http://127.0.0.1:7734")
>>> for mug in robot.find("mug on the table").answers:
...     print(mug.id, mug.position_in_world)

Needs nothing but the standard library. Every position is in the frame and of the generation that its answer names.
"""

from __future__ import annotations

import ipaddress
import json
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass, field, fields
from typing import Any, Iterator, Mapping, Optional, Sequence, Union

__all__ = ["Answer", "Event", "Nothing", "Reply", "Result", "Robot", "SlagError", "Witness", "relation", "thing"]

Point = Union[Sequence[float], Mapping[str, float]]
"""x, y, z in the world frame, or {"lat": .., "lon": .., "height": ..}."""


class SlagError(Exception):
    """The robot refused a request (RFC 9457). `kind` is stable; `detail` is for people."""

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        super().__init__(problem.get("detail", f"HTTP status {status}"))
        self.status = status
        self.kind: str = str(problem.get("type", "")).rsplit(":", 1)[-1]
        self.detail: str = str(self)
        self.parameter: Optional[str] = problem.get("parameter")
        self.retry_after_secs: Optional[float] = problem.get("retry_after_secs")
        self.problem = dict(problem)


@dataclass(frozen=True)
class Witness:
    """A thing that an answer is related to; `id` is absent for the asker."""

    thing: str
    position_in_world: Sequence[float]
    id: Optional[str] = None
    score: Optional[float] = None


@dataclass(frozen=True)
class Answer:
    """A thing, a cluster or a Gaussian. Members that only some kinds have are None on the others."""

    rank: int
    frame: str
    generation: int
    position_in_world: Sequence[float]
    score: float
    id: Optional[str] = None
    relevance: Optional[float] = None
    distance: Optional[float] = None
    size: Optional[Sequence[float]] = None
    box_min_in_world: Optional[Sequence[float]] = None
    box_max_in_world: Optional[Sequence[float]] = None
    n_gaussians: Optional[int] = None
    degree: Optional[float] = None
    related_to: Sequence[Witness] = ()
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The whole answer as the robot sent it."""


@dataclass(frozen=True)
class Nothing:
    """Why nothing was found. `thing`: the part of a phrase that failed."""

    kind: str
    detail: str
    thing: Optional[str] = None
    best_score: Optional[float] = None
    best_degree: Optional[float] = None


@dataclass(frozen=True)
class Result:
    """The answers to one question. `understood`: the phrase that its text was understood as."""

    question: Mapping[str, Any]
    kind: str
    answers: Sequence[Answer]
    none: Optional[Nothing]
    understood: Optional[Mapping[str, Any]]
    next_offset: Optional[int]
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)


@dataclass(frozen=True)
class Reply:
    """The results of a request, one for each question: texts, then vectors, then phrases."""

    scene: str
    generation: int
    frame: str
    unit: str
    results: Sequence[Result]


@dataclass(frozen=True)
class Goal:
    """A pose to stand in: the ground below the robot's middle, x forward, y left, z up (REP-103). Lengths in
    metres."""

    position_in_world: Sequence[float]
    yaw_rad: float
    orientation_xyzw: Sequence[float]
    sensor_in_world: Sequence[float]
    clearance_m: float
    visible_share: float
    path_m: float
    distance_m: float
    cost_m: float
    geographic: Optional[Mapping[str, float]] = None


@dataclass(frozen=True)
class Goals:
    """Places to stand near a thing, best first, or why there is none."""

    generation: int
    frame: str
    goals: Sequence[Goal]
    none: Optional[Nothing]
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The whole reply as the robot sent it."""


@dataclass(frozen=True)
class Changed:
    """A thing as it is, or as it was. `like`: the text that it is most like, with the cosine, if texts were
    given."""

    id: str
    position_in_world: Sequence[float]
    box_min_in_world: Sequence[float]
    box_max_in_world: Sequence[float]
    n_gaussians_in_scene: int
    photo: str
    geographic: Optional[Mapping[str, float]] = None
    like: Optional[Mapping[str, Any]] = None


@dataclass(frozen=True)
class Moved:
    """A thing that lies elsewhere."""

    before: Changed
    now: Changed
    distance: float


@dataclass(frozen=True)
class Changes:
    """What changed from one generation to another; `none` says why nothing was compared."""

    from_generation: Optional[int]
    to_generation: int
    frame: str
    appeared: Sequence[Changed]
    went: Sequence[Changed]
    moved: Sequence[Moved]
    none: Optional[Nothing]
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The whole reply as the robot sent it."""


@dataclass(frozen=True)
class Event:
    """Something that happened: `generation` or `following`."""

    name: str
    data: Any


def thing(name: str, relation: Optional[Mapping[str, Any]] = None, **pick: Any) -> dict[str, Any]:
    """Makes a phrase: `thing("box", relation("left-of", thing("door")), by="largest")`."""
    phrase: dict[str, Any] = {"thing": name}
    if relation is not None:
        phrase["relation"] = dict(relation)
    if pick:
        phrase["pick"] = pick
    return phrase


def relation(name: str, of: Mapping[str, Any], and_: Optional[Mapping[str, Any]] = None) -> dict[str, Any]:
    """Makes the relation of a phrase; `and_` is the second thing of `between`."""
    made: dict[str, Any] = {"is": name, "of": dict(of)}
    if and_ is not None:
        made["and"] = dict(and_)
    return made


def _pairs(near: Optional[Point], parameters: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Writes parameters as URLs have them; `near` by its names or as x, y, z."""
    pairs = [(name.rstrip("_"), str(value)) for name, value in parameters.items() if value is not None]
    if isinstance(near, Mapping):
        unknown = set(near) - {"lat", "lon", "height"}
        if unknown or not {"lat", "lon"} <= set(near):
            raise ValueError(f"near has {sorted(near)}, expected lat, lon and perhaps height")
        pairs.append(("near_lat_lon", ",".join(str(near[name]) for name in ("lat", "lon", "height") if name in near)))
    elif near is not None:
        pairs.append(("near", ",".join(str(of_axis) for of_axis in near)))
    return pairs


def _is_loopback(url: str) -> bool:
    host = urllib.parse.urlsplit(url).hostname or ""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _known(made: Any, members: Mapping[str, Any]) -> dict[str, Any]:
    names = {of.name for of in fields(made)}
    return {name: value for name, value in members.items() if name in names}


def _answer(members: Mapping[str, Any]) -> Answer:
    related = tuple(Witness(**_known(Witness, witness)) for witness in members.get("related_to", ()))
    return Answer(**{**_known(Answer, members), "related_to": related, "more": members})


def _changed(members: Mapping[str, Any]) -> Changed:
    return Changed(**_known(Changed, members))


def _result(members: Mapping[str, Any]) -> Result:
    none = members["none"]
    return Result(
        question=members["question"],
        kind=members["kind"],
        answers=tuple(_answer(answer) for answer in members["answers"]),
        none=None if none is None else Nothing(**_known(Nothing, none)),
        understood=members["understood"],
        next_offset=members["next_offset"],
        more=members,
    )


class Robot:
    """A robot's `slag-edge serve`. `token`: that of its --token-file."""

    def __init__(self, url: str = "http://127.0.0.1:7734", token: Optional[str] = None, timeout_secs: float = 15.0) -> None:
        self.url = url.rstrip("/")
        self.token = token
        self.timeout_secs = timeout_secs
        # A proxy of the environment would take requests to this machine, and the token, to another one.
        proxies = [urllib.request.ProxyHandler({})] if _is_loopback(self.url) else []
        self._opener = urllib.request.build_opener(*proxies)

    def ask(self, **request: Any) -> Reply:
        """Asks anything that `POST /v1/query` takes: texts, vectors, phrases, region, near, limit ..."""
        reply = self._send("/v1/query", request)
        results = tuple(_result(result) for result in reply["results"])
        return Reply(reply["scene"], reply["generation"], reply["frame"], reply["unit"], results)

    def find(self, text: str, near: Optional[Point] = None, **request: Any) -> Result:
        """Asks for one text, which may name relations."""
        if near is not None:
            request["near"] = near
        return self.ask(texts=[text], **request).results[0]

    def find_all(self, text: str, page: int = 100, **request: Any) -> Iterator[Answer]:
        """Yields all answers to a text, page by page; stops with an error if the generation changes meanwhile."""
        offset: Optional[int] = 0
        generation: Optional[int] = None
        while offset is not None:
            reply = self.ask(texts=[text], limit=page, offset=offset, **request)
            if generation not in (None, reply.generation):
                raise RuntimeError(f"generation {generation} became {reply.generation}; ask again from the start")
            generation = reply.generation
            yield from reply.results[0].answers
            offset = reply.results[0].next_offset

    def objects(self, near: Optional[Sequence[float]] = None, **parameters: Any) -> Iterator[dict[str, Any]]:
        """Yields the things on board, page by page: near, radius, min_size, limit as `GET /v1/objects` takes
        them."""
        while True:
            page = self._send("/v1/objects?" + urllib.parse.urlencode(_pairs(near, parameters)))
            yield from page["objects"]
            if page["next_after"] is None:
                return
            parameters["after"] = page["next_after"]

    def object(self, id: str) -> dict[str, Any]:
        """Returns one thing on board."""
        found: dict[str, Any] = self._send("/v1/objects/" + urllib.parse.quote(id, safe=""))
        return found

    def map(self) -> dict[str, Any]:
        """Returns the area on board, its age, and what is missing."""
        place: dict[str, Any] = self._send("/v1/map")
        return place

    def goal(self, text: Optional[str] = None, near: Optional[Point] = None, **parameters: Any) -> Goals:
        """Returns places to stand near a thing: by text, or by id="o...", with radius_m, reach_m,
        sensor_height_m ..."""
        reply = self._send("/v1/goal?" + urllib.parse.urlencode(_pairs(near, {"text": text, **parameters})))
        goals = tuple(Goal(**_known(Goal, goal)) for goal in reply["goals"])
        none = None if reply["none"] is None else Nothing(**_known(Nothing, reply["none"]))
        return Goals(reply["generation"], reply["frame"], goals, none, reply)

    def floor(self, near: Optional[Point] = None, **parameters: Any) -> dict[str, Any]:
        """Returns the ground around the robot as `GET /v1/floor` describes it."""
        ground: dict[str, Any] = self._send("/v1/floor?" + urllib.parse.urlencode(_pairs(near, parameters)))
        return ground

    def changes(self, texts: Sequence[str] = (), near: Optional[Point] = None, **parameters: Any) -> Changes:
        """Returns what changed between two generations: from_, to, radius as `GET /v1/changes` takes them.
        `texts`: kinds of things; each changed thing names the one that it is most like."""
        pairs = [("text", text) for text in texts] + _pairs(near, parameters)
        reply = self._send("/v1/changes?" + urllib.parse.urlencode(pairs))
        things = {name: tuple(_changed(of) for of in reply[name]) for name in ("appeared", "went")}
        moved = tuple(Moved(_changed(of["from"]), _changed(of["to"]), of["distance"]) for of in reply["moved"])
        none = None if reply["none"] is None else Nothing(**_known(Nothing, reply["none"]))
        earlier = None if reply["from"] is None else reply["from"]["generation"]
        return Changes(earlier, reply["to"]["generation"], reply["frame"], **things, moved=moved, none=none, more=reply)

    def events(self, timeout_secs: float = 60.0) -> Iterator[Event]:
        """Yields events as they happen. The robot is heard at least every 15 s; silence longer than that is an
        error."""
        name, data = "message", []
        with self._open("/v1/events", None, timeout_secs) as stream:
            for line in stream:
                text = line.decode().rstrip("\r\n")
                if text.startswith("event:"):
                    name = text[6:].strip()
                elif text.startswith("data:"):
                    data.append(text[5:].strip())
                elif not text and data:
                    yield Event(name, json.loads("\n".join(data)))
                    name, data = "message", []

    def _send(self, path: str, body: Optional[Mapping[str, Any]] = None) -> Any:
        with self._open(path, body, self.timeout_secs) as reply:
            return json.load(reply)

    def _open(self, path: str, body: Optional[Mapping[str, Any]], timeout_secs: float) -> Any:
        request = urllib.request.Request(self.url + path)
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("Content-Type", "application/json")
        if self.token is not None:
            request.add_header("Authorization", f"Bearer {self.token}")
        try:
            return self._opener.open(request, timeout=timeout_secs)
        except urllib.error.HTTPError as error:
            with error:
                text = error.read()
            try:
                problem = json.loads(text)
            except ValueError:
                problem = {"detail": text.decode(errors="replace")[:200]}
            problem["retry_after_secs"] = float(error.headers.get("Retry-After") or 0) or None
            raise SlagError(error.code, problem) from None
