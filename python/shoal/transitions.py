"""The replay of a run as numpy arrays, while the run continues. ``docs/REPLAY_FORMAT.md`` describes the file."""

from __future__ import annotations

import dataclasses
import zlib
from pathlib import Path

import numpy as np

from .errors import ShoalError

MAGIC = int.from_bytes(b"SHOALRPL", "little")
VERSION = 2
BLOCK = 4096


@dataclasses.dataclass(frozen=True)
class Batch:
    """Transitions, the oldest first; the arrays have as many rows.

    Attributes:
        row: the number of each transition, counted over the life of the run.
        observation: s, in the environment's units.
        action: a, as chosen; an index for discrete actions. In an integer box, the environment received the nearest
            integers.
        reward: r; of several steps (``replay.n_step``), their discounted sum.
        discount: of the value of s': γ, γᵏ for k steps, or 0 where s' is terminal.
        next_observation: s'.
        last: whether the episode ended with this step, terminated or truncated.
    """

    row: np.ndarray
    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    next_observation: np.ndarray
    last: np.ndarray

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, part: slice) -> Batch:
        """Some of the transitions."""
        return Batch(*(getattr(self, field.name)[part] for field in dataclasses.fields(self)))


class Transitions:
    """The replay of a run, mapped read-only. The learner may be adding transitions.

    Row ``i`` stands in place ``i % ring`` of a ring, whose oldest rows are overwritten. :attr:`rows` says which are
    valid at this moment. Views (:meth:`view`) are not copied, so the learner may overwrite them: look at :attr:`rows`
    again after using one. :meth:`copy` is consistent.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._words = np.memmap(path, dtype="<u8", mode="r")
        except (OSError, ValueError) as error:
            raise ShoalError(f"{path} cannot be mapped: {error}") from error
        if len(self._words) < 2 * BLOCK // 8 or self._words[0] != MAGIC:
            raise ShoalError(f"{path} is not a replay file")
        preamble = [int(word) for word in self._words[:10]]
        if preamble[1] != VERSION:
            raise ShoalError(f"{path} has format {preamble[1]}; this package reads format {VERSION}")
        if zlib.crc32(self._words[:9].tobytes()) != preamble[9]:
            raise ShoalError(f"the header of {path} is damaged (checksum)")
        self._observation, self._action, width, self.ring, actors, snapshot = preamble[2:8]
        blocks = lambda size: -(-size // BLOCK) * BLOCK  # noqa: E731
        self._actors, self._stride = actors, 3 + snapshot
        self._slot = blocks(8 * (1 + 3 + actors * self._stride))
        checks = 2 * BLOCK + 4 * self._slot
        rows = blocks(checks + 4 * self.ring)
        if len(self._words) * 8 < rows + 4 * width * self.ring:
            raise ShoalError(f"{path} is cut short")
        self._ring = np.memmap(path, dtype="<f4", mode="r", offset=rows, shape=(self.ring, width))

    def _record(self, words: int) -> np.ndarray:
        """The first words of what is committed: seal, generation, head, tail, and some words for each actor."""
        published = BLOCK // 8
        while True:
            generation = int(self._words[published])
            slot = (2 * BLOCK + self._slot * (generation % 2)) // 8
            record = self._words[slot : slot + words].copy()
            # If the same generation is still published, the slot was not written.
            if int(self._words[published]) == generation:
                return record

    @property
    def rows(self) -> range:
        """The numbers of the transitions that are valid now."""
        horizon = BLOCK // 8 + 1
        head, tail = (int(word) for word in self._record(4)[2:])
        return range(min(max(tail, int(self._words[horizon]) - self.ring), head), head)

    def written(self) -> tuple[int, int]:
        """The number of initial rows, with which the run began, and the number of actors that have collected the
        others."""
        record = self._record(4 + self._actors * self._stride)
        rows = record[4 + 2 :: self._stride]
        return int(record[2]) - int(rows.sum()), int(np.count_nonzero(rows))

    def __len__(self) -> int:
        return len(self.rows)

    def view(self) -> tuple[range, list[np.ndarray]]:
        """The valid rows, and the parts of the ring that hold them, oldest first: two where the ring wraps.

        Each is an array with a line for each transition: ``s, a, r, discount, s', last``. They are not copied.
        """
        return self._parts(self.rows)

    def _parts(self, rows: range) -> tuple[range, list[np.ndarray]]:
        """These rows, and the parts of the ring that hold them."""
        first, end = rows.start % self.ring, rows.start % self.ring + len(rows)
        return rows, [
            part
            for part in (self._ring[first : min(end, self.ring)], self._ring[: max(end - self.ring, 0)])
            if len(part)
        ]

    def copy(self, newest: int | None = None) -> Batch:
        """A consistent copy of all valid transitions, or of the ``newest`` ones.

        Rows that the learner began to overwrite during the copy are left out, so there may be fewer.
        """
        valid = self.rows
        rows, parts = self._parts(valid if newest is None else valid[max(len(valid) - newest, 0) :])
        lines = np.concatenate([np.empty((0, self._ring.shape[1]), dtype=np.float32), *parts])
        stale = min(max(self.rows.start - rows.start, 0), len(rows))
        rows, lines = rows[stale:], lines[stale:]
        s, a = self._observation, self._action
        return Batch(
            row=np.arange(rows.start, rows.start + len(rows)),
            observation=lines[:, :s],
            action=lines[:, s : s + a],
            reward=lines[:, s + a],
            discount=lines[:, s + a + 1],
            next_observation=lines[:, s + a + 2 : 2 * s + a + 2],
            last=lines[:, -1] != 0,
        )
