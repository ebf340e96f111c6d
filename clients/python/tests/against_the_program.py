"""Checks the client against a running slag-edge: python3 against_the_program.py URL THING"""

import json
import sys
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import generate  # noqa: E402
from slag_robot import Robot, SlagError, relation, thing  # noqa: E402


def main(url: str, word: str) -> None:
    with urllib.request.urlopen(f"{url}/openapi.json") as description:
        messages = generate.module(json.load(description))
    assert (ROOT / "slag_robot" / "messages.py").read_text() == messages, f"run generate.py {url}"
    robot = Robot(url)
    place = robot.map()
    things = list(robot.objects(limit=3))
    assert len(things) == place["n_objects"] > 0, (len(things), place["n_objects"])
    assert len({one["id"] for one in things}) == len(things)
    assert robot.object(things[0]["id"]) == things[0]
    try:
        picture = robot.thumbnail(things[0]["id"])
        assert things[0]["evidence"]["has_thumbnail"] and picture.startswith(b"\xff\xd8\xff")
    except SlagError as error:
        assert error.status == 404 and not things[0]["evidence"]["has_thumbnail"], error

    result = robot.find(word, near=[0.0, 0.0, 0.0])
    assert result.none is None and result.understood is None, result
    for rank, answer in enumerate(result.answers, 1):
        assert (answer.rank, answer.frame, answer.generation) == (rank, "world", place["generation"])
        assert answer.distance is not None and len(answer.position_in_world) == 3
        assert any(one["id"] == answer.id for one in things)
    paged = list(robot.find_all(word, page=1))
    assert {answer.id for answer in paged} >= {answer.id for answer in result.answers}

    # In words and as JSON, relations give the same.
    words = robot.find(f"nearest {word}", near=[0.0, 0.0, 0.0])
    phrase = robot.ask(phrases=[thing(word, by="nearest")], near=[0.0, 0.0, 0.0]).results[0]
    assert words.understood == {"thing": word, "pick": {"by": "nearest", "n": 1}}, words.understood
    assert [one.id for one in words.answers] == [one.id for one in phrase.answers] and len(words.answers) == 1
    assert words.answers[0].related_to[0].thing == "me"
    near = relation("near", thing(word))
    none = robot.ask(phrases=[thing(word, near, by="largest", n=100)]).results[0]
    assert none.none is not None and none.none.kind in ("too-few", "no-such-pair"), none
    assert none.none.thing == word and not none.answers, none

    for request, parameter in [({}, "texts"), ({"texts": [word], "limit": 0}, "limit")]:
        try:
            robot.ask(**request)
        except SlagError as error:
            assert (error.status, error.kind, error.parameter) == (400, "bad-parameter", parameter), error.problem
        else:
            raise AssertionError(f"{request} was taken")
    try:
        goals = robot.goal(word, near=[0.0, 0.0, 0.0], radius_m=0.25)
        assert (goals.none is None) == bool(goals.goals) and goals.generation == place["generation"], goals
    except SlagError as error:
        # Scenes may be encoded without --occupancy.
        assert (error.status, error.kind) == (409, "no-occupancy"), error.problem
    changes = robot.changes([word], near=[0.0, 0.0, 0.0], radius=100)
    assert changes.to_generation == place["generation"] and changes.frame == "world", changes
    assert (changes.none is None) == (changes.from_generation is not None), changes
    try:
        robot.changes(from_=10**6, to=10**6 + 1)
    except SlagError as error:
        assert (error.status, error.kind) == (404, "no-such-generation"), error.problem
    else:
        raise AssertionError("a generation that never was")
    event = next(iter(robot.events()))
    assert event.name == "generation" and event.data["generation"] == place["generation"], event
    print(f"{len(things)} things, {len(result.answers)} answers")


if __name__ == "__main__":
    main(*sys.argv[1:])
