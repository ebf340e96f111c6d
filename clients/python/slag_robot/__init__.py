"""Asks slag-edge, the program on a robot, where things are.

>>> robot = Robot("http://127.0.0.1:7734")
>>> for mug in robot.find("mug on the table").answers:
...     print(mug.id, mug.position_in_world)

Needs nothing but the standard library. Every position is in the frame and of the generation that its answer names.
"""

from __future__ import annotations

import http.client
import ipaddress
import json
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass, field, is_dataclass, replace
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from functools import lru_cache
from typing import Any, Iterator, Mapping, Optional, Sequence, Union, get_args, get_origin, get_type_hints

from .messages import Answer, Changed, Goal, Moved, Nothing, Reply, Result, Witness

__all__ = ["Answer", "Event", "Nothing", "Reply", "Result", "Robot", "SlagError", "Witness", "relation", "thing"]

_NAMES = {"before": "from", "now": "to"}
"""Members that have other names in JSON."""

Point = Union[Sequence[float], Mapping[str, float]]
"""x, y, z in the world frame, or {"lat": .., "lon": .., "height": ..}."""


class SlagError(Exception):
    """The robot refused a request (RFC 9457), or what came is no answer of a robot. `kind` is stable, and empty where
    the robot did not say it; `detail` is for people."""

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        super().__init__(problem.get("detail", f"HTTP status {status}"))
        self.status = status
        self.kind: str = str(problem.get("type", "")).rsplit(":", 1)[-1]
        self.detail: str = str(self)
        self.parameter: Optional[str] = problem.get("parameter")
        self.retry_after_secs: Optional[float] = problem.get("retry_after_secs")
        self.problem = dict(problem)


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
    """Makes a phrase: `thing("box", relation("left-of", thing("door")), by="largest")`, or
    `thing("box", by="nearest", from_=thing("door"))`."""
    phrase: dict[str, Any] = {"thing": name}
    if relation is not None:
        phrase["relation"] = dict(relation)
    if pick:
        phrase["pick"] = {name.rstrip("_"): value for name, value in pick.items()}
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
        address = ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost"
    address = getattr(address, "ipv4_mapped", None) or address
    # Who connects to no address in particular reaches this machine.
    return address.is_loopback or address.is_unspecified


def _same(before: Optional[int], now: int) -> int:
    """Returns the generation of all pages: ids of one mean nothing in another."""
    if before not in (None, now):
        raise RuntimeError(f"generation {before} became {now}; ask again from the start")
    return now


def _only(reply: Reply) -> Result:
    """Returns the result of the one text asked."""
    results = reply.results or ()
    if len(results) != 1:
        raise _wrong(results, "one result")
    return results[0]


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Takes a redirect for what it is here, an error: the robot never redirects, so another machine answered."""

    def redirect_request(self, req: Any, fp: Any, code: Any, msg: Any, headers: Any, newurl: Any) -> None:
        return None


_LONGEST_SHOWN = 200
"""Characters of an answer that an error shows."""
_LONGEST_ANSWER = 64 << 20
"""Bytes of an answer that are read: ten thousand answers are 10 MB."""
_LONGEST_LINE = 1 << 20
"""Bytes of a line of events."""
_MOST_LINES = 100
"""Lines of an event."""


def _shown(text: bytes) -> str:
    return text.decode(errors="replace")[:_LONGEST_SHOWN]


def _retry_after_secs(value: Optional[str]) -> Optional[float]:
    """Reads Retry-After: seconds or a date (RFC 9110, section 10.2.3); anything else says nothing."""
    text = (value or "").strip()
    if text.isascii() and text.isdigit():
        return float(text[:9]) or None
    try:
        at = parsedate_to_datetime(text)
        # Without a zone it is UTC.
        until = at if at.tzinfo is not None else at.replace(tzinfo=timezone.utc)
        return max((until - datetime.now(timezone.utc)).total_seconds(), 0.0) or None
    except (IndexError, OverflowError, TypeError, ValueError):
        return None


def _read_body(reply: Any) -> tuple[bytes, bool]:
    """Reads a body to its end, to where it broke off, or as far as one is read; returns whether it is whole."""
    body = b""
    try:
        while len(body) < _LONGEST_ANSWER:
            piece = reply.read(_LONGEST_ANSWER - len(body))
            if not piece:
                # What was announced and did not come.
                return body, not reply.length
            body += piece
        return body, not reply.read(1)
    except http.client.IncompleteRead as broken:
        return body + broken.partial, False


def _no_answer(reply: Any, expected: str, text: bytes) -> SlagError:
    """Makes the error for an answer with status 200 that is none of a robot."""
    encoding = reply.headers.get("Content-Encoding")
    found = f"{len(text)} bytes of {reply.headers.get_content_type()}" + (f" in {encoding}" if encoding else "")
    detail = f"the answer is {found}, expected {expected}; is the address a robot's slag-edge serve? {_shown(text)!r}"
    return SlagError(reply.status, {"detail": detail})


_hints = lru_cache(maxsize=None)(get_type_hints)


def _read(kind: Any, value: Any) -> Any:
    """Makes a value of a type of the messages out of JSON."""
    parts = [part for part in get_args(kind) if part is not type(None)]
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise _wrong(value, "an object")
        hints = _hints(kind)
        keys = {name: _NAMES.get(name, name) for name in hints}
        made = {name: _read(hints[name], value[key]) for name, key in keys.items() if key in value}
        try:
            return kind(**made, **({"more": value} if "more" in hints else {}))
        except TypeError as error:
            raise SlagError(200, {"detail": f"an answer lacks members; is the robot's program older? {error}"}) from None
    if not parts or value is None:
        return value
    if get_origin(kind) is Union:
        return _read(parts[0], value)
    if not is_dataclass(parts[0]):
        return value
    if not isinstance(value, list):
        raise _wrong(value, "a list")
    return tuple(_read(parts[0], one) for one in value)


def _wrong(value: Any, expected: str) -> SlagError:
    return SlagError(200, {"detail": f"an answer has {_shown(repr(value).encode())} where {expected} belongs"})


class Robot:
    """A robot's `slag-edge serve`. `token`: that of its --token-file."""

    def __init__(self, url: str = "http://127.0.0.1:7734", token: Optional[str] = None, timeout_secs: float = 15.0) -> None:
        self.url = url.rstrip("/")
        self.token = token
        self.timeout_secs = timeout_secs
        # A proxy of the environment would take requests to this machine, and the token, to another one.
        proxies = [urllib.request.ProxyHandler({})] if _is_loopback(self.url) else []
        self._opener = urllib.request.build_opener(_NoRedirects(), *proxies)

    def ask(self, **request: Any) -> Reply:
        """Asks anything that `POST /v1/query` takes: texts, vectors, phrases, region, near, limit ..."""
        reply: Reply = _read(Reply, self._send("/v1/query", request, members=("generation", "results")))
        return reply

    def find(self, text: str, near: Optional[Point] = None, **request: Any) -> Result:
        """Asks for one text, which may name relations."""
        if near is not None:
            request["near"] = near if isinstance(near, Mapping) else [float(of_axis) for of_axis in near]
        return _only(self.ask(texts=[text], **request))

    def find_all(self, text: str, page: int = 100, **request: Any) -> Iterator[Answer]:
        """Yields all answers to a text, page by page; stops with an error if the generation changes meanwhile."""
        offset: Optional[int] = 0
        generation: Optional[int] = None
        while offset is not None:
            reply = self.ask(texts=[text], limit=page, offset=offset, **request)
            generation = _same(generation, reply.generation)
            result = _only(reply)
            yield from result.answers
            if result.next_offset is not None and not result.next_offset > offset:
                raise SlagError(200, {"detail": f"the answers from {result.next_offset!r} on repeat themselves"})
            offset = result.next_offset

    def objects(self, near: Optional[Sequence[float]] = None, **parameters: Any) -> Iterator[dict[str, Any]]:
        """Yields the things on board, page by page: near, radius, sort, min_size, limit as `GET /v1/objects` takes
        them; stops with an error if the generation changes meanwhile."""
        generation: Optional[int] = None
        seen = {str(parameters.get("after"))}
        while True:
            query = urllib.parse.urlencode(_pairs(near, parameters))
            page = self._send("/v1/objects?" + query, members=("generation", "objects", "next_after"))
            generation = _same(generation, page["generation"])
            yield from page["objects"]
            if page["next_after"] is None:
                return
            if str(page["next_after"]) in seen:
                raise SlagError(200, {"detail": f"the page after {page['next_after']!r} repeats itself"})
            parameters["after"] = page["next_after"]
            seen.add(str(page["next_after"]))

    def object(self, id: str) -> dict[str, Any]:
        """Returns one thing on board."""
        found: dict[str, Any] = self._send("/v1/objects/" + urllib.parse.quote(id, safe=""))
        return found

    def thumbnail(self, id: str) -> bytes:
        """Returns the small picture of one thing on board, a JPEG file; balanced and exact shards have them."""
        with self._open(f"/v1/objects/{urllib.parse.quote(id, safe='')}/thumbnail", None, self.timeout_secs) as reply:
            picture, is_whole = _read_body(reply)
            if reply.headers.get_content_type() != "image/jpeg" or not is_whole:
                raise _no_answer(reply, "a whole JPEG file", picture)
        return picture

    def map(self) -> dict[str, Any]:
        """Returns the area on board, its age, and what is missing."""
        place: dict[str, Any] = self._send("/v1/map")
        return place

    def goal(self, text: Optional[str] = None, near: Optional[Point] = None, **parameters: Any) -> Goals:
        """Returns places to stand near a thing: by text, or by id="o...", with radius_m, reach_m,
        sensor_height_m ..."""
        query = urllib.parse.urlencode(_pairs(near, {"text": text, **parameters}))
        reply = self._send("/v1/goal?" + query, members=("generation", "frame", "goals", "none"))
        goals: Goals = _read(Goals, reply)
        return goals

    def floor(self, near: Optional[Point] = None, **parameters: Any) -> dict[str, Any]:
        """Returns the ground around the robot as `GET /v1/floor` describes it."""
        ground: dict[str, Any] = self._send("/v1/floor?" + urllib.parse.urlencode(_pairs(near, parameters)))
        return ground

    def changes(self, texts: Sequence[str] = (), near: Optional[Point] = None, **parameters: Any) -> Changes:
        """Returns what changed between two generations: from_, to, radius as `GET /v1/changes` takes them.
        `texts`: kinds of things; each changed thing names the one that it is most like."""
        if isinstance(texts, str):
            texts = [texts]
        pairs = [("text", text) for text in texts] + _pairs(near, parameters)
        reply = self._send("/v1/changes?" + urllib.parse.urlencode(pairs), members=("from", "to", "frame", "none"))
        both = [reply["from"] or {}, reply["to"]]
        for generation in both:
            if not isinstance(generation, dict):
                raise _wrong(generation, "a generation")
        generations = {"from_generation": both[0].get("generation"), "to_generation": both[1].get("generation")}
        changes: Changes = _read(Changes, {**reply, **generations})
        return replace(changes, more=reply)

    def events(self, timeout_secs: float = 60.0) -> Iterator[Event]:
        """Yields events as they happen. The robot is heard at least every 15 s; silence longer than that is an
        error."""
        name, data = "message", []
        with self._open("/v1/events", None, timeout_secs) as stream:
            if stream.headers.get_content_type() != "text/event-stream":
                raise _no_answer(stream, "events", stream.read(4 * _LONGEST_SHOWN))
            for line in iter(lambda: stream.readline(_LONGEST_LINE), b""):
                text = line.decode(errors="replace").rstrip("\r\n")
                if text.startswith("event:"):
                    name = text[6:].strip()
                elif text.startswith("data:") and len(data) < _MOST_LINES:
                    data.append(text[5:].strip())
                elif not text and data:
                    try:
                        event = Event(name, json.loads("\n".join(data)))
                    except (RecursionError, ValueError):
                        raise _no_answer(stream, "events in JSON", "\n".join(data).encode()) from None
                    yield event
                    name, data = "message", []

    def _send(self, path: str, body: Optional[Mapping[str, Any]] = None, members: Sequence[str] = ()) -> Any:
        """Returns the answer, an object with these members."""
        with self._open(path, body, self.timeout_secs) as reply:
            text, _ = _read_body(reply)
            try:
                answer = json.loads(text)
            except (RecursionError, ValueError):
                raise _no_answer(reply, "JSON", text) from None
            if not isinstance(answer, dict) or any(name not in answer for name in members):
                expected = "an object with " + ", ".join(members) if members else "an object"
                raise _no_answer(reply, expected, text)
            return answer

    def _open(self, path: str, body: Optional[Mapping[str, Any]], timeout_secs: float) -> Any:
        request = urllib.request.Request(self.url + path)
        if body is not None:
            request.data = json.dumps(body, allow_nan=False).encode()
            request.add_header("Content-Type", "application/json")
        if self.token is not None:
            # A redirect must not take it to another machine.
            request.add_unredirected_header("Authorization", f"Bearer {self.token}")
        try:
            return self._opener.open(request, timeout=timeout_secs)
        except urllib.error.HTTPError as error:
            with error:
                text, _ = _read_body(error)
            try:
                problem = json.loads(text)
            except (RecursionError, ValueError):
                problem = None
            if not isinstance(problem, dict):
                problem = {"detail": _shown(text) or f"HTTP status {error.code} without a reason"}
                location = error.headers.get("Location")
                if location is not None:
                    problem["detail"] = (
                        f"the answer is a redirect to {location[:_LONGEST_SHOWN]!r}, and a robot never redirects; "
                        "give the address of its slag-edge serve"
                    )
            problem["retry_after_secs"] = _retry_after_secs(error.headers.get("Retry-After"))
            raise SlagError(error.code, problem) from None
