"""Tests of ``shoal`` that need no run: files that are damaged or foreign, and values of settings."""

import struct
import tempfile
import unittest
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
            "format version 2": policy_file([1.0] * 5, version=2),
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


class Settings(unittest.TestCase):
    def test_values_become_the_texts_that_the_option_takes(self) -> None:
        values = {"a.b": True, "a.c": 0.5, "a.d": [400, 300], "a.e": ["x", 1], "a.f": "tanh", "a.g": {"k": "v"}}
        texts = ["a.b=true", "a.c=0.5", "a.d=[400, 300]", 'a.e=["x", 1]', "a.f=tanh", 'a.g={"k" = "v"}']
        self.assertEqual(program.settings(values)[1::2], texts)

    def test_an_error_is_the_programs_own_line(self) -> None:
        error = program.failure("pendulum: step 1\nerror: no such key\n\n", 2)
        self.assertEqual((str(error), error.exit_code), ("no such key", 2))
        self.assertIn("exit code 9", str(program.failure("", 9)))


if __name__ == "__main__":
    unittest.main()
