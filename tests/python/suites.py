"""What somebody does with suites of runs."""

import numpy as np
import shoal

QUICK = {
    "ddpg.hidden": np.array([16, 16]),
    "ddpg.gamma": np.float32(0.95),
    "evaluation.every": np.int64(500),
    "evaluation.episodes": 2,
    "evaluation.final_episodes": 4,
}

sweep = {"ddpg.tau": [0.001, np.float64(0.01)]}
options = {"seeds": range(1, 3), "sweep": sweep, "steps": 600, "set": QUICK, "jobs": 2, "quiet": True}
suite = shoal.train_suite("pendulum", run="suite", **options)
assert [run.path.name for run in suite.runs] == [trial["name"] for trial in suite.trials], suite.trials
assert suite.runs[0].config["ddpg"]["hidden"] == [16, 16] and suite.runs[0].config["ddpg"]["gamma"] == 0.95
results = suite.results
assert results.dtype.names == ("run", "seed", "ddpg.tau", "return_mean", "return_std"), results.dtype
assert sorted(zip(results["ddpg.tau"], results["seed"])) == [(0.001, 1), (0.001, 2), (0.01, 1), (0.01, 2)]
assert (results["return_mean"] < 0).all(), results

again = shoal.train_suite("pendulum", run="suite", **options)
assert np.array_equal(again.results["return_mean"], results["return_mean"]), "nothing was left to do"
suite.resume(steps=700, quiet=True).wait(timeout=1)
assert all(run.status()["env_steps"] >= 700 for run in suite.runs)
for run in suite.runs:
    # It has ended: nothing is left to stop.
    run.stop()
for attempt, message in [
    (lambda: shoal.Run("suite"), "a suite of runs"),
    (lambda: shoal.Suite("suite/tau=0.01,seed=1"), "no suite.json"),
    (lambda: shoal.train_suite("pendulum", run="other", sweep={"ddpg.tao": [1, 2]}), "did you mean `tau`"),
    (lambda: shoal.train_suite("pendulum", run="other", seeds=[1, 1]), "names a seed twice"),
]:
    try:
        attempt()
    except shoal.ShoalError as error:
        assert message in str(error) and "\n" not in str(error), error
    else:
        raise AssertionError(f"{message}: no error")
