#!/usr/bin/env python3
"""Wall times of an encode alone and by a fleet of one and two workers on this machine, taken in turn.

usage: scripts/fleet_overhead.py FOLDER_OF_PROGRAMS [VIEWS [REPEATS]]

The fleet has a folder as bucket. Alone and one worker have two threads, two workers one each. Every store must have the manifest
of the first.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time

programs = os.path.abspath(sys.argv[1])
n_views = sys.argv[2] if len(sys.argv) > 2 else "16"
n_repeats = int(sys.argv[3]) if len(sys.argv) > 3 else 3
models = ["--models", "colours", "--device", "cpu"]
os.environ["SOURCE_DATE_EPOCH"] = "1700000000"


def start(*args):
    return subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def encode(n_workers, folder):
    encoder = f"{programs}/slag-encoder"
    command = [encoder, "encode", "--scene", f"{room}/scene.ply", "--views", f"{room}/transforms.json"]
    command += ["--name", "room", "--cell-gaussians", "4096", "--store", f"{folder}/store", "--threads", "2", *models]
    bucket = f"{folder}/bucket"
    begin = time.monotonic()
    if n_workers:
        command += ["--blobs", bucket]
    coordinator = start(*command)
    threads = str(2 // max(n_workers, 1))
    workers = [
        start(encoder, "worker", "--blobs", bucket, "--index", str(i), "--of", str(n_workers), "--threads", threads, *models)
        for i in range(n_workers)
    ]
    code = coordinator.wait()
    secs = time.monotonic() - begin
    if any([code, *(worker.wait() for worker in workers)]):
        sys.exit(f"{n_workers} workers: a program failed")
    with open(f"{folder}/store/manifest", "rb") as file:
        return secs, file.read()


with tempfile.TemporaryDirectory() as top:
    room = f"{top}/room"
    subprocess.run([f"{programs}/slag-lab", "generate", "scene", "--out", room, "--n-views", n_views], check=True, stdout=subprocess.DEVNULL)
    times = {n: [] for n in (0, 1, 2)}
    expected = None
    for repeat in range(n_repeats):
        for n in times:
            folder = f"{top}/{repeat}-{n}"
            os.mkdir(folder)
            secs, manifest = encode(n, folder)
            expected = expected or manifest
            if manifest != expected:
                sys.exit(f"{n} workers: another manifest")
            times[n].append(secs)
    alone = statistics.median(times[0])
    for n, secs in times.items():
        median = statistics.median(secs)
        name = f"{n} workers" if n else "alone"
        print(f"{name:10} median {median:6.2f} s, {min(secs):.2f} to {max(secs):.2f}, {median / alone:.3f} of alone")
