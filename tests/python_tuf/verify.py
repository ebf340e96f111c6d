"""Checks a served store with python-tuf's client: verify.py URL ROOT.json FOLDER.

FOLDER is what the client remembers; it begins with the root. Prints the length of the manifest, or `refused: ` and the
error.
"""

import os
import sys

from tuf.api.exceptions import RepositoryError
from tuf.ngclient import Updater


def main() -> None:
    url, root, folder = sys.argv[1:]
    with open(root, "rb") as file:
        bootstrap = file.read()
    os.makedirs(folder, exist_ok=True)
    try:
        client = Updater(
            metadata_dir=folder,
            metadata_base_url=f"{url}/v1/metadata/",
            target_dir=folder,
            target_base_url=f"{url}/v1/targets/",
            bootstrap=bootstrap,
        )
        client.refresh()
        info = client.get_targetinfo("manifest")
        if info is None:
            sys.exit("the target `manifest` is not listed")
        print(os.path.getsize(client.download_target(info)))
    except RepositoryError as error:
        print(f"refused: {type(error).__name__}")


main()
