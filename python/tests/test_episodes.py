"""Tests of ``shoal.episodes``: interleaved rows become the episodes that they come from, or are refused."""

import unittest

import numpy as np
import shoal
from shoal import episodes
from shoal.transitions import Batch


def batch(*rows):
    """Rows ``(s, s', last)``, of one number each."""
    s, after, last = (np.array(column) for column in zip(*rows))
    count = len(rows)
    return Batch(
        row=np.arange(count),
        observation=s.astype(np.float32)[:, None],
        action=np.zeros((count, 1), np.float32),
        reward=np.zeros(count, np.float32),
        discount=np.ones(count, np.float32),
        next_observation=after.astype(np.float32)[:, None],
        last=last.astype(bool),
    )


def grouped(rows, before=None):
    before = episodes.rows_before(rows) if before is None else before
    return [indices.tolist() for indices in episodes.group_by_episode(rows, before)]


class Rows(unittest.TestCase):
    def test_one_environment(self) -> None:
        # The third episode is cut: the next row begins elsewhere, and the last one is under way.
        rows = batch((1, 2, 0), (2, 3, 1), (1, 2, 1), (5, 6, 0), (1, 2, 0), (2, 3, 0))
        self.assertEqual(grouped(rows, np.arange(6) - 1), [[0, 1], [2], [3], [4, 5]])

    def test_an_episode_that_begins_where_one_was_cut_continues_it(self) -> None:
        rows = batch((1, 2, 0), (2, 1, 0), (1, 2, 0), (2, 3, 1))
        self.assertEqual(grouped(rows, np.arange(4) - 1), [[0, 1, 2, 3]])

    def test_interleaved_rows_follow_their_observations(self) -> None:
        rows = batch((10, 11, 0), (20, 21, 0), (11, 12, 0), (21, 22, 1), (30, 31, 0), (12, 13, 1), (31, 32, 0))
        self.assertEqual(grouped(rows), [[0, 2, 5], [1, 3], [4, 6]])

    def test_the_bits_decide(self) -> None:
        rows = batch((1, -0.0, 0), (0.0, 2, 0))
        self.assertEqual(grouped(rows), [[0], [1]])
        self.assertEqual(grouped(rows, np.arange(2) - 1), [[0], [1]])

    def test_what_is_ambiguous_is_refused(self) -> None:
        for rows, what in [
            ([(1, 3, 0), (2, 3, 0)], "two were at"),
            # An actor begins where another one is.
            ([(1, 2, 0), (2, 1, 0), (1, 5, 0), (1, 6, 0)], "one began at"),
        ]:
            with self.assertRaisesRegex(episodes.Ambiguous, what):
                episodes.rows_before(batch(*rows))

    def test_rows_that_are_no_steps_are_refused_by_the_key(self) -> None:
        for n_step, gamma, key in [(3, 0.9, "replay.n_step = 3"), (1, 0.0, "ddpg.gamma = 0")]:
            with self.assertRaisesRegex(shoal.ShoalError, key):
                episodes.check({"replay": {"n_step": n_step}, "ddpg": {"gamma": gamma}})
        episodes.check({"replay": {}, "ddpg": {"gamma": 0.9}})


if __name__ == "__main__":
    unittest.main()
