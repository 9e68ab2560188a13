"""Tests of ``shoal`` that need no run: files that are damaged or foreign, and values of settings."""

import json
import struct
import tempfile
import unittest
import unittest.mock
import zlib
from pathlib import Path

import numpy as np
import shoal
from shoal import policy, program, tables, transitions

SPEC = {
    "observation": {"box": {"low": [-1.0, -1.0], "high": [1.0, 1.0]}},
    "action": {"box": {"low": [-2.0], "high": [2.0]}},
}


def sealed(body: bytes, magic: bytes = policy.MAGIC, version: int = 1) -> bytes:
    data = magic + version.to_bytes(4, "little") + body
    return data + zlib.crc32(data).to_bytes(4, "little")


def policy_file(parameters, **envelope) -> bytes:
    head = struct.pack("<QQQddQQ", 0, 7, 1000, -3.5, 0.5, 10, len(parameters))
    return sealed(head + np.asarray(parameters, dtype="<f4").tobytes(), **envelope)


class Files(unittest.TestCase):
    def setUp(self) -> None:
        place = tempfile.TemporaryDirectory()
        self.addCleanup(place.cleanup)
        self.path = Path(place.name) / "file"

    def write(self, data: bytes) -> Path:
        self.path.write_bytes(data)
        return self.path

    def test_a_policy_by_hand(self) -> None:
        # h = max(s0 + 2 s1, 0), u = 3 h + 0.5, a = 2 tanh u
        path = self.write(policy_file([1.0, 2.0, 0.0, 3.0, 0.5]))
        acting = policy.Policy(path, {"spec": SPEC, "ddpg": {"hidden": [1], "activation": "relu"}})
        self.assertEqual((acting.version, acting.env_steps, acting.return_mean), (7, 1000, -3.5))
        one = acting([0.1, 0.2])
        np.testing.assert_allclose(one, [2 * np.tanh(2.0)], rtol=1e-6)
        np.testing.assert_allclose(acting([[0.1, 0.2], [-1, 0]]), [one, [2 * np.tanh(0.5)]], rtol=1e-6)
        with self.assertRaisesRegex(shoal.ShoalError, "has 2 numbers, but 3"):
            acting([1.0, 2.0, 3.0])
        with self.assertRaisesRegex(shoal.ShoalError, "no scores"):
            acting.scores([1.0, 2.0])

    def test_a_network_sees_indices_that_are_counted_from_0(self) -> None:
        spec = {"observation": {"discrete": {"n": 16, "start": 5}}, "action": SPEC["action"]}
        # h = max(index, 0), a = 2 tanh(h / 2)
        path = self.write(policy_file([1.0, 0.0, 0.5, 0.0]))
        acting = policy.Policy(path, {"spec": spec, "ddpg": {"hidden": [1], "activation": "relu"}})
        np.testing.assert_allclose(acting(6), [2 * np.tanh(0.5)], rtol=1e-6)
        np.testing.assert_allclose(acting([5, 7]), [[0.0], [2 * np.tanh(1.0)]], rtol=1e-6)

    def test_a_table_and_the_start_of_its_spaces(self) -> None:
        spec = {"observation": {"discrete": {"n": 2, "start": 5}}, "action": {"discrete": {"n": 3, "start": -1}}}
        path = self.write(policy_file([0.0, 2.0, 1.0, 4.0, 4.0, 3.0]))
        acting = policy.Policy(path, {"spec": spec, "q-learning": {}})
        self.assertEqual(acting(5), 0)
        self.assertEqual(acting(6), -1, "of equal values the first")
        self.assertEqual(acting([5, 6, 99]).tolist(), [0, -1, -1])

    def test_dueling_heads_and_normalised_observations(self) -> None:
        spec = {"observation": {"box": {"low": [0.0], "high": [1.0]}}, "action": {"discrete": {"n": 2}}}
        config = {
            "spec": spec,
            "dqn": {"hidden": [1], "activation": "tanh", "dueling": True},
            "observation": {"normalise": True},
        }
        # x = clip((s - 1) * 2, -10, 10), h = tanh x, V = h, A = (2 h, 4 h)
        path = self.write(policy_file([1.0, 0.0, 1.0, 2.0, 4.0, 0.0, 0.0, 0.0, 1.0, 2.0]))
        acting = policy.Policy(path, config)
        h = np.tanh(1.0)
        np.testing.assert_allclose(acting.scores([1.5]), [h + 2 * h - 3 * h, h + 4 * h - 3 * h], rtol=1e-5)
        np.testing.assert_allclose(acting.scores([1e9]), [0.0, 2.0], atol=1e-5)

    def test_files_that_are_no_policies(self) -> None:
        whole = policy_file([1.0, 2.0, 0.0, 3.0, 0.5])
        config = {"spec": SPEC, "ddpg": {"hidden": [1], "activation": "relu"}}
        wrong = {
            "not a policy file": b"hello, world" * 9,
            "damaged or cut short": whole[:-1],
            "has format 2": policy_file([1.0] * 5, version=2),
            "its network has 5": policy_file([1.0] * 4),
        }
        for message, data in wrong.items():
            with self.assertRaisesRegex(shoal.ShoalError, message):
                policy.Policy(self.write(data), config)
        for byte in range(0, len(whole), 7):
            damaged = bytearray(whole)
            damaged[byte] ^= 4
            with self.assertRaises(shoal.ShoalError):
                policy.Policy(self.write(bytes(damaged)), config)
        with self.assertRaisesRegex(shoal.ShoalError, "there is no policy here"):
            policy.Policy(self.path.with_name("missing"), config)

    def test_files_that_are_no_replays(self) -> None:
        for data in (b"", b"SHOALRPL", bytes(20_000), b"SHOALRPL" + bytes(20_000)):
            with self.assertRaises(shoal.ShoalError):
                transitions.Transitions(self.write(data))

    def test_tables(self) -> None:
        read = tables.read(self.write(b"steps,value,why\n1,,a\n2,0.5,\n3,7"))
        self.assertEqual(read["steps"].tolist(), [1, 2], "the last line is being written")
        self.assertTrue(np.isnan(read["value"][0]))
        self.assertEqual(read["why"].tolist(), ["a", ""])
        self.assertEqual(len(tables.read(self.write(b"steps,value\n"))), 0)

    def test_a_directory_without_a_run(self) -> None:
        with self.assertRaisesRegex(shoal.ShoalError, "not a run directory"):
            shoal.Run(self.path.parent)

    def test_a_run_that_has_ended_is_not_stopped_again(self) -> None:
        self.path.with_name("config.toml").touch()
        run = shoal.Run(self.path.parent)
        ended = shoal.ShoalError(f"nothing runs in {run.path}: it is finished", 1)
        with unittest.mock.patch.object(program, "call", side_effect=ended):
            run.stop()
        failed = shoal.ShoalError("the learner could not save", 1)
        with unittest.mock.patch.object(program, "call", side_effect=failed):
            with self.assertRaisesRegex(shoal.ShoalError, "could not save"):
                run.stop()

    def test_the_results_are_a_table(self) -> None:
        suite = self.path.parent / "suite"
        trials = [
            {"name": f"tau={tau},seed={seed}", "seed": seed, "set": [f"ddpg.tau={tau}", f"ddpg.activation={word}"]}
            for tau, word in ((0.1, "relu"), (0.5, "tanh"))
            for seed in (1, 2)
        ]
        for trial, mean in zip(trials[:2], (-3.5, None)):
            (suite / trial["name"]).mkdir(parents=True)
            (suite / trial["name"] / "config.toml").touch()
            best = {"policy": "best", "return_mean": -9.0, "return_std": 0.0}
            last = {"policy": "last", "return_mean": mean, "return_std": 0.0}
            result = {"format": 1, "policies": [best, last], "kept": "last"}
            (suite / trial["name"] / "final-evaluation.json").write_text(json.dumps(result))
        with self.assertRaisesRegex(shoal.ShoalError, "no suite.json"):
            shoal.Suite(suite)
        (suite / "suite.json").write_text(json.dumps({"format": 1, "what": "pendulum", "trials": trials}))
        with self.assertRaisesRegex(shoal.ShoalError, "a suite of runs"):
            shoal.Run(suite)
        read = shoal.Suite(suite)
        self.assertEqual(read.trials, trials)
        self.assertEqual([run.path.name for run in read.runs], ["tau=0.1,seed=1", "tau=0.1,seed=2"])
        table = read.results
        names = ("run", "seed", "ddpg.tau", "ddpg.activation", "return_mean", "return_std")
        self.assertEqual(table.dtype.names, names)
        self.assertEqual(table["ddpg.tau"].tolist(), [0.1, 0.1, 0.5, 0.5])
        self.assertEqual(table["ddpg.activation"].tolist(), ["relu", "relu", "tanh", "tanh"])
        self.assertEqual(table["seed"].tolist(), [1, 2, 1, 2])
        np.testing.assert_array_equal(table["return_mean"], [-3.5, np.nan, np.nan, np.nan])
        np.testing.assert_array_equal(table["return_std"], [0.0, 0.0, np.nan, np.nan])
        self.assertIs(read.wait(timeout=0), read)


class Settings(unittest.TestCase):
    def test_values_become_the_texts_that_the_option_takes(self) -> None:
        values = {"a.b": True, "a.c": 0.5, "a.d": [400, 300], "a.e": ["x", 1], "a.f": "tanh", "a.g": {"k": "v"}}
        values |= {"a.h": {"😀": ["é\n"]}, "a.i": ["\x7f\x00"]}
        texts = ["a.b=true", "a.c=0.5", "a.d=[400, 300]", 'a.e=["x", 1]', "a.f=tanh", 'a.g={"k" = "v"}']
        texts += ['a.h={"😀" = ["é\\n"]}', 'a.i=["\\u007f\\u0000"]']
        self.assertEqual(program.settings(values)[1::2], texts)

    def test_values_of_numpy_are_taken_as_their_numbers(self) -> None:
        values = {
            "a.b": np.bool_(False),
            "a.c": np.float32(0.1),
            "a.d": np.array([400, 300]),
            "a.e": np.array(0.25),
            "a.f": np.int64(7),
            "a.g": [np.float64(0.5), np.array([True])],
            "a.h": np.array(["x", "y"]),
            "a.i": np.str_("tanh"),
        }
        texts = ["false", "0.1", "[400, 300]", "0.25", "7", "[0.5, [true]]", '["x", "y"]', "tanh"]
        self.assertEqual([text.split("=", 1)[1] for text in program.settings(values)[1::2]], texts)

    def test_a_suite_is_asked_for_by_its_seeds_and_values(self) -> None:
        with unittest.mock.patch.object(program, "follow", return_value='{"suite": "/nowhere"}') as follow:
            with unittest.mock.patch.object(program, "program", return_value="shoal"):
                with self.assertRaisesRegex(shoal.ShoalError, "no suite.json"):
                    sweep = {"ddpg.hidden": [[8, 8], np.array([4])], "a.b": ["x", "y,z"]}
                    shoal.train_suite("pendulum", seeds=range(1, 3), sweep=sweep, steps=5, jobs=2)
        line = "shoal train pendulum --json --steps 5 --seeds 1,2 --sweep"
        expected = [*line.split(), "ddpg.hidden=[8, 8],[4]", "--sweep", 'a.b=x,"y,z"', "--jobs", "2"]
        self.assertEqual(follow.call_args.args[0], expected)
        with self.assertRaises(TypeError):
            shoal.train_suite("pendulum", seeds=[1], stepps=5)
        with self.assertRaisesRegex(shoal.ShoalError, "needs several seeds or values"):
            shoal.train_suite("pendulum", steps=5)

    def test_an_error_is_the_programs_own_line(self) -> None:
        error = program.failure("pendulum: step 1\nerror: no such key\n\n", 2)
        self.assertEqual((str(error), error.exit_code), ("no such key", 2))
        self.assertIn("exit code 9", str(program.failure("", 9)))


if __name__ == "__main__":
    unittest.main()
