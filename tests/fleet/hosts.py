#!/usr/bin/env python3
"""Hosts as network namespaces, and the network between them: IP packets are delayed, lost and cut off, and TCP
makes up for it.

Each host has a namespace of its own with one device, a TUN, whose other end is this program. Kernels without netem can do
it, too. Needs Linux, root, /dev/net/tun and iproute2's ip.

usage: hosts.py PREFIX N
Makes the namespaces PREFIX0 ... PREFIX(N-1) with the addresses 10.77.0.1 ... 10.77.0.N and prints `ready`. Each line on
stdin, `HOST DELAY_SECS LOSS CUT`, sets the way to and from a host: seconds for each direction, the share of packets lost,
and 1 if nothing comes through; it is answered by the packets carried and lost so far. At the end of stdin the namespaces go.
"""
import fcntl
import heapq
import os
import random
import selectors
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000

prefix, n = sys.argv[1], int(sys.argv[2])
names = [f"{prefix}{host}" for host in range(n)]


def ip(*args):
    subprocess.run(["ip", *args], check=True)


def open_device(host):
    """Returns the file of a host's device, which lies in its namespace under its address."""
    name = names[host]
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    ip("netns", "add", name)
    ip("link", "set", name, "netns", name)
    ip("-n", name, "address", "add", f"10.77.0.{host + 1}/24", "dev", name)
    for link in ("lo", name):
        ip("-n", name, "link", "set", link, "up")
    return device


def carry(devices):
    chance = random.Random(1)
    ways = [(0.0, 0.0, False)] * n  # of each host: delay, loss, whether it is cut off
    due = []  # heap of (time, number, host, packet)
    carried = lost = number = 0
    files = selectors.DefaultSelector()
    for host, device in enumerate(devices):
        files.register(device, selectors.EVENT_READ, host)
    os.set_blocking(0, False)
    files.register(0, selectors.EVENT_READ, None)
    print("ready", flush=True)
    lines = b""
    while True:
        wait = max(0.0, due[0][0] - time.monotonic()) if due else None
        for key, _ in files.select(wait):
            if key.data is None:
                piece = os.read(0, 4096)
                if not piece:
                    return
                *whole, lines = (lines + piece).split(b"\n")
                for line in whole:
                    host, delay, loss, cut = line.split()
                    ways[int(host)] = (float(delay), float(loss), cut == b"1")
                    print(carried, lost, flush=True)
                continue
            try:
                packet = os.read(key.fd, 65536)
            except BlockingIOError:
                continue
            # IPv4 within 10.77.0.0/24; the devices see nothing else but multicast.
            if packet[0] >> 4 != 4 or packet[16:19] != bytes([10, 77, 0]) or not 1 <= packet[19] <= n:
                continue
            to = packet[19] - 1
            both = (ways[key.data], ways[to])
            if any(is_cut or chance.random() < loss for _, loss, is_cut in both):
                lost += 1
                continue
            number += 1
            heapq.heappush(due, (time.monotonic() + sum(delay for delay, _, _ in both), number, to, packet))
        now = time.monotonic()
        while due and due[0][0] <= now:
            _, _, to, packet = heapq.heappop(due)
            carried += 1
            try:
                os.write(devices[to], packet)
            except OSError:  # its queue is full: one packet lost more
                lost += 1


made = []
try:
    for host in range(n):
        made.append(open_device(host))
    carry(made)
finally:
    for name in names[: len(made)]:
        subprocess.run(["ip", "netns", "delete", name])
