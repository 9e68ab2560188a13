"""What somebody does with `import shoal`, and transitions that are read while the learner overwrites them."""

import sys
import time
import unittest.mock

import numpy as np
import shoal

QUICK = {"ddpg.hidden": [16, 16], "evaluation.every": 500, "evaluation.episodes": 2, "evaluation.final_episodes": 4}


def check_physics(batch):
    """Each row is a whole step of the pendulum: its reward follows from s and a, and s' is on the unit circle."""
    angle = np.arctan2(batch.observation[:, 1], batch.observation[:, 0])
    speed, torque = batch.observation[:, 2], batch.action[:, 0]
    reward = -(angle**2 + 0.1 * speed**2 + 0.001 * torque**2)
    np.testing.assert_allclose(batch.reward, reward, atol=1e-3)
    np.testing.assert_allclose(np.hypot(batch.next_observation[:, 0], batch.next_observation[:, 1]), 1.0, atol=1e-4)
    # s' is θ + dt θ̇', where the new speed is observed too (dt = 0.05).
    turned = np.arctan2(batch.next_observation[:, 1], batch.next_observation[:, 0]) - angle
    turned = (turned + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.05 * batch.next_observation[:, 2], atol=1e-3)
    assert set(np.unique(batch.discount)) <= {np.float32(0.99)}


run = shoal.train("pendulum", steps=2_000, seed=3, set=QUICK, actors=1, quiet=True)
assert run.path.name == "pendulum-1", run
assert run.config["ddpg"]["hidden"] == [16, 16] and run.config["run"]["seed"] == 3
evaluations = run.evaluations
assert evaluations.dtype.names[:2] == ("wall_seconds", "env_steps") and len(evaluations) >= 1
assert evaluations["env_steps"].dtype == np.int64 and evaluations["return_mean"].max() < 0
assert run.result["policies"][0]["return_mean"] < 0
status = run.status()
assert status["finished"] and not status["running"]
batch = run.transitions().copy()
assert len(batch) == status["replay_rows"] == 2_000 and batch.row.tolist() == list(range(2_000))
check_physics(batch)
# One actor with one environment: each episode is a chain.
same = ~batch.last[:-1]
assert np.array_equal(batch.next_observation[:-1][same], batch.observation[1:][same])
assert batch.last.sum() == 10, "episodes of 200 steps"
newest = run.transitions().copy(newest=10)
assert newest.row.tolist() == list(range(1_990, 2_000)) and np.array_equal(newest.reward, batch.reward[-10:])
for attempt, message in [
    (lambda: shoal.train("pendulun"), "did you mean"),
    (lambda: shoal.train("pendulum", set={"ddpg.tao": 1}), "did you mean `tau`"),
    (lambda: shoal.train("pendulum", run=run.path), "exists already"),
    (lambda: shoal.train("pendulum", run="elsewhere", set={"ddpg.gama": 1}, wait=False), "did you mean `gamma`"),
    (lambda: run.policy("worst"), "worst"),
    (lambda: run.scale(2), "nothing runs"),
    (lambda: shoal.Run("nowhere"), "not a run directory"),
]:
    try:
        attempt()
    except shoal.ShoalError as error:
        assert message in str(error) and "\n" not in str(error), error
    else:
        raise AssertionError(f"{message}: no error")
assert not (run.path.parent / "elsewhere").exists()

run.resume(steps=3_000, set={"ddpg.actor_learning_rate": 0.0005}, quiet=True)
assert set(run.table("changes")["key"]) == {"run.steps", "ddpg.actor_learning_rate"}, run.table("changes")
assert run.evaluations["env_steps"].max() >= 2_900
assert run.evaluate(episodes=2)["episodes"] == 2

busy = {**QUICK, "replay.capacity": 1_000, "replay.warmup": 500, "replay.updates_per_step": 0.01, "ddpg.batch": 8}
live = shoal.train("pendulum", steps=100_000_000, set=busy, actors=1, envs=4, wait=False)
assert live.path.name == "pendulum-2" and live.status()["running"]
transitions = live.transitions()
concatenate = np.concatenate


def slow(arrays):
    """Gives the learner time to overwrite what is being copied."""
    time.sleep(0.01)
    return concatenate(arrays)


seen, copies, full, before = 0, 0, 0, transitions.copy()
give_up = time.monotonic() + 60
while (copies < 300 or full < 50 or seen < 5_000) and time.monotonic() < give_up:
    with unittest.mock.patch("numpy.concatenate", slow if copies % 2 else concatenate):
        batch = transitions.copy()
    check_physics(batch)
    # A number names the same transition in every copy.
    _, mine, theirs = np.intersect1d(batch.row, before.row, return_indices=True)
    assert np.array_equal(batch.observation[mine], before.observation[theirs])
    before = batch
    assert len(batch) <= transitions.ring and (len(batch) == 0 or batch.row[-1] >= seen)
    assert (np.diff(batch.row) == 1).all()
    seen, copies, full = int(batch.row[-1]) if len(batch) else seen, copies + 1, full + (len(batch) > 900)
assert full >= 50 and seen >= 5_000, (seen, copies, full)
live.scale(2)
while live.status()["actors"] != 2 or sum(role["role"] == "actor" for role in live.status()["roles"]) != 2:
    assert time.monotonic() < give_up + 60
    time.sleep(0.1)
try:
    live.wait(timeout=0.3)
except TimeoutError:
    pass
else:
    raise AssertionError("the run ended by itself")
live.stop()
live.wait(timeout=30)
live.resume(steps=int(live.status()["env_steps"]) + 10_000, quiet=True)
assert not live.status()["running"] and live.status()["finished"]
print(f"{copies} copies of a replay of {transitions.ring} rows while {seen} were written", file=sys.stderr)
