"""A cable between two network namespaces that delays every packet and loses some. Kernels without netem have no such
queue, so this program passes the packets between two TUN devices.

usage: slow_cable.py NAMESPACE ADDRESS NAMESPACE ADDRESS DELAY_MS LOSS

It prints "ready" when both devices are up, and ends when its standard input closes.
"""

import collections
import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import sys
import time

CLONE_NEWNET = 0x40000000
TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
PACKET = 1 << 16


def device(namespace, address):
    """A TUN device in this namespace, with its address. This process stays in the namespace."""
    with open(f"/var/run/netns/{namespace}") as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"cannot enter the namespace {namespace}")
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", b"slow0", IFF_TUN | IFF_NO_PI))
    subprocess.run(["ip", "addr", "add", f"{address}/24", "dev", "slow0"], check=True)
    subprocess.run(["ip", "link", "set", "slow0", "up", "txqueuelen", "10000"], check=True)
    return tun


def main():
    names, delay, loss = sys.argv[1:5], float(sys.argv[5]) / 1e3, float(sys.argv[6])
    ends = device(*names[:2]), device(*names[2:])
    print("ready", flush=True)
    # All packets are delayed equally, so they leave in the order of their arrival.
    under_way = collections.deque()
    while True:
        wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        readable, _, _ = select.select([*ends, sys.stdin], [], [], wait)
        if sys.stdin in readable and not sys.stdin.read(1):
            return
        for i, end in enumerate(ends):
            try:
                while end in readable:
                    packet = os.read(end, PACKET)
                    if random.random() >= loss:
                        under_way.append((time.monotonic() + delay, ends[1 - i], packet))
            except BlockingIOError:
                pass
        while under_way and under_way[0][0] <= time.monotonic():
            _, end, packet = under_way.popleft()
            try:
                os.write(end, packet)
            except BlockingIOError:
                pass


if __name__ == "__main__":
    main()
