"""Replays as datasets of Minari, read by its own loader, and datasets as the first rows of a replay: bit for bit."""

import collections
import os
import shutil
import warnings
from pathlib import Path

import gymnasium
import minari
import numpy as np
import shoal
from shoal import episodes

# Minari's advice about what a dataset could also say.
warnings.simplefilter("ignore")
os.environ["MINARI_DATASETS_PATH"] = str(Path.cwd() / "datasets")
QUICK = {"evaluation.episodes": 1, "evaluation.final_episodes": 1, "checkpoint.every_updates": 100}
SMALL = {**QUICK, "ddpg.hidden": [16, 16]}


def same(a, b):
    """Whether the bits of the floats agree."""
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.dtype == b.dtype == np.float32 and a.tobytes() == b.tobytes()


def lines(batch, indices):
    """Rows of the replay, as sorted bits."""
    columns = [batch.observation, batch.action, batch.reward[:, None], batch.discount[:, None], batch.next_observation]
    return sorted(line.tobytes() for line in np.hstack([*columns, batch.last[:, None].astype(np.float32)])[indices])


def check(run, name, gamma, discrete=False):
    """Compares the dataset of this name with the run's replay, row for row. Returns it."""
    dataset = minari.load_dataset(name)
    found = episodes.episodes(run)
    batch = found.batch
    assert dataset.total_episodes == len(found.indices) and dataset.total_steps == len(batch) > 0
    assert sorted(np.concatenate(found.indices).tolist()) == list(range(len(batch))), "each row once"
    written = []
    for episode, indices in zip(dataset.iterate_episodes(), found.indices, strict=True):
        steps = len(indices)
        assert len(episode.observations) == steps + 1 and len(episode.rewards) == steps
        observations = np.asarray(episode.observations).reshape(steps + 1, -1)
        if discrete:
            actions = np.asarray(episode.actions)
            assert actions.dtype == np.int64 and actions.shape == (steps,)
            actions = actions.astype(np.float32).reshape(steps, -1)
        else:
            actions = np.asarray(episode.actions).reshape(steps, -1)
        assert same(observations[:-1], batch.observation[indices])
        assert same(observations[1:], batch.next_observation[indices])
        assert same(actions, batch.action[indices]) and same(episode.rewards, batch.reward[indices])
        assert not (episode.terminations | episode.truncations)[:-1].any(), "an episode ends with its last row"
        assert np.array_equal(episode.terminations | episode.truncations, batch.last[indices])
        assert np.array_equal(episode.terminations, batch.discount[indices] == 0)
        assert np.array_equal(episode.truncations, batch.last[indices] & (batch.discount[indices] != 0))
        discount = np.where(episode.terminations, 0, gamma).astype(np.float32)[:, None]
        ends = (episode.terminations | episode.truncations).astype(np.float32)[:, None]
        rows = [observations[:-1], actions, np.asarray(episode.rewards)[:, None], discount, observations[1:], ends]
        written += [line.tobytes() for line in np.hstack(rows).astype(np.float32)]
    assert sorted(written) == lines(batch, slice(None)), "no row is missing or changed"
    return dataset


def first_rows(run, count):
    return run.transitions().copy()[:count]


def equal(a, b):
    fields = ("observation", "action", "reward", "discount", "next_observation")
    assert len(a) == len(b) and all(same(getattr(a, field), getattr(b, field)) for field in fields)
    assert np.array_equal(a.last, b.last)


def refused(attempt, *parts):
    try:
        attempt()
    except shoal.ShoalError as error:
        assert all(part in str(error) for part in parts) and "\n" not in str(error), (parts, str(error))
    else:
        raise AssertionError(f"{parts}: no error")


# One actor with one environment: the dataset has the replay's rows in their order, and back again.
alone = shoal.train("pendulum", run="alone", steps=1_900, actors=1, seed=3, set=SMALL, quiet=True)
made = alone.to_minari("pendulum/alone-v0", author="nobody", author_email="nobody@example.org", code_permalink="none")
assert made.total_episodes == 10 and made.total_steps == 1_900
dataset = check(alone, "pendulum/alone-v0", 0.99)
lengths = [len(episode.rewards) for episode in dataset.iterate_episodes()]
assert lengths == [200] * 9 + [100], lengths
assert [bool(episode.truncations[-1]) for episode in dataset.iterate_episodes()] == [True] * 9 + [False]
assert dataset.observation_space == gymnasium.spaces.Box(
    np.array([-1, -1, -8], np.float32), np.array([1, 1, 8], np.float32), dtype=np.float32
), dataset.observation_space
assert dataset.action_space == gymnasium.spaces.Box(-2, 2, (1,), np.float32)
metadata = dataset.storage.metadata
assert metadata["algorithm_name"] == "Shoal ddpg" and set(metadata["author"]) == {"nobody"}, metadata
assert "the environment pendulum" in metadata["description"], metadata
assert minari.list_local_datasets()["pendulum/alone-v0"]["total_steps"] == 1_900

warm = {**SMALL, "replay.warmup": 64}
began = shoal.train(
    "pendulum", run="began", steps=300, seed=4, set=warm, demonstrations="pendulum/alone-v0", quiet=True
)
equal(first_rows(began, 1_900), alone.transitions().copy())
assert len(began.transitions()) == 2_200 and began.status()["updates"] == 300, began.status()
assert began.status()["env_steps"] == 2_200 and began.config["run"]["demonstrations"] == "pendulum/alone-v0"
said = "begins with 1900 rows of the dataset pendulum/alone-v0 (10 episodes)"
assert said in (began.path / "shoal.log").read_text()
shoal.program.call(["report", began.path, "--out", "page.html"])
assert said in Path("page.html").read_text()
began.resume(steps=2_400, quiet=True)
assert len(began.transitions()) == 2_400 and began.status()["updates"] == 500
equal(first_rows(began, 1_900), alone.transitions().copy())
# What it began with is not its own.
began.to_minari("pendulum/began-v0")
own = check(began, "pendulum/began-v0", 0.99)
assert own.total_steps == 500 and "1900 rows with which" in own.storage.metadata["description"]
# The rows have the other γ.
near = {**SMALL, "ddpg.gamma": 0.5}
directory = "datasets/pendulum/alone-v0"
other = shoal.train("pendulum", run="other", steps=100, set=near, demonstrations=directory, quiet=True)
assert set(first_rows(other, 1_900).discount.tolist()) == {0.5}
assert same(first_rows(other, 1_900).observation, alone.transitions().copy().observation)
assert Path(other.config["run"]["demonstrations"]).is_absolute()
# In lockstep the same beginning has the same end.
weights = []
for run in ("first", "second"):
    arguments = ["pendulum", "--run", run, "--lockstep", "--steps", "200", "--demonstrations", "pendulum/alone-v0"]
    settings = shoal.program.settings(warm)
    weights.append(shoal.program.call(["train", *arguments, *settings, "--json", "--quiet"]).split("weights_sha256")[1])
assert weights[0] == weights[1], weights

# Several actors and environments, in a ring that wraps: each row once, each episode of one environment.
busy = {**SMALL, "replay.capacity": 2_000, "replay.warmup": 500}
many = shoal.train("pendulum", run="many", steps=5_003, actors=2, envs=3, set=busy, quiet=True)
many.to_minari("pendulum/many-v0")
wrapped = check(many, "pendulum/many-v0", 0.99)
assert wrapped.total_steps == 2_000 and "3003 rows were overwritten" in wrapped.storage.metadata["description"]
whole = [episode for episode in wrapped.iterate_episodes() if episode.truncations[-1]]
assert any(len(episode.rewards) == 200 for episode in whole), "an episode is as long as its time limit"
assert all(len(episode.rewards) <= 200 for episode in wrapped.iterate_episodes())

# Discrete actions, terminations, and an environment of Gymnasium with an argument.
short = {**QUICK, "environment.max_episode_steps": 40}
cart = shoal.train("gym:CartPole-v1", run="cart", steps=1_500, actors=2, envs=2, set=short, quiet=True)
shoal.program.call(["export", cart.path, "--minari", "cart/random-v0", "--author", "somebody"])
dataset = check(cart, "cart/random-v0", cart.config["dqn"]["gamma"], discrete=True)
assert dataset.action_space == gymnasium.spaces.Discrete(2)
ends = [(bool(one.terminations[-1]), bool(one.truncations[-1]), len(one.rewards)) for one in dataset.iterate_episodes()]
assert sum(terminated for terminated, _, _ in ends) > 20 and any(truncated for _, truncated, _ in ends), ends
assert all(steps == 40 for terminated, truncated, steps in ends if truncated)
# The lengths in episodes.csv, where rows beyond the run's last step count too.
kept = collections.Counter(steps for terminated, truncated, steps in ends if terminated or truncated)
assert not kept - collections.Counter(cart.episodes["steps"].tolist()), "each is an episode of episodes.csv"
environment = dataset.recover_environment()
assert environment.spec.id == "CartPole-v1" and environment.spec.max_episode_steps == 40
assert environment.observation_space.shape == dataset.observation_space.shape
again = shoal.train("gym:CartPole-v1", run="again", steps=100, set=QUICK, demonstrations="cart/random-v0", quiet=True)
kept = [index for indices in episodes.episodes(cart).indices for index in indices.tolist()]
expected = cart.transitions().copy()
order = shoal.transitions.Batch(*(getattr(expected, field)[kept] for field in expected.__dataclass_fields__))
equal(first_rows(again, 1_500), order)

# Discrete observations: with one actor and one environment exact; otherwise they may be ambiguous.
lake = shoal.train("frozen-lake", run="lake", steps=3_000, actors=1, set=QUICK, quiet=True)
lake.to_minari("lake/alone-v0")
found = minari.load_dataset("lake/alone-v0")
batch = lake.transitions().copy()
assert found.total_steps == 3_000 and found.observation_space == gymnasium.spaces.Discrete(16)
flat = np.concatenate([episode.observations[:-1] for episode in found.iterate_episodes()])
assert flat.dtype == np.int64 and np.array_equal(flat, batch.observation[:, 0])
assert np.array_equal(np.concatenate([one.actions for one in found.iterate_episodes()]), batch.action[:, 0])
assert found.total_episodes == batch.last.sum() + (not batch.last[-1])
lakes = shoal.train("frozen-lake", run="lakes", steps=1_000, actors=2, set=QUICK, quiet=True)
refused(lambda: lakes.to_minari("lake/two-v0"), "2 actors", "--actors 1 --envs 1")

# What cannot be.
pendulum = lambda **more: shoal.train("pendulum", run="new", steps=100, quiet=True, **more)  # noqa: E731
refused(lambda: alone.to_minari("pendulum/alone-v0"), "exists already")
refused(lambda: alone.to_minari("no version"), "not a dataset's name")
refused(lambda: pendulum(demonstrations="pendulum/none-v0"), "there is no dataset pendulum/none-v0")
refused(lambda: pendulum(demonstrations="cart/random-v0"), "the space of its observations is")
refused(
    lambda: pendulum(demonstrations="pendulum/alone-v0", set={"replay.capacity": 1_000, "replay.warmup": 100}),
    "it has 1,900 rows, and replay.capacity = 1000",
)
assert not Path("new").exists()


def dataset_of(name, **parts):
    """A pendulum's dataset of one episode with these parts."""
    episode = {
        "observations": np.zeros((3, 3), np.float32),
        "actions": np.zeros((2, 1), np.float32),
        "rewards": np.zeros(2),
        "terminations": np.zeros(2, bool),
        "truncations": np.array([False, True]),
    }
    shapes = dict(spaces)
    for key, value in parts.items():
        (shapes if key in shapes else episode)[key] = value
    buffer = minari.data_collector.EpisodeBuffer(**episode)
    minari.create_dataset_from_buffers(name, [buffer], **shapes)


spaces = {"observation_space": made.spec.observation_space, "action_space": made.spec.action_space}
dataset_of("hand/good-v0", rewards=np.array([1e-3, 2.0]))
pendulum(demonstrations="hand/good-v0", set=SMALL)
rows = first_rows(shoal.Run("new"), 2)
assert rows.reward.tolist() == [np.float32(1e-3), 2.0] and rows.last.tolist() == [False, True]
shutil.rmtree("new")
both = gymnasium.spaces.Dict({"x": gymnasium.spaces.Box(-1, 1, (3,))})
for name, parts, *message in [
    ("nan", {"observations": np.full((3, 3), np.nan)}, "is NaN", "hand/nan-v0", "row 0"),
    ("action", {"actions": np.full((2, 1), 2.5)}, "number 0 of the action is 2.5"),
    ("reward", {"rewards": np.array([0.0, 1e300])}, "in its row 1, the reward is inf"),
    ("short", {"observations": np.zeros((2, 3))}, "of shape (2, 3) instead of (3, 3)"),
    ("wide", {"observations": np.zeros((3, 4))}, "of shape (3, 4) instead of (3, 3)"),
    ("dict", {"observation_space": both, "observations": {"x": np.zeros((3, 3))}}, "only Box and Discrete"),
]:
    dataset_of(f"hand/{name}-v0", **parts)
    refused(lambda: pendulum(demonstrations=f"hand/{name}-v0", set=SMALL), *message)  # noqa: B023
    assert not Path("new").exists()
