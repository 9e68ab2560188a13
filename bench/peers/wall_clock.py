"""Time to learn Pendulum: Shoal's preset compared with Stable-Baselines3's DDPG with the same settings.

    pip install stable-baselines3==2.9.2 gymnasium==1.4.0
    python bench/peers/wall_clock.py --shoal target/release/shoal --seeds 5

For each seed, first Shoal and then Stable-Baselines3 runs, alone on the machine. Both are evaluated every 1,000 steps
with episodes without exploration, whose starts are distributed as in Gymnasium. The time counts to the first mean
return of at least -160.

Stable-Baselines3 is evaluated with 1,000 episodes. Shoal is evaluated with only 100, because its evaluations count as
time. To correct for lucky starts, its best policy is evaluated at the end with the same 100 episodes and with 1,000
others, and the difference is subtracted from Shoal's evaluations.

Shoal's time counts from the start of the program and includes its evaluations. Stable-Baselines3's time is that of
`learn` without its evaluations and without its imports. Networks, learning rates, noise and replay are those of the
thesis for both (section 4.3.1). PyTorch's settings are its defaults. The last line of standard output is one JSON
object.
"""

import argparse
import csv
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

THRESHOLD = -160.0
STARTS = 1_000
"""The mean over 100 starts has a standard error of 9, over 1,000 starts of 3. A seed always has the same starts, so the
error is the same in every evaluation."""
EVERY = 1_000
STEPS = 40_000
"""A seed that needs more steps has failed."""


def shoal(program, seed):
    """Seconds and steps from the program's start to the first good evaluation; None if there was none."""
    with tempfile.TemporaryDirectory() as directory:
        run = Path(directory) / "run"
        settings = ["environment.start_speed=1", f"evaluation.every={EVERY}", "evaluation.episodes=100"]
        command = [program, "train", "pendulum", "--quiet", "--run", run, "--seed", str(seed), "--steps", str(STEPS)]
        command += [word for it in settings for word in ("--set", it)]
        subprocess.run(command, check=True)
        same_starts = evaluated(program, run, "--episodes", "100")
        luck = same_starts - evaluated(program, run, "--episodes", str(STARTS), "--seed", "10000")
        with (run / "evaluations.csv").open() as file:
            for row in csv.DictReader(file):
                if float(row["return_mean"]) - luck >= THRESHOLD:
                    return float(row["wall_seconds"]), int(row["env_steps"])
    return None


def evaluated(program, run, *which):
    """The mean return of a run's best policy."""
    output = subprocess.run([program, "eval", run, "--json", *which], check=True, capture_output=True, text=True).stdout
    return json.loads(output.splitlines()[-1])["return_mean"]


def stable_baselines3(seed):
    """The same as shoal() for Stable-Baselines3; counts seconds of training only."""
    import gymnasium
    import numpy as np
    import torch
    from stable_baselines3 import DDPG
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
    from stable_baselines3.common.policies import ContinuousCritic
    from stable_baselines3.td3.policies import TD3Policy

    class LateAction(torch.nn.Module):
        """The thesis's critic: the action enters at the second layer."""

        def __init__(self, observation, action):
            super().__init__()
            self.observation = observation
            self.first = torch.nn.Linear(observation, 400)
            self.second = torch.nn.Linear(400 + action, 300)
            self.third = torch.nn.Linear(300, 1)

        def forward(self, both):
            hidden = torch.relu(self.first(both[:, : self.observation]))
            return self.third(torch.relu(self.second(torch.cat([hidden, both[:, self.observation :]], dim=1))))

    class Critic(ContinuousCritic):
        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            self.qf0 = LateAction(self.observation_space.shape[0], self.action_space.shape[0])
            self.q_networks = [self.qf0]

    class Policy(TD3Policy):
        def make_critic(self, features_extractor=None):
            return Critic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

    class Thesis(DDPG):
        """DDPG with a learning rate for each network; the library has one for both."""

        def _update_learning_rate(self, optimizers):
            for optimizer, rate in ((self.actor.optimizer, 1e-4), (self.critic.optimizer, 1e-3)):
                for group in optimizer.param_groups:
                    group["lr"] = rate

    class Evaluate(BaseCallback):
        good = None
        evaluating = 0.0

        def _on_training_start(self):
            self.begun = time.monotonic()

        def _on_step(self):
            if self.num_timesteps % EVERY:
                return True
            before = time.monotonic()
            if returns_of(self.model, evaluated).mean() >= THRESHOLD:
                self.good = before - self.begun - self.evaluating, self.num_timesteps
                return False
            self.evaluating += time.monotonic() - before
            return True

    model = Thesis(
        Policy,
        gymnasium.make("Pendulum-v1"),
        buffer_size=1_000_000,
        learning_starts=1_000,
        batch_size=64,
        tau=0.001,
        gamma=0.99,
        train_freq=1,
        gradient_steps=1,
        action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.2 * np.ones(1), theta=0.15, dt=1.0),
        policy_kwargs={"net_arch": [400, 300]},
        seed=seed,
        device="cpu",
    )
    evaluated = gymnasium.make_vec("Pendulum-v1", num_envs=STARTS, vectorization_mode="sync")
    evaluate = Evaluate()
    model.learn(STEPS, callback=evaluate)
    return evaluate.good


def returns_of(model, environments):
    """Returns of one episode in each environment without exploration, with the same starts every time.

    All episodes must end at the time limit.
    """
    observations, _ = environments.reset(seed=10_000)
    total, over = 0.0, False
    while not over:
        actions, _ = model.predict(observations, deterministic=True)
        observations, rewards, _, truncated, _ = environments.step(actions)
        total = total + rewards
        over = truncated.all()
    return total


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shoal", default="target/release/shoal", help="path of the program")
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    times = {"shoal": [], "stable_baselines3": []}
    for seed in range(1, arguments.seeds + 1):
        trainings = {
            "shoal": lambda: shoal(arguments.shoal, seed),
            "stable_baselines3": lambda: stable_baselines3(seed),
        }
        for who, train in trainings.items():
            reached = train()
            times[who].append(reached)
            result = f"{reached[0]:.1f} s, {reached[1]} steps" if reached else f"not within {STEPS} steps"
            print(f"seed {seed}, {who}: {result}", file=sys.stderr, flush=True)
    medians = {
        # A failed seed counts as later than any other.
        who: statistics.median(it[0] if it else float("inf") for it in reached)
        for who, reached in times.items()
    }
    ratio = medians["stable_baselines3"] / medians["shoal"]
    results = {
        "threshold": THRESHOLD,
        "seconds_and_steps": times,
        "median_seconds": {who: finite(median) for who, median in medians.items()},
        "times_as_fast": finite(ratio),
    }
    print(json.dumps(results))


def finite(number):
    """The number, or None for a number that JSON does not have."""
    return number if math.isfinite(number) else None


if __name__ == "__main__":
    main()
