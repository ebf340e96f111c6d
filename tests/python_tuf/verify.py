"""Checks a served store with python-tuf: verify.py URL ROOT.json. Prints the length of the manifest."""

import os
import sys
import tempfile

from tuf.api import exceptions
from tuf.ngclient import Updater


def updater(url: str, root: bytes, folder: str) -> Updater:
    return Updater(
        metadata_dir=folder,
        metadata_base_url=f"{url}/v1/metadata/",
        target_dir=folder,
        target_base_url=f"{url}/v1/targets/",
        bootstrap=root,
    )


def main() -> None:
    url, path = sys.argv[1:]
    root = open(path, "rb").read()
    with tempfile.TemporaryDirectory() as folder:
        client = updater(url, root, folder)
        client.refresh()
        info = client.get_targetinfo("manifest")
        if info is None:
            sys.exit("the target `manifest` is not listed")
        print(os.path.getsize(client.download_target(info)))
    # A root of somebody else must fail: the signature is what is checked.
    at = root.index(b'"sig":"') + 7
    other = root[:at] + (b"1" if root[at : at + 1] != b"1" else b"2") + root[at + 1 :]
    with tempfile.TemporaryDirectory() as folder:
        try:
            updater(url, other, folder).refresh()
        except exceptions.RepositoryError:
            return
    sys.exit("a root with a changed signature was accepted")


main()
