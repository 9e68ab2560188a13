"""Writes the reference rollouts of Gymnasium that `tests/golden/main.rs` compares our environments with.

    pip install gymnasium==1.4.0 numpy==2.4.6
    python tests/golden/make_env_golden.py DIRECTORY

Writes pendulum_{0,1,2}.json, cart_pole_{0,1,2}.json and frozen_lake.json into DIRECTORY. These versions reproduce the
files beside this script byte for byte.
"""

import json
import pathlib
import sys

import gymnasium
import numpy as np

SEED = 7
STEPS = 200
ROLLOUTS = 3
# The discount of the value iteration on the lake, as in the thesis.
DISCOUNT = 0.999


def floats(values):
    return [float(value) for value in values]


def pendulum(rng):
    """A rollout of random actions from a random state."""
    environment = gymnasium.make("Pendulum-v1").unwrapped
    environment.reset(seed=SEED)
    initial = [rng.uniform(-np.pi, np.pi), rng.uniform(-2, 2)]
    environment.state = np.array(initial)
    actions, states, observations, rewards = [], [], [], []
    for _ in range(STEPS):
        # Some are beyond the bounds of 2: the environment clips them.
        action = float(rng.uniform(-2.5, 2.5))
        observation, reward, terminated, _, _ = environment.step(np.array([action], dtype=np.float64))
        assert not terminated
        actions.append([action])
        observations.append(floats(observation))
        rewards.append(float(np.asarray(reward).reshape(())))
        states.append(floats(environment.state))
    return {
        "env": "pendulum",
        "source": "gymnasium 1.4.0 Pendulum-v1",
        "initial_state": initial,
        "actions": actions,
        "states": states,
        "observations": observations,
        "rewards": rewards,
        "terminated": [False] * STEPS,
    }


def cart_pole(rng, balanced):
    """A rollout up to its end. Random actions end it early; a simple controller balances the pole for a long time."""
    environment = gymnasium.make("CartPole-v1").unwrapped
    environment.reset(seed=SEED)
    initial = rng.uniform(-0.05, 0.05, 4)
    environment.state = tuple(initial)
    actions, observations, rewards, terminations = [], [], [], []
    for _ in range(STEPS):
        _, _, angle, angular_velocity = environment.state
        action = int(angle + 0.3 * angular_velocity > 0) if balanced else int(rng.uniform() < 0.5)
        observation, reward, terminated, _, _ = environment.step(action)
        actions.append([action])
        observations.append(floats(observation))
        rewards.append(float(reward))
        terminations.append(bool(terminated))
        if terminated:
            break
    return {
        "env": "cart_pole",
        "source": "gymnasium 1.4.0 CartPole-v1",
        "initial_state": floats(initial),
        "actions": actions,
        "observations": observations,
        "rewards": rewards,
        "terminated": terminations,
    }


def frozen_lake():
    """The transitions of the slippery 4x4 lake, and Q* on them by value iteration."""
    model = gymnasium.make("FrozenLake-v1", map_name="4x4", is_slippery=True).unwrapped.P
    transitions = [
        [
            [
                {"p": float(p), "next": int(next), "reward": float(reward), "terminated": bool(terminated)}
                for p, next, reward, terminated in model[state][action]
            ]
            for action in range(4)
        ]
        for state in range(16)
    ]
    values = np.zeros(16)
    change = np.inf
    while change >= 1e-14:
        q = np.array([[backup(outcomes, values) for outcomes in of_state] for of_state in transitions])
        change = abs(q.max(1) - values).max()
        values = q.max(1)
    return {
        "env": "frozen_lake",
        "source": "gymnasium 1.4.0 FrozenLake-v1 4x4 slippery",
        "actions": ["left", "down", "right", "up"],
        "transitions": transitions,
        "q_star_gamma_0_999": q.tolist(),
    }


def backup(outcomes, values):
    return sum(
        outcome["p"] * (outcome["reward"] + DISCOUNT * values[outcome["next"]] * (not outcome["terminated"]))
        for outcome in outcomes
    )


def main():
    directory = pathlib.Path(sys.argv[1])
    directory.mkdir(parents=True, exist_ok=True)

    def write(name, data):
        (directory / name).write_text(json.dumps(data) + "\n")

    # All rollouts draw from one stream, so their order matters.
    rng = np.random.default_rng(SEED)
    for rollout in range(ROLLOUTS):
        write(f"pendulum_{rollout}.json", pendulum(rng))
    for rollout in range(ROLLOUTS):
        write(f"cart_pole_{rollout}.json", cart_pole(rng, balanced=rollout == 0))
    write("frozen_lake.json", frozen_lake())


main()
