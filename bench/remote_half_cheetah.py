"""Measures how long an actor of another host waits for the learner's host: for space in its window, or for a policy.

    pip install ./python 'gymnasium[mujoco]==1.4.0'
    cargo build --release --features remote
    python bench/remote_half_cheetah.py --shoal target/release/shoal

Two network namespaces are the hosts. The cable between them (`tests/hosts/slow_cable.py`) delays each packet. The
processes of each host are bound to one core. Both hosts have one actor with one HalfCheetah-v5; the learner makes a
gradient step in 500 environment steps, so that nobody waits for it. It needs root, iproute2 and /dev/net/tun.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SLOW_CABLE = Path(__file__).parent.parent / "tests" / "hosts" / "slow_cable.py"
ENVIRONMENT = "gym:HalfCheetah-v5"
SETTINGS = {"actors.envs": 1, "replay.updates_per_step": 0.002, "evaluation.every": 1_000_000, "learner.threads": 1}
LEARNER, OTHER = 0, 1
PORT = 7447
TIMEOUT_SECONDS, MEASURED_FROM = 60, 5

WAITED = re.compile(r"^actor-1 .*waited_us=(\d+)")


def namespace(host):
    return f"shoal-far-{os.getpid()}-{host}"


def address(host):
    return f"10.97.0.{host + 1}"


def command(host, *arguments):
    """On a host, with its own /dev/shm and directory of iceoryx2, on its core."""
    own = 'mount -t tmpfs tmpfs /dev/shm && mount -t tmpfs tmpfs "$0" && exec "$@"'
    root = Path(f"/tmp/shoal-{os.getuid()}")
    root.mkdir(mode=0o700, exist_ok=True)
    there = ["ip", "netns", "exec", namespace(host), "unshare", "--mount", "sh", "-c", own, str(root)]
    return [*there, "taskset", "-c", str(host), *map(str, arguments)]


def until(what, condition):
    deadline = time.monotonic() + TIMEOUT_SECONDS
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"waited {TIMEOUT_SECONDS} s for this in vain: {what}")
        time.sleep(0.1)


def waits(log):
    """The waits of the other host's actor so far, in seconds."""
    found = map(WAITED.match, log.read_text(errors="replace").splitlines())
    return [int(match[1]) / 1e6 for match in found if match]


def measure(program, seconds):
    """The share of the time that the actor waits, its longest wait in seconds, and its steps a second."""
    with tempfile.TemporaryDirectory() as directory:
        run, place = Path(directory, "run"), Path(directory, "host")
        environment = os.environ | {"SHOAL_LOG": "debug"}
        quiet = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
        endpoint = f"tls/{address(LEARNER)}:{PORT}"
        train = [program, "train", ENVIRONMENT, "--actors", "1", "--steps", "100000000", "--run", run]
        train += ["--listen", endpoint, "--quiet", *settings]
        learner = subprocess.Popen(command(LEARNER, *train), **quiet)
        hosts = [learner]
        try:
            until("the learner's host listens", lambda: (run / "join.key").exists())
            join = [program, "join", endpoint, "--key", run / "join.key", "--actors", "1", "--local", place]
            hosts.append(subprocess.Popen(command(OTHER, *join), **quiet))

            def rows_per_second():
                there = ["nsenter", "--target", str(learner.pid), "--mount", "--net"]
                output = subprocess.run([*there, program, "status", run, "--json"], capture_output=True, text=True)
                known = json.loads(output.stdout)["hosts"] if output.returncode == 0 else []
                return known[0]["rows_per_second"] if known else 0

            until("rows of the other host arrive", lambda: rows_per_second() > 0)
            time.sleep(MEASURED_FROM)
            before, begun, rates = len(waits(place / "shoal.log")), time.monotonic(), []
            while time.monotonic() < begun + seconds:
                time.sleep(1)
                rates.append(rows_per_second())
            length = time.monotonic() - begun
            found = waits(place / "shoal.log")[before:]
        finally:
            for host in hosts:
                host.terminate()
            for host in hosts:
                host.wait(TIMEOUT_SECONDS)
        return sum(found) / length, max(found, default=0), sum(rates) / len(rates)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shoal", default="target/release/shoal", type=Path)
    parser.add_argument("--seconds", default=30, type=int, help="of each measurement")
    parser.add_argument("--delays", default="0,1,20", help="milliseconds of a packet, each way")
    arguments = parser.parse_args()
    for host in (LEARNER, OTHER):
        subprocess.run(["ip", "netns", "add", namespace(host)], check=True)
        subprocess.run(["ip", "-n", namespace(host), "link", "set", "lo", "up"], check=True)
    try:
        for delay in arguments.delays.split(","):
            ends = [word for host in (LEARNER, OTHER) for word in (namespace(host), address(host))]
            cable = subprocess.Popen(
                [sys.executable, SLOW_CABLE, *ends, delay, "0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            cable.stdout.readline()
            share, longest, rate = measure(arguments.shoal.resolve(), arguments.seconds)
            print(f"{delay} ms: waits {share:.2%} of the time, longest {longest * 1e3:.1f} ms; {rate:.0f} steps/s")
            cable.communicate()
    finally:
        for host in (LEARNER, OTHER):
            subprocess.run(["ip", "netns", "del", namespace(host)], check=False)


if __name__ == "__main__":
    main()
