"""``python3 -m shoal_gym.peers``: how fast Gymnasium's own vectors step an environment. ``shoal bench gym`` asks."""

import argparse
import json
import time

import gymnasium as gym
import numpy as np


def steps_per_second(vector: gym.vector.VectorEnv, seconds: float) -> float:
    """Environment steps a second with the same action always, after a tenth of the time to warm up."""
    vector.reset(seed=1)
    action = np.full_like(vector.action_space.sample(), 0.5)
    steps, since = 0, None
    begun = time.perf_counter()
    while steps == 0 or time.perf_counter() - begun < seconds:
        if since is None and time.perf_counter() - begun >= 0.1 * seconds:
            steps, since = 0, time.perf_counter()
        vector.step(action)
        steps += vector.num_envs
    took = time.perf_counter() - (since or begun)
    vector.close()
    return steps / took


def main() -> None:
    parser = argparse.ArgumentParser(prog="shoal_gym.peers")
    parser.add_argument("--name", required=True, help="gym: and the id of an environment with box actions")
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--seconds", type=float, required=True, help="for each vector")
    arguments = parser.parse_args()
    name = arguments.name.removeprefix("gym:")

    def rate(mode: str) -> float:
        vector = gym.make_vec(name, num_envs=arguments.environments, vectorization_mode=mode)
        return steps_per_second(vector, arguments.seconds)

    rates = {f"{mode}_vector_steps_per_second": rate(mode) for mode in ("sync", "async")}
    print(json.dumps(rates))


if __name__ == "__main__":
    main()
