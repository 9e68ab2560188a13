"""Tests of ``shoal.track`` with a tracker of our own."""

import fcntl
import json
import os
import tempfile
import threading
import time
import unittest
import unittest.mock
from pathlib import Path

import shoal
from shoal import track

FILES = {
    "config.toml": "[run]\nseed = 1\n[ddpg]\nhidden = [4, 3]\ngamma = 0.99\n",
    "evaluations.csv": "wall_seconds,env_steps,return_mean,best\n0.5,0,-9.5,1\n",
    "learner.csv": "wall_seconds,env_steps,critic_loss,ratio\n0.5,10,0.25,\n",
    "episodes.csv": "wall_seconds,env_steps,actor,return\n",
}


class Recorder:
    """Keeps what it is told, for each of its runs."""

    told: dict = {}

    def __init__(self, run, project, group, begun, tracker_id) -> None:
        self.id = tracker_id or f"{project}/{group}/{run.path.name}"
        self.mine = Recorder.told.setdefault(self.id, {"metrics": [], "states": [], "results": [], "settings": {}})
        self.mine["begun"] = begun

    def settings(self, settings) -> None:
        self.mine["settings"].update(settings)

    def metrics(self, rows) -> None:
        self.mine["metrics"] += rows

    def result(self, values) -> None:
        self.mine["results"].append(values)

    def files(self, run, paths) -> None:
        self.mine["files"] = [str(path.relative_to(run.path)) for path in paths]

    def close(self, state) -> None:
        self.mine["states"].append(state)


class Track(unittest.TestCase):
    def setUp(self) -> None:
        place = tempfile.TemporaryDirectory()
        self.addCleanup(place.cleanup)
        self.place = Path(place.name)
        Recorder.told = {}
        track.TRACKERS["recorder"], track.POLL_SECONDS = Recorder, 0.02
        self.addCleanup(track.TRACKERS.pop, "recorder")

    def make(self, name: str) -> Path:
        run = self.place / name
        run.mkdir()
        for file, text in FILES.items():
            (run / file).write_text(text)
        return run

    def test_a_run_whose_tables_are_not_made_yet_has_no_lines(self) -> None:
        run = self.place / "run"
        run.mkdir()
        (run / "config.toml").write_text(FILES["config.toml"])
        (run / "learner.csv").write_text("wall_sec")
        track.track(run, "recorder", follow=False)
        [told] = Recorder.told.values()
        self.assertEqual(told["metrics"], [])

    def test_each_line_is_copied_once_however_often_it_is_called(self) -> None:
        run = self.make("run")
        track.track(run, "recorder")
        track.track(run, "recorder")
        [(name, told)] = Recorder.told.items()
        self.assertEqual(name, "shoal/None/run")
        first = [(0.5, 0, {"evaluation/return_mean": -9.5}), (0.5, 10, {"learner/critic_loss": 0.25})]
        self.assertEqual(told["metrics"], first)
        self.assertEqual(told["settings"], {"run.seed": 1, "ddpg.hidden": "[4, 3]", "ddpg.gamma": 0.99})
        self.assertEqual((told["states"], told["results"], told["files"]), (["stopped"] * 2, [], ["config.toml"]))
        with (run / "evaluations.csv").open("a") as file:
            file.write("1.5,20,-3,0\n2.5,30,-2")
        policy = {"policy": "best", "return_mean": -2.5, "return_std": None, "episodes": 100}
        (run / "final-evaluation.json").write_text(json.dumps({"policies": [policy]}))
        (run / "outcome.json").write_text(json.dumps({"state": "finished"}))
        figures = ["episode.svg", "learning-curve.svg", "test-runs-far.svg", "trajectories.svg"]
        for figure in figures:
            (run / figure).write_text("<svg/>")
        track.track(run, "recorder")
        track.track(run, "recorder")
        self.assertEqual(told["metrics"], [*first, (1.5, 20, {"evaluation/return_mean": -3.0})])
        self.assertEqual(told["results"], [{"final/best_return_mean": -2.5, "final/best_episodes": 100}])
        self.assertEqual(told["states"][2:], ["finished"] * 2)
        self.assertEqual(told["files"], ["config.toml", *figures])

    def test_a_suite_is_followed_until_nobody_works_on_it(self) -> None:
        suite = self.place / "suite"
        suite.mkdir()
        trials = [{"name": name, "seed": None, "set": []} for name in ("a", "b", "never")]
        (suite / "suite.json").write_text(json.dumps({"trials": trials}))
        lock = os.open(suite, os.O_RDONLY)
        fcntl.flock(lock, fcntl.LOCK_EX)
        self.make("suite/a")
        following = threading.Thread(target=track.track, args=(suite, "recorder"))
        following.start()
        time.sleep(0.2)
        self.make("suite/b")
        time.sleep(0.2)
        self.assertTrue(following.is_alive(), "the suite is still worked on")
        os.close(lock)
        following.join(30)
        self.assertFalse(following.is_alive())
        self.assertEqual(sorted(Recorder.told), ["shoal/suite/a", "shoal/suite/b"])
        self.assertEqual([len(told["metrics"]) for told in Recorder.told.values()], [2, 2])

    def test_a_power_loss_leaves_no_damaged_file_and_one_that_is_there_is_named(self) -> None:
        run, done = self.make("run"), []
        fsync, replace = os.fsync, Path.replace

        def synced(number: int) -> None:
            fsync(number)
            done.append(("synced", os.fstat(number).st_size))

        def renamed(path: Path, target: Path) -> Path:
            done.append(("renamed", path.stat().st_size))
            return replace(path, target)

        with unittest.mock.patch("os.fsync", synced), unittest.mock.patch.object(Path, "replace", renamed):
            track.track(run, "recorder")
        self.assertTrue(done)
        for before, after in zip(done[::2], done[1::2], strict=True):
            self.assertEqual((before[0], after[0], before[1]), ("synced", "renamed", after[1]), done)
        # Of an earlier version.
        (run / "tracking-recorder.json").write_text("")
        with self.assertRaisesRegex(shoal.ShoalError, "tracking-recorder.json is damaged; remove it"):
            track.track(run, "recorder")

    def test_the_times_of_metrics_count_from_the_start_of_the_run(self) -> None:
        run = self.make("run")
        (run / "start.json").write_text(json.dumps({"format": 1, "started": 1_700_000_000}))
        track.track(run, "recorder")
        (run / "start.json").unlink()
        track.track(run, "recorder")
        earlier = self.make("earlier")
        os.utime(earlier / "config.toml", (5.0, 5.0))
        track.track(earlier, "recorder")
        self.assertEqual([told["begun"] for told in Recorder.told.values()], [1_700_000_000, 5.0])
        damaged = self.make("damaged")
        (damaged / "start.json").write_text("{}")
        with self.assertRaisesRegex(shoal.ShoalError, "start.json is damaged; remove it"):
            track.track(damaged, "recorder")

    def test_an_error_of_a_tracker_is_one_line(self) -> None:
        def fail(*_) -> None:
            raise RuntimeError("nobody\nanswers")

        run = self.make("run")
        for method in ("__init__", "settings", "metrics", "files", "close"):
            with unittest.mock.patch.object(Recorder, method, fail):
                with self.assertRaisesRegex(shoal.ShoalError, "^recorder: nobody answers$"):
                    track.track(run, "recorder")

    def test_what_is_no_tracker_or_run_is_refused(self) -> None:
        for path, to, message in [("run", "tensorflow", "no tracker"), ("nothing", "recorder", "not a run directory")]:
            with self.assertRaisesRegex(shoal.ShoalError, message):
                track.track(self.place / path, to)


if __name__ == "__main__":
    unittest.main()
