"""Writes a program's bill of materials (CycloneDX 1.6) from `cargo metadata`, and checks it against CycloneDX's
own schema.

usage: sbom.py METADATA.json PACKAGE OUT.json
The crates are those of the normal and build dependencies on the platforms that the metadata was filtered for. Checksums are those
of Cargo.lock, so what is listed is what cargo builds.
"""

import json
import re
import sys
import tomllib
from pathlib import Path

from cyclonedx.schema import OutputFormat, SchemaVersion
from cyclonedx.validation import make_schemabased_validator


def licence(text):
    return [{"expression": re.sub(r"\s*/\s*", " OR ", text)}] if text else []


def main(metadata, package, out):
    metadata = json.loads(Path(metadata).read_text())
    packages = {p["id"]: p for p in metadata["packages"]}
    nodes = {n["id"]: n for n in metadata["resolve"]["nodes"]}
    members = [i for i in metadata["workspace_members"] if packages[i]["name"] == package]
    if len(members) != 1:
        sys.exit(f"sbom: the workspace has no package {package}")
    lock = tomllib.loads((Path(metadata["workspace_root"]) / "Cargo.lock").read_text())
    checksums = {(p["name"], p["version"]): p.get("checksum") for p in lock["package"]}

    def needs(id):
        kinds = [(d["pkg"], {k["kind"] for k in d["dep_kinds"]}) for d in nodes[id]["deps"]]
        return sorted(pkg for pkg, kinds in kinds if kinds - {"dev"})

    reached, waiting = set(), list(members)
    while waiting:
        id = waiting.pop()
        if id not in reached:
            reached.add(id)
            waiting += needs(id)

    def purl(id):
        p = packages[id]
        return f"pkg:cargo/{p['name']}@{p['version']}"

    def component(id):
        p = packages[id]
        found = {"type": "library", "bom-ref": purl(id), "name": p["name"], "version": p["version"], "purl": purl(id)}
        if licence(p["license"]):
            found["licenses"] = licence(p["license"])
        if checksum := checksums.get((p["name"], p["version"])):
            found["hashes"] = [{"alg": "SHA-256", "content": checksum}]
        elif p["source"]:
            sys.exit(f"sbom: {p['name']} {p['version']} has no checksum in Cargo.lock")
        return found

    root = {**component(members[0]), "type": "application"}
    ids = sorted(reached - set(members), key=purl)
    text = json.dumps({
        "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "metadata": {"component": root},
        "components": [component(id) for id in ids],
        "dependencies": [{"ref": purl(id), "dependsOn": [purl(d) for d in needs(id)]} for id in [*members, *ids]],
    }, indent=1) + "\n"
    wrong = make_schemabased_validator(OutputFormat.JSON, SchemaVersion.V1_6).validate_str(text)
    if wrong:
        sys.exit(f"sbom: {package}: {wrong}")
    Path(out).write_text(text)
    print(f"{out}: {package} and {len(ids)} crates")


main(*sys.argv[1:])
