"""Publishes the manifest of a served store anew with python-tuf: publish.py STORE_URL MANIFEST FOLDER --listen
IP:PORT.

Keys, roots and signatures are python-tuf's own. FOLDER gets `1.root.json`; the file `state` in it names what is served, a
key of `states`. Objects come from STORE_URL.
"""

import datetime
import hashlib
import http.server
import pathlib
import sys
import urllib.request

from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, MetaFile, Root, Snapshot, TargetFile, Targets, Timestamp

TOP = 2**64 - 1


def in_days(days: int) -> datetime.datetime:
    return (datetime.datetime.now(datetime.timezone.utc) + datetime.timedelta(days=days)).replace(microsecond=0)


def signed(body, signers) -> bytes:
    metadata = Metadata(body)
    for signer in signers:
        metadata.sign(signer, append=True)
    return metadata.to_bytes()


def root_file(number: int, keys: dict, signers: list, extra: dict | None = None) -> bytes:
    """A root with two root keys as its threshold. `keys`: signers by role."""
    body = Root(version=number, expires=in_days(365), consistent_snapshot=True, unrecognized_fields=extra)
    for role, role_signers in keys.items():
        for signer in role_signers:
            body.add_key(signer.public_key, role)
    body.roles["root"].threshold = 2
    return signed(body, signers)


def repository(roots: list, version: int, manifest: bytes, online: dict, expired: str = "", extra=None) -> dict:
    """Files by name. `roots`: bytes of each version; `online`: signer by role; `expired`: the role that is."""
    expires = {role: in_days(-1 if role == expired else 30) for role in online}
    files = {f"{number}.root.json": bytes for number, bytes in enumerate(roots, 1)}
    target = TargetFile.from_data("manifest", manifest, ["sha256", "sha512"])
    body = Targets(version, expires=expires["targets"], targets={"manifest": target}, unrecognized_fields=extra)
    files[f"{version}.targets.json"] = signed(body, [online["targets"]])
    # python-tuf's own form: without length and hashes.
    meta = {"targets.json": MetaFile(version)}
    body = Snapshot(version, expires=expires["snapshot"], meta=meta, unrecognized_fields=extra)
    files[f"{version}.snapshot.json"] = signed(body, [online["snapshot"]])
    meta = MetaFile.from_data(version, files[f"{version}.snapshot.json"], ["sha256"])
    body = Timestamp(version, expires=expires["timestamp"], snapshot_meta=meta, unrecognized_fields=extra)
    files["timestamp.json"] = signed(body, [online["timestamp"]])
    return files


def states(manifest: bytes) -> dict:
    new = CryptoSigner.generate_ed25519
    root, next_root = [new(), new(), new()], [new(), new()]
    online = {role: new() for role in ("targets", "snapshot", "timestamp")}
    online_2 = {**online, "timestamp": new()}
    online_3 = {role: new() for role in online}

    def keys(root_keys: list, online_keys: dict) -> dict:
        return {"root": root_keys, **{role: [signer] for role, signer in online_keys.items()}}

    first = [root_file(1, keys(root, online), root[:2])]
    second = [*first, root_file(2, keys(next_root, online_2), [root[0], root[2], *next_root])]
    third = [*second, root_file(3, keys(next_root, online_3), next_root, {"x-note": "keys were stolen"})]
    thief = [new(), new()]

    def named_by(*signers) -> list:
        return [*third, root_file(4, keys(thief, online_3), [*signers, *thief])]

    def second_with(version: int, **files) -> dict:
        return {**repository(second, version, manifest, online_2), **files}

    def snapshot(version: int, targets_version: int) -> bytes:
        body = Snapshot(version, expires=in_days(29), meta={"targets.json": MetaFile(targets_version)})
        return signed(body, [online_2["snapshot"]])

    def timestamp(version: int, signers: list) -> bytes:
        return signed(Timestamp(version, expires=in_days(30), snapshot_meta=MetaFile(version)), signers)

    by_key = [online_2["timestamp"]]
    # Versions rise: a client keeps the first timestamp of a version that it accepts.
    return {
        # Root 1: two of three keys.
        "first": repository(first, 1, manifest, online),
        # Root 2: another timestamp key, other root keys.
        "rotated": repository(second, 2, manifest, online_2),
        "timestamp rolled back": second_with(1),
        "by a key out of use": repository(second, 9, manifest, online),
        "unsigned": second_with(3, **{"timestamp.json": timestamp(3, [])}),
        "other snapshot": second_with(3, **{"3.snapshot.json": snapshot(3, 3)}),
        "snapshot of another version": second_with(
            4, **{"4.snapshot.json": snapshot(3, 3), "timestamp.json": timestamp(4, by_key)}
        ),
        "targets rolled back": second_with(
            5, **{"5.snapshot.json": snapshot(5, 1), "timestamp.json": timestamp(5, by_key)}
        ),
        "other targets": second_with(6, **{"6.targets.json": second_with(2)["2.targets.json"]}),
        "endless snapshot": second_with(7, **{"7.snapshot.json": b" " * (6 << 20)}),
        "endless timestamp": second_with(8, **{"timestamp.json": b" " * (6 << 20)}),
        "snapshot missing": second_with(8, **{"8.snapshot.json": None}),
        "timestamp expired": repository(second, 9, manifest, online_2, "timestamp"),
        "snapshot expired": repository(second, 10, manifest, online_2, "snapshot"),
        "targets expired": repository(second, 11, manifest, online_2, "targets"),
        "fast-forward": repository(second, TOP, manifest, online_2),
        "honest again": repository(second, 12, manifest, online_2),
        # Root 3: other online keys, and fields that nobody knows.
        "recovered": repository(third, 13, manifest, online_3, extra={"x-note": ["none", 1]}),
        "root by online keys": repository(named_by(*online_3.values()), 14, manifest, online_3),
        "root by one key": repository(named_by(next_root[0]), 14, manifest, online_3),
        "latest": repository(third, 14, manifest, online_3),
        # The listed file itself is not what is served.
        "other file": repository(third, 15, manifest[::-1], online_3),
    }


def main() -> None:
    store, path, folder, _, address = sys.argv[1:]
    manifest = pathlib.Path(path).read_bytes()
    folder = pathlib.Path(folder)
    published = states(manifest)
    (folder / "1.root.json").write_bytes(published["first"]["1.root.json"])
    names = {f"{hashlib.sha256(body).hexdigest()}.manifest" for body in (manifest, manifest[::-1])}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            kind, _, asked = self.path.removeprefix("/v1/").partition("/")
            if kind == "metadata":
                body = published[(folder / "state").read_text()].get(asked)
            elif kind == "targets":
                body = manifest if asked in names else None
            else:
                with urllib.request.urlopen(store + self.path) as answer:
                    body = answer.read()
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            try:
                self.wfile.write(body or b"")
            except OSError:
                pass  # A client that has seen enough.

        def log_message(self, *_: object) -> None:
            pass

    host, port = address.split(":")
    server = http.server.ThreadingHTTPServer((host, int(port)), Handler)
    print(f"listening on http://{host}:{server.server_port}", flush=True)
    server.serve_forever()


main()
