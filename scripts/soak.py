#!/usr/bin/env python3
"""Soak: a robot is asked ten times what it answers while its store changes, its keys rotate and its disk fills up.

    soak.py --disk DIR [--minutes N] [--bin target/debug]

DIR is a folder of a small file system that nothing else uses: the robot's storage goes there, and it is filled up now and
then. As root: `mount -t tmpfs -o size=64m none DIR`. Ends with one line of JSON, and exit code 1 unless all of this holds:

- the same question of the same generation always gets the same answer, and generations never go back
- answers are 200 or 503 with Retry-After, nothing else; no connection breaks
- a full disk and rotated keys cost no answers, and the newest generation arrives once there is space again
- memory in the last quarter is at most 5 % and 8 MiB above that of the second quarter
"""

import argparse
import http.client
import json
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

TEXTS = ["red", "blue", "green", "yellow", "grey"]


class Service:
    """A program that says where it listens."""

    def __init__(self, *command: object) -> None:
        words = [str(word) for word in command]
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in self.process.stdout:
            if found := re.search(r"http://\S+", line):
                self.url = found[0]
                return
        sys.exit(f"{words} did not listen")


def ask(url: str, body: object = None) -> tuple[int, bytes]:
    host, path = re.fullmatch(r"http://([^/]+)(/.*)", url).groups()
    # From an address of its own: the clients of the load may take all connections of one peer.
    connection = http.client.HTTPConnection(host, timeout=600, source_address=("127.0.0.2", 0))
    try:
        if body is None:
            connection.request("GET", path)
        else:
            connection.request("POST", path, json.dumps(body), {"Content-Type": "application/json"})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


class Checked:
    """Answers so far, by generation and text."""

    def __init__(self, url: str) -> None:
        self.url, self.seen, self.last, self.n, self.wrong = url, {}, 0, 0, []

    def look(self) -> None:
        for text in TEXTS:
            status, body = ask(f"{self.url}/query?text={text}&limit=20")
            if status == 503:
                continue
            answer = json.loads(body)
            answer = answer[0] if isinstance(answer, list) else answer
            generation = answer.get("generation")
            # What is measured differs; what is found does not.
            found = json.dumps(answer.get("answers"), sort_keys=True)
            self.n += 1
            if status != 200 or generation is None or generation < self.last:
                self.wrong.append(f"{text}: status {status}, generation {generation} after {self.last}")
            elif self.seen.setdefault((generation, text), found) != found:
                self.wrong.append(f"{text} of generation {generation}: another answer than before")
            self.last = max(self.last, generation or 0)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--disk", type=pathlib.Path, required=True)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("target/debug"))
    parser.add_argument("--clients", type=int, default=320)
    # A question whose answer costs many refusals, which share the cores with it.
    parser.add_argument("--with", dest="rest", default="kind=clusters&threshold=-1&min_count=1&voxel=0.2&limit=1")
    args = parser.parse_args()
    encoder, edge, lab = (args.bin / name for name in ("slag-encoder", "slag-edge", "slag-lab"))
    work = pathlib.Path(tempfile.mkdtemp())
    room, store, cache = work / "room", work / "store", args.disk / "cache"

    def run(*command: object) -> None:
        done = subprocess.run([str(word) for word in command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        if done.returncode:
            sys.exit(f"{command}: {done.stderr.decode()}")

    def encode(number: int) -> None:
        # Other shards each time, from the same views.
        run(encoder, "encode", "--scene", room / "scene.ply", "--views", room / "transforms.json", "--metric",
            "--models", "colours", "--device", "cpu", "--cell-gaussians", 4096, "--keep-views", "--quiet",
            "--compact-error", f"{0.1 + 0.02 * (number % 5):.2f}", "--store", store)

    run(lab, "generate", "scene", "--out", room, "--n-views", 4)
    encode(0)
    services = [Service(encoder, "serve", "--store", store, "--listen", "127.0.0.1:0", "--quiet")]
    load = None
    n_rotations, n_full, generation = 0, 0, 1
    try:
        services.append(Service(edge, "serve", "--models", "colours", "--cache", cache, "--listen", "127.0.0.1:0",
                                "--follow", services[0].url, "--trust-first", "--refresh-secs", 5))
        robot = services[1]
        position = {"x": 3.5, "y": 2.7, "z": 0}
        if ask(f"{robot.url}/position", position)[0] != 202:
            sys.exit("the position is not taken")
        while ask(f"{robot.url}/readyz")[0] != 200:
            time.sleep(0.5)
        checked = Checked(robot.url)
        checked.look()
        end = time.monotonic() + 60 * args.minutes
        load = subprocess.Popen([str(lab), "bench", "load", "--url", robot.url, "--seconds",
                                 str(int(60 * args.minutes)), "--clients", str(args.clients), "--with", args.rest,
                                 "--pid", str(robot.process.pid)], stdout=subprocess.PIPE, text=True)
        filler, turn = args.disk / "filler", 0
        while time.monotonic() < end and load.poll() is None:
            checked.look()
            turn += 1
            if turn % 6 == 1:
                generation += 1
                encode(generation)
            if turn % 6 == 3:
                run(encoder, "keys", "rotate", "timestamp", "snapshot", "targets", "--store", store, "--quiet")
                n_rotations += 1
            if turn % 6 == 4:
                # Unbuffered: a buffer would be written once more when the file is closed.
                with open(filler, "wb", buffering=0) as file:
                    try:
                        while True:
                            file.write(bytes(1 << 16))
                    except OSError:
                        n_full += 1
            if turn % 6 == 0:
                filler.unlink(missing_ok=True)
            position["x"] = 2.5 + turn % 3
            ask(f"{robot.url}/position", position)
            time.sleep(2)
        filler.unlink(missing_ok=True)
        report = json.loads(load.communicate()[0])
        # With the load gone and space again, the newest generation arrives.
        deadline = time.monotonic() + 120
        while checked.last < generation and time.monotonic() < deadline:
            time.sleep(1)
            checked.look()
    finally:
        for process in [service.process for service in services] + ([load] if load else []):
            process.kill()
        shutil.rmtree(work, ignore_errors=True)
        shutil.rmtree(cache, ignore_errors=True)
    memory = report["memory"]
    is_flat = memory["late_max_bytes"] <= memory["early_max_bytes"] * 1.05 + (8 << 20)
    fine = not checked.wrong and is_flat and checked.last == generation
    fine = fine and not report["n_other_status"] + report["n_broken"] + report["n_without_retry_after"]
    print(json.dumps({
        "is_fine": fine, "minutes": args.minutes, "n_checked": checked.n, "wrong": checked.wrong[:10],
        "n_generations": generation, "last_seen": checked.last, "n_rotations": n_rotations,
        "n_full_disks": n_full, "load": report,
    }))
    sys.exit(0 if fine else 1)


main()
