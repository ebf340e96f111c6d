#!/usr/bin/env python3
"""Many robots that start at once, then follow: bytes, seconds and p99 for `serve` on two cores and for a static
server; prints JSON.

usage: scripts/many_robots.py FOLDER_OF_PROGRAMS [ROBOTS [RADIUS_M]]

Each robot is a `slag-edge fetch` of its own, with a place of its own in the scene and an empty folder. All start at once. Then a
second generation is published, and all fetch once more. The server has cores 0 and 1, the robots the rest. Python's http.server is
the static one: one process, a thread a connection.
"""

import concurrent.futures
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time

programs = os.path.abspath(sys.argv[1])
n_robots = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
radius_m = sys.argv[3] if len(sys.argv) > 3 else "5"
encoder, edge, lab = (f"{programs}/slag-{name}" for name in ("encoder", "edge", "lab"))
cores = sorted(os.sched_getaffinity(0))
server_cores, robot_cores = (",".join(map(str, some)) for some in (cores[:2], cores[2:] or cores))
quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
os.environ["SLAG_EDGE_CONFIG"] = ""


def run(*args):
    subprocess.run(args, check=True, **quiet)


def encode(room, store, seed_flags=()):
    flags = ["--name", "room", "--cell-gaussians", "2048", "--models", "colours", "--device", "cpu", *seed_flags]
    run(encoder, "encode", "--scene", f"{room}/scene.ply", "--views", f"{room}/transforms.json", "--store", store, *flags)


def serve(store, top):
    process = subprocess.Popen(
        ["taskset", "-c", server_cores, encoder, "serve", "--store", store, "--listen", "127.0.0.1:0"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )
    for line in process.stdout:
        if found := re.search(r"http://127\.0\.0\.1:\d+", line):
            threading.Thread(target=process.stdout.read, daemon=True).start()
            return process, found[0]
    sys.exit("serve has ended")


def static(store, top):
    folder = f"{top}/static"
    run(encoder, "store", "export", "--store", store, "--out", folder)
    code = (
        "import http.server as h, functools, sys\n"
        "class H(h.SimpleHTTPRequestHandler):\n"
        "    protocol_version = 'HTTP/1.1'\n"
        "    def log_message(self, *a): pass\n"
        "class S(h.ThreadingHTTPServer): request_queue_size = 4096\n"
        "s = S(('127.0.0.1', 0), functools.partial(H, directory=sys.argv[1]))\n"
        "print(s.server_port, flush=True)\n"
        "s.serve_forever()"
    )
    command = ["taskset", "-c", server_cores, sys.executable, "-c", code, folder]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return process, f"http://127.0.0.1:{process.stdout.readline().strip()}"


def fetch(url, key, cache, place):
    command = ["taskset", "-c", robot_cores, edge, "fetch", "--json", "--from", url, "--cache", cache, *key]
    command += ["--at", ",".join(f"{x:.2f}" for x in place), "--radius", radius_m]
    begin = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True)
    secs = time.monotonic() - begin
    if done.returncode:
        return secs, None, f"exit {done.returncode}: {done.stdout[-500:]}{done.stderr[-500:]}"
    return secs, json.loads(done.stdout), None


def all_fetch(url, key, top, places, name):
    # One thread a robot: all are started at once.
    begin = time.monotonic()
    with concurrent.futures.ThreadPoolExecutor(len(places)) as pool:
        results = list(pool.map(lambda robot: fetch(url, key, f"{top}/{name}-{robot[0]}", robot[1]), enumerate(places)))
    wall = time.monotonic() - begin
    secs = sorted(result[0] for result in results)
    failed = [result[2] for result in results if result[1] is None]
    good = [result[1] for result in results if result[1]]
    n_bytes = sum(report["downloaded"]["bytes"] for report in good)
    retries = sum(report["retries"] for report in good)
    at = lambda share: secs[min(len(secs) - 1, int(share * len(secs)))]
    row = {"wall_s": wall, "p50_s": at(0.5), "p99_s": at(0.99), "max_s": secs[-1], "bytes": n_bytes, "retries": retries, "failed": len(failed)}
    return {**row, "first_failure": failed[0] if failed else None}


with tempfile.TemporaryDirectory() as top:
    room = f"{top}/room"
    run(lab, "generate", "scene", "--out", room, "--n-views", "24")
    rows = []
    for name, start in (("serve", serve), ("static", static)):
        store = f"{top}/store-{name}"
        encode(room, store)
        key = ["--trust-first"]
        process, url = start(store, top)
        rng = random.Random(7)
        places = [(rng.uniform(-2, 2), rng.uniform(-2, 2), 0.0) for _ in range(n_robots)]
        first = all_fetch(url, key, top, places, name)
        encode(room, store, ["--preset", "plain"])
        if name == "static":
            run(encoder, "store", "export", "--store", store, "--out", f"{top}/static")
        again = all_fetch(url, key, top, places, name)
        process.kill()
        rows.append({"server": name, "start": first, "follow": again})
    print(json.dumps({"cores": len(cores), "robots": n_robots, "radius_m": radius_m, "rows": rows}, indent=1))
