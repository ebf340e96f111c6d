"""Writes slag_robot/messages.py from the description of a running robot: python3 generate.py URL"""

import json
import sys
import textwrap
import urllib.request
from pathlib import Path
from typing import Any

CLASSES = {
    "Witness": ["Witness"],
    "Answer": ["ThingInFrame", "GaussianInFrame"],
    "Nothing": ["None", "GoalMiss", "NotCompared"],
    "Result": ["Result"],
    "Reply": ["Reply"],
    "Goal": ["Goal"],
    "Changed": ["ChangedThing"],
    "Moved": ["MovedThing"],
}
"""The classes, and the schemas whose members each has."""
RENAMED = {("Moved", "from"): "before", ("Moved", "to"): "now"}
"""Members that have other names here: `from` is a word of Python."""
MANY = ["related_to", "negatives", "bad_cells", "parts"]
"""Lists that are empty where they are absent."""
WITH_WHOLE = ["Answer", "Result"]
"""Classes that keep the whole message."""
HEAD = '''"""The messages of slag-edge's API, as GET /openapi.json describes them. Written by generate.py; do not edit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Mapping, Optional, Sequence
'''
SCALARS = {"string": "str", "integer": "int", "number": "float", "boolean": "bool"}


def kind(schema: dict[str, Any], schemas: dict[str, Any]) -> str:
    """Returns the type of a member."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[1]
        known = [made for made, parts in CLASSES.items() if name in parts]
        return known[0] if known else kind(schemas[name], schemas)
    if "anyOf" in schema:
        kinds = {kind(one, schemas) for one in schema["anyOf"]}
        some = sorted(kinds - {"None"})
        one = some[0] if len(some) == 1 else "Any"
        return f"Optional[{one}]" if "None" in kinds else one
    if isinstance(schema.get("type"), list):
        [some] = [name for name in schema["type"] if name != "null"]
        return f"Optional[{kind({**schema, 'type': some}, schemas)}]"
    if schema.get("type") == "null":
        return "None"
    if schema.get("type") == "array":
        return f"Sequence[{kind(schema.get('items', {}), schemas)}]"
    return SCALARS.get(schema.get("type", ""), "Mapping[str, Any]")


def documented(text: str, indent: str) -> list[str]:
    return textwrap.wrap(f'"""{text}"""', 119, initial_indent=indent, subsequent_indent=indent)


def written(name: str, schemas: dict[str, Any]) -> str:
    parts = [schemas[part] for part in CLASSES[name]]
    members = {member: schema for part in reversed(parts) for member, schema in part["properties"].items()}
    required = [member for member in parts[0]["required"] if all(member in part["required"] for part in parts)]
    lines = ["", "", "@dataclass(frozen=True)", f"class {name}:", *documented(parts[0]["description"], "    "), ""]
    for member in [*required, *(member for member in sorted(members) if member not in required)]:
        of = kind(members[member], schemas)
        if member not in required:
            can_be_none = of.startswith("Optional[")
            of = f"{of} = ()" if member in MANY else f"{of} = None" if can_be_none else f"Optional[{of}] = None"
        description = members[member].get("description", "As the class says.")
        lines += [f"    {RENAMED.get((name, member), member)}: {of}", *documented(description, "    ")]
    if name in WITH_WHOLE:
        lines += ["    more: Mapping[str, Any] = field(default_factory=dict, repr=False)"]
        lines += documented("The whole message as the robot sent it.", "    ")
    return "\n".join(lines)


def module(description: dict[str, Any]) -> str:
    """Returns the text of the module."""
    schemas = description["components"]["schemas"]
    return HEAD + "\n".join(written(name, schemas) for name in CLASSES) + "\n"


if __name__ == "__main__":
    with urllib.request.urlopen(sys.argv[1].rstrip("/") + "/openapi.json") as reply:
        text = module(json.load(reply))
    (Path(__file__).parent / "slag_robot" / "messages.py").write_text(text)
