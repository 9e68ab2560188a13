"""``python3 -m shoal_gym``: an environment server, as Shoal's launcher starts it."""

import argparse
import json
import os
import sys

import gymnasium as gym

from .environments import Environments
from .pictures import Pictures
from .port import Ended, Port, Unreachable
from .server import longest, serve
from .spaces import Unsupported


def main() -> int:
    parser = argparse.ArgumentParser(prog="shoal_gym", description="An environment server of Shoal.")
    parser.add_argument("--iceoryx2", required=True, help="file that says where the run lies in shared memory")
    parser.add_argument("--run", required=True, help="the run's name in shared memory")
    parser.add_argument("--index", type=int, required=True, help="which server of the run this is")
    parser.add_argument("--incarnation", type=int, required=True, help="which start of it")
    parser.add_argument("--client", required=True, help="who asks it: a role and its index, as actor/0")
    parser.add_argument("--environments", type=int, required=True, help="environments to step")
    parser.add_argument("--seed", type=int, required=True, help="the run's seed")
    parser.add_argument("--stream", type=int, required=True, help="part of the training episodes' seeds")
    parser.add_argument("--name", required=True, help="gym: and the environment's id")
    parser.add_argument("--parameters", type=json.loads, required=True, help="arguments of gymnasium.make, in JSON")
    arguments = parser.parse_args()
    # What follows is for the environment: code that is imported may read options or input of its own, and print.
    sys.argv = [arguments.client]
    control = _take_streams()
    try:
        environments = Environments(
            arguments.name.removeprefix("gym:"),
            arguments.parameters,
            arguments.environments,
            arguments.seed,
            arguments.index,
            arguments.stream,
            Pictures.wanted(),
        )
    except (Unsupported, gym.error.Error, ImportError, TypeError) as reason:
        print(f"error: {arguments.name}: {' '.join(str(reason).split())}", file=sys.stderr)
        return 1
    try:
        port = Port(
            arguments.iceoryx2,
            arguments.run,
            arguments.index,
            arguments.incarnation,
            arguments.client,
            longest(environments),
            control,
        )
        serve(environments, port)
    except Ended:
        pass
    except Unreachable as reason:
        print(f"error: {reason}", file=sys.stderr)
        return 1
    finally:
        environments.close()
    return 0


def _take_streams() -> int:
    """Gives the environment an empty standard input, and sends what it prints to the log. Returns a descriptor of the
    original standard input, by which the launcher ends this process."""
    control = os.dup(0)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return control


if __name__ == "__main__":
    sys.exit(main())
