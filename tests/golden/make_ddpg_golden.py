"""Writes the reference updates of PyTorch that `tests/golden/updates.rs` compares our DDPG with.

    pip install torch==2.15.0 numpy==2.4.6
    python tests/golden/make_ddpg_golden.py DIRECTORY

Writes ddpg_update_3x1.json and ddpg_update_6x2.json into DIRECTORY. Networks and minibatches are the same, bit for bit,
wherever numpy draws the same numbers. The results of autograd and Adam may differ between machines in the last bits.

An update is steps 11 to 16 of the thesis's Algorithm 4: first the critic, then the actor through the updated critic,
then both targets. Actions are in the environment's units everywhere. The numbers are float64. Each file also states the
largest difference that float32 makes.
"""

import json
import pathlib
import sys

import numpy as np
import torch

UPDATES = 4
GAMMA = 0.99
TAU = 0.001
ACTOR_LEARNING_RATE = 1e-4
CRITIC_LEARNING_RATE = 1e-3
# PyTorch's defaults. The test checks that the learner uses the same.
ADAM = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8}

# By the end of the file's name: seed, widths of observations and actions, hidden units of both layers, minibatch size.
CASES = {
    "3x1": (1, 3, 1, 20, 12, 8),
    "6x2": (2, 6, 2, 16, 14, 16),
}


class Case:
    """Networks and minibatches drawn at random, and the updates that follow from them."""

    def __init__(self, seed, observation, action, hidden1, hidden2, batch):
        self.sizes = (observation, action, hidden1, hidden2)
        rng = np.random.default_rng(seed)
        self.low, self.high = -(1.0 + np.arange(action)), 1.5 + np.arange(action)

        def layer(outputs, inputs, bound=None):
            bound = bound or 1 / np.sqrt(inputs)
            return rng.uniform(-bound, bound, (outputs, inputs)), rng.uniform(-bound, bound, outputs)

        def network(*layers):
            named = enumerate(layers, 1)
            return {f"{kind}{n}": numbers for n, layer in named for kind, numbers in zip("wb", layer)}

        def near(parameters):
            return {name: numbers + rng.normal(0, 0.01, numbers.shape) for name, numbers in parameters.items()}

        # The order of the random draws matters.
        actor = network(layer(hidden1, observation), layer(hidden2, hidden1), layer(action, hidden2, 0.3))
        critic = network(layer(hidden1, observation), layer(hidden2, hidden1 + action), layer(1, hidden2, 0.3))
        # The targets differ from the trained networks, as in the middle of a run.
        self.initial = {
            "actor": actor,
            "critic": critic,
            "target_actor": near(actor),
            "target_critic": near(critic),
        }
        self.batches = [
            {
                "s": rng.normal(0, 1, (batch, observation)),
                "a": rng.uniform(self.low, self.high, (batch, action)),
                "r": rng.normal(-1, 1, batch),
                "s2": rng.normal(0, 1, (batch, observation)),
                "terminated": rng.uniform(size=batch) < 0.15,
            }
            for _ in range(UPDATES)
        ]

    def updates(self, dtype):
        """Losses and all parameters after each update, computed in this precision."""

        def tensor(numbers):
            return torch.tensor(np.asarray(numbers, dtype=np.float64), dtype=dtype)

        networks = {
            name: {key: tensor(numbers).requires_grad_(not name.startswith("target")) for key, numbers in of.items()}
            for name, of in self.initial.items()
        }
        actor, critic, target_actor, target_critic = networks.values()
        low, high = tensor(self.low), tensor(self.high)

        def act(p, s):
            h = torch.relu(s @ p["w1"].T + p["b1"])
            h = torch.relu(h @ p["w2"].T + p["b2"])
            return (high + low) / 2 + (high - low) / 2 * torch.tanh(h @ p["w3"].T + p["b3"])

        def value(p, s, a):
            h = torch.relu(s @ p["w1"].T + p["b1"])
            h = torch.relu(torch.cat([h, a], 1) @ p["w2"].T + p["b2"])
            return (h @ p["w3"].T + p["b3"]).squeeze(1)

        def step(optimizer, loss):
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

        actor_adam = torch.optim.Adam(actor.values(), lr=ACTOR_LEARNING_RATE)
        critic_adam = torch.optim.Adam(critic.values(), lr=CRITIC_LEARNING_RATE)
        results = []
        for batch in self.batches:
            s, a, r, s2, terminated = (tensor(batch[key]) for key in ("s", "a", "r", "s2", "terminated"))
            with torch.no_grad():
                y = r + GAMMA * (1 - terminated) * value(target_critic, s2, act(target_actor, s2))
            critic_loss = ((y - value(critic, s, a)) ** 2).mean()
            step(critic_adam, critic_loss)
            actor_loss = -value(critic, s, act(actor, s)).mean()
            step(actor_adam, actor_loss)
            with torch.no_grad():
                for target, trained in ((target_actor, actor), (target_critic, critic)):
                    for key in target:
                        target[key].mul_(1 - TAU).add_(trained[key], alpha=TAU)
            parameters = {
                name: {key: numbers.detach().double().numpy().copy() for key, numbers in of.items()}
                for name, of in networks.items()
            }
            results.append({"critic_loss": float(critic_loss), "actor_loss": float(actor_loss), **parameters})
        return results

    def document(self):
        """The content of the file."""
        observation, action, hidden1, hidden2 = self.sizes
        in64, in32 = self.updates(torch.float64), self.updates(torch.float32)
        gaps = (
            np.abs(a[name][key] - b[name][key]).max()
            for a, b in zip(in64, in32)
            for name in self.initial
            for key in a[name]
        )
        return {
            "source": f"torch {torch.__version__} autograd, float64",
            "obs_dim": observation,
            "act_dim": action,
            "hidden": [hidden1, hidden2],
            "action_low": plain(self.low),
            "action_high": plain(self.high),
            "gamma": GAMMA,
            "tau": TAU,
            "actor_lr": ACTOR_LEARNING_RATE,
            "critic_lr": CRITIC_LEARNING_RATE,
            "adam": ADAM,
            "layout": "w1[out][in]; critic w2 columns: the h1 hidden units, then the actions",
            "largest_float32_difference": float(max(gaps)),
            "initial": plain(self.initial),
            "batches": plain(self.batches),
            "expected": plain(in64),
        }


def plain(value):
    """Converts arrays to lists, which JSON can represent."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [plain(part) for part in value]
    return np.asarray(value).tolist()


def main():
    directory = pathlib.Path(sys.argv[1])
    directory.mkdir(parents=True, exist_ok=True)
    for name, sizes in CASES.items():
        document = Case(*sizes).document()
        (directory / f"ddpg_update_{name}.json").write_text(json.dumps(document) + "\n")


if __name__ == "__main__":
    main()
