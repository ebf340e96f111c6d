#!/usr/bin/env python3
"""Wall times of an encode alone and by a fleet of 1, 2 and 4 workers on this machine, taken in turn; prints JSON.

usage: scripts/fleet_overhead.py FOLDER_OF_PROGRAMS [VIEWS [REPEATS]]

The fleet has a folder as bucket. Each worker has two threads on two cores of its own; an encode alone, and the coordinator beside
the first worker, have that worker's two. Fleets that need more cores than the machine has are left out. Every store must have the
manifest of the first. Views are the scene's; what the workers did is what they report.
"""

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time

programs = os.path.abspath(sys.argv[1])
n_views = sys.argv[2] if len(sys.argv) > 2 else "48"
n_repeats = int(sys.argv[3]) if len(sys.argv) > 3 else 3
encoder = f"{programs}/slag-encoder"
models = ["--models", "colours", "--device", "cpu"]
os.environ["SOURCE_DATE_EPOCH"] = "1700000000"
cores = sorted(os.sched_getaffinity(0))


def start(worker, *args):
    """Starts a program on the two cores of a worker."""
    two = ",".join(str(core) for core in cores[2 * worker : 2 * worker + 2])
    return subprocess.Popen(["taskset", "-c", two, *args], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def encode(n_workers, folder):
    command = [encoder, "encode", "--json", "--scene", f"{room}/scene.ply", "--views", f"{room}/transforms.json"]
    command += ["--name", "room", "--cell-gaussians", "4096", "--store", f"{folder}/store", "--threads", "2", *models]
    bucket = f"{folder}/bucket"
    begin = time.monotonic()
    coordinator = start(0, *command, *(["--blobs", bucket] if n_workers else []))
    work = [encoder, "worker", "--json", "--blobs", bucket, "--of", str(n_workers), "--threads", "2", *models]
    workers = [start(i, *work, "--index", str(i)) for i in range(n_workers)]
    summary = json.loads(coordinator.communicate()[0] or "null")
    secs = time.monotonic() - begin
    reports = [json.loads(worker.communicate()[0] or "null") for worker in workers]
    if not summary or not all(reports):
        sys.exit(f"{n_workers} workers: a program failed")
    with open(f"{folder}/store/manifest", "rb") as file:
        return secs, file.read(), [report["n_views"] for report in reports], summary


with tempfile.TemporaryDirectory() as top:
    room = f"{top}/room"
    generate = [f"{programs}/slag-lab", "generate", "scene", "--out", room, "--n-views", n_views]
    subprocess.run(generate, check=True, stdout=subprocess.DEVNULL)
    counts = [n for n in (0, 1, 2, 4) if 2 * n <= len(cores)]
    times, last, expected = {n: [] for n in counts}, {}, None
    for repeat in range(n_repeats):
        for n in counts:
            folder = f"{top}/{repeat}-{n}"
            os.mkdir(folder)
            secs, manifest, last[n], summary = encode(n, folder)
            expected = expected or manifest
            if manifest != expected:
                sys.exit(f"{n} workers: another manifest")
            times[n].append(secs)
    alone = statistics.median(times[0])
    rows = []
    for n, secs in times.items():
        median = statistics.median(secs)
        row = {"workers": n, "median_s": median, "min_s": min(secs), "max_s": max(secs), "of_alone": median / alone}
        rows.append({**row, "views_by_worker": last[n]})
    machine = {"cpu": platform.processor() or platform.machine(), "cores": len(cores)}
    print(json.dumps({"machine": machine, "views": int(n_views), "repeats": n_repeats, "rows": rows}, indent=1))
