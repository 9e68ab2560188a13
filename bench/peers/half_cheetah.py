"""Compares Shoal with Stable-Baselines3's DDPG on HalfCheetah-v5 of Gymnasium.

    pip install ./python stable-baselines3==2.9.2 'gymnasium[mujoco]==1.4.0' matplotlib
    python bench/peers/half_cheetah.py --shoal target/release/shoal --minutes 60

Both train at the same time, each on one core with one thread. The settings are those of RL Baselines3 Zoo for DDPG on
its HalfCheetah (`hyperparams/ddpg.yml`, tuned for PyBullet's), and otherwise Stable-Baselines3's defaults. There are
two differences: in Shoal's critic the action enters at the second layer, and Shoal's output layers start with small
weights.

Both are evaluated every 10,000 steps with 10 episodes without exploration. Shoal's time counts from the start of the
program and includes its evaluations, which share its core. Stable-Baselines3's time is that of `learn` without its
evaluations. The evaluations are written to `docs/half-cheetah.csv` and the figure to `docs/half-cheetah.svg`. `--draw`
only draws the figure from the existing evaluations.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from wall_clock import returns_of

ENVIRONMENT = "HalfCheetah-v5"
EVERY = 10_000
EPISODES = 10
SETTINGS = {
    "ddpg.hidden": "[400, 300]",
    "ddpg.gamma": 0.98,
    "ddpg.tau": 0.005,
    "ddpg.actor_learning_rate": 1e-3,
    "ddpg.critic_learning_rate": 1e-3,
    "ddpg.batch": 256,
    # With theta = 1 nothing of the last step's noise remains, so the noise is independent and Gaussian.
    "exploration.theta": 1.0,
    "exploration.sigma": 0.1,
    "exploration.warmup": "uniform",
    "replay.capacity": 200_000,
    "replay.warmup": 10_000,
    "replay.updates_per_step": 1.0,
    "learner.threads": 1,
    "evaluation.every": EVERY,
    "evaluation.episodes": EPISODES,
}
DOCS = Path(__file__).parent.parent.parent / "docs"
COLUMNS = ["program", "seconds", "env_steps", "return_mean", "return_std"]


def begin_shoal(program, run, seed, core):
    command = [program, "train", f"gym:{ENVIRONMENT}", "--quiet", "--run", run, "--seed", str(seed)]
    command += ["--actors", "1", "--envs", "1", "--steps", "100000000"]
    command += [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    return subprocess.Popen(["taskset", "-c", str(core), *command])


def evaluated_by_shoal(run, seconds):
    """Evaluations in the first `seconds` after the program's start."""
    with (run / "evaluations.csv").open() as file:
        for row in csv.DictReader(file):
            if float(row["wall_seconds"]) <= seconds:
                yield ["Shoal", row["wall_seconds"], row["env_steps"], row["return_mean"], row["return_std"]]


def stable_baselines3(seed, core, seconds):
    """Trains for `seconds` and returns the evaluations."""
    os.sched_setaffinity(0, {core})
    import gymnasium
    import numpy as np
    import torch
    from stable_baselines3 import DDPG
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    torch.set_num_threads(1)
    environments = gymnasium.make_vec(ENVIRONMENT, num_envs=EPISODES, vectorization_mode="sync")

    class Evaluate(BaseCallback):
        def _on_training_start(self):
            self.begun = time.monotonic()
            self.evaluating = 0.0
            self.evaluated = []
            self._evaluate()

        def _on_step(self):
            if self.num_timesteps % EVERY == 0:
                self._evaluate()
            return time.monotonic() - self.begun - self.evaluating < seconds

        def _evaluate(self):
            before = time.monotonic()
            returns = returns_of(self.model, environments)
            at = before - self.begun - self.evaluating
            row = ["Stable-Baselines3", f"{at:.3f}", self.num_timesteps, returns.mean(), returns.std()]
            self.evaluated.append(row)
            print(*row, file=sys.stderr, flush=True)
            self.evaluating += time.monotonic() - before

    environment = gymnasium.make(ENVIRONMENT)
    width = environment.action_space.shape[0]
    evaluate = Evaluate()
    DDPG(
        "MlpPolicy",
        environment,
        gamma=0.98,
        tau=0.005,
        learning_rate=1e-3,
        batch_size=256,
        buffer_size=200_000,
        learning_starts=10_000,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(width), 0.1 * np.ones(width)),
        policy_kwargs={"net_arch": [400, 300]},
        seed=seed,
        device="cpu",
    ).learn(100_000_000, callback=evaluate)
    return evaluate.evaluated


def train(program, seed, minutes):
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        sys.exit("needs two cores, one for each program")
    with tempfile.TemporaryDirectory() as directory:
        run = Path(directory) / "run"
        begun = time.monotonic()
        process = begin_shoal(program, run, seed, cores[0])
        try:
            evaluated = stable_baselines3(seed, cores[1], 60 * minutes)
            time.sleep(max(0.0, begun + 60 * minutes - time.monotonic()))
            evaluated += evaluated_by_shoal(run, 60 * minutes)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
    with (DOCS / "half-cheetah.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS, *evaluated])


def draw():
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    with (DOCS / "half-cheetah.csv").open() as file:
        rows = list(csv.DictReader(file))
    pyplot.rcParams["svg.hashsalt"] = "shoal"
    figure, (by_time, by_steps) = pyplot.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for program, colour in (("Shoal", "#0072b2"), ("Stable-Baselines3", "#d55e00")):
        of = [row for row in rows if row["program"] == program]
        mean, spread = ([float(row[column]) for row in of] for column in ("return_mean", "return_std"))
        low, high = ([m + sign * s for m, s in zip(mean, spread)] for sign in (-1, 1))
        for axes, column, unit in ((by_time, "seconds", 60), (by_steps, "env_steps", 1_000)):
            at = [float(row[column]) / unit for row in of]
            axes.plot(at, mean, color=colour, label=program)
            axes.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
    by_time.set(title=f"{ENVIRONMENT}, DDPG, one core each", xlabel="minutes", ylabel="return of 10 episodes")
    by_steps.set(title="the same by steps", xlabel="thousand environment steps")
    for axes in (by_time, by_steps):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    by_time.legend(frameon=False, loc="upper left")
    figure.savefig(DOCS / "half-cheetah.svg", metadata={"Date": None})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shoal", default="target/release/shoal", help="path of the program")
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the training")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draw", action="store_true", help="only draw the figure")
    arguments = parser.parse_args()
    if not arguments.draw:
        train(arguments.shoal, arguments.seed, arguments.minutes)
    draw()


if __name__ == "__main__":
    main()
