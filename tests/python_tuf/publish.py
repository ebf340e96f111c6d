"""Publishes the manifest of a served store anew with python-tuf: publish.py STORE_URL MANIFEST FOLDER PORT.

Keys, roots and signatures are python-tuf's own. FOLDER gets metadata, target and `state`, which says what is served:

    first      root 1 (two of three keys), version 1 of all other roles
    rotated    root 2 with another timestamp key and other root keys, version 2
    rollback   version 1 again, under root 2's keys
    stolen     version 9, by the timestamp key that root 2 took out of use
    mixed      version 3 whose snapshot is not the one that the timestamp states
    expired    version 4, expired yesterday
    latest     version 5

Objects come from STORE_URL. Ends when its standard input does.
"""

import datetime
import hashlib
import http.server
import os
import pathlib
import sys
import threading
import urllib.request

from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp


def in_days(days: int) -> datetime.datetime:
    return (datetime.datetime.now(datetime.timezone.utc) + datetime.timedelta(days=days)).replace(microsecond=0)


def signed(body, signers) -> bytes:
    metadata = Metadata(body)
    for signer in signers:
        metadata.sign(signer, append=True)
    return metadata.to_bytes()


def repository(roots, version: int, manifest: bytes, online: dict, days: int = 30) -> dict:
    """Files by name. `roots`: (keys by role, signers) of each version; `online`: signer by role."""
    files = {}
    for number, (keys, threshold, signers) in enumerate(roots, 1):
        body = Root(version=number, expires=in_days(365), consistent_snapshot=True)
        for role, role_signers in keys.items():
            for signer in role_signers:
                body.add_key(signer.public_key, role)
        body.roles["root"].threshold = threshold
        files[f"{number}.root.json"] = signed(body, signers)
    target = TargetFile.from_data("manifest", manifest, ["sha256", "sha512"])
    body = Targets(version=version, expires=in_days(365), targets={"manifest": target})
    files[f"{version}.targets.json"] = signed(body, [online["targets"]])
    # python-tuf's own form: without length and hashes.
    body = Snapshot(version=version, expires=in_days(365), meta={"targets.json": MetaFile(version)})
    files[f"{version}.snapshot.json"] = signed(body, [online["snapshot"]])
    meta = MetaFile.from_data(version, files[f"{version}.snapshot.json"], ["sha256"])
    files["timestamp.json"] = signed(
        Timestamp(version=version, expires=in_days(days), snapshot_meta=meta), [online["timestamp"]]
    )
    return files


def states(manifest: bytes) -> dict:
    new = CryptoSigner.generate_ed25519
    root, next_root = [new(), new(), new()], [new(), new()]
    online = {role: new() for role in ("targets", "snapshot", "timestamp")}
    online_2 = {**online, "timestamp": new()}
    keys = {"root": root, **{role: [signer] for role, signer in online.items()}}
    keys_2 = {"root": next_root, **{role: [signer] for role, signer in online_2.items()}}
    first = [(keys, 2, root[:2])]
    second = [*first, (keys_2, 2, [root[0], root[2], *next_root])]
    mixed = repository(second, 3, manifest, online_2)
    other = Snapshot(version=3, expires=in_days(300), meta={"targets.json": MetaFile(3)})
    mixed["3.snapshot.json"] = signed(other, [online_2["snapshot"]])
    return {
        "first": repository(first, 1, manifest, online),
        "rotated": repository(second, 2, manifest, online_2),
        "rollback": repository(second, 1, manifest, online_2),
        "stolen": repository(second, 9, manifest, online),
        "mixed": mixed,
        "expired": repository(second, 4, manifest, online_2, -1),
        "latest": repository(second, 5, manifest, online_2),
    }


def main() -> None:
    store, path, folder, port = sys.argv[1:]
    manifest = pathlib.Path(path).read_bytes()
    folder = pathlib.Path(folder)
    published = states(manifest)
    (folder / "1.root.json").write_bytes(published["first"]["1.root.json"])
    name = f"{hashlib.sha256(manifest).hexdigest()}.manifest"

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            kind, _, asked = self.path.removeprefix("/v1/").partition("/")
            if kind == "metadata":
                body = published[(folder / "state").read_text().strip()].get(asked)
            elif kind == "targets":
                body = manifest if asked == name else None
            else:
                with urllib.request.urlopen(store + self.path) as answer:
                    body = answer.read()
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", int(port)), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdin.read()
    os._exit(0)


main()
