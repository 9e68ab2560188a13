"""The rows of a replay, grouped into the episodes that they come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import ShoalError
from .policy import ALGORITHMS

if TYPE_CHECKING:
    from .run import Run
    from .transitions import Batch


@dataclasses.dataclass(frozen=True)
class Episodes:
    """What a run has collected itself.

    Attributes:
        batch: the rows.
        indices: for each episode the indices of its rows in ``batch``, in their order. Episodes are in the order of
            their first rows. One without a row that is ``last`` was cut: it is under way, or its process was replaced.
        initial_rows: rows of another run, or of a dataset, that are in the replay too. They are left out.
        overwritten: rows of this run that the ring no longer has. The episodes that they began begin later here.
    """

    batch: Batch
    indices: list[np.ndarray]
    initial_rows: int
    overwritten: int


class Ambiguous(Exception):
    """Rows do not say to which of two episodes they belong."""


def episodes(run: Run) -> Episodes:
    """The episodes in the run's replay. The run may continue.

    An episode that was cut, and one that begins at exactly the observation at which it was cut, are taken for one:
    rows do not say where a process was replaced.

    Raises :class:`ShoalError` where the rows do not say what belongs together: with ``replay.n_step`` above 1, with a γ
    of 0, and where two environments were at the same observation.
    """
    config = run.config
    check(config)
    transitions = run.transitions()
    batch = transitions.copy()
    initial_rows, actors = transitions.written()
    oldest = int(batch.row[0]) if len(batch) else initial_rows
    own = batch[max(initial_rows - oldest, 0) :]
    envs = int(config["actors"]["envs"])
    try:
        alone = actors <= 1 and envs == 1 and not had_other_envs(run)
        before = np.arange(len(own)) - 1 if alone else rows_before(own)
    except Ambiguous as what:
        raise ShoalError(
            f"actors.envs = {envs} and {actors} actors: their episodes cannot be told apart, because {what}; collect "
            "with --actors 1 --envs 1"
        ) from None
    return Episodes(own, group_by_episode(own, before), len(batch) - len(own), max(oldest - initial_rows, 0))


def check(config: Mapping[str, Any]) -> None:
    """Raises :class:`ShoalError` if the rows of such a run are no steps of its environment."""
    n_step = config["replay"].get("n_step", 1)
    if n_step != 1:
        raise ShoalError(f"replay.n_step = {n_step}: rows of several steps are no steps of the environment")
    algorithm = next((name for name in ALGORITHMS if name in config), None)
    if algorithm is None:
        raise ShoalError("the run's configuration has no algorithm that this package knows")
    if config[algorithm]["gamma"] == 0:
        raise ShoalError(f"{algorithm}.gamma = 0: with it, rows do not say which episodes were terminated")


def had_other_envs(run: Run) -> bool:
    """Whether its actors stepped another number of environments before."""
    return (run.path / "changes.csv").exists() and "actors.envs" in run.table("changes")["key"].tolist()


def words(lines: np.ndarray) -> list[bytes]:
    """The bits of each line."""
    lines = np.ascontiguousarray(lines)
    width = lines.shape[1] * lines.itemsize
    data = lines.tobytes()
    return [data[at : at + width] for at in range(0, len(data), width)]


def rows_before(batch: Batch) -> np.ndarray:
    """For each row the index of the row whose episode it continues, or -1.

    Rows of several actors and environments are interleaved, and do not say whose they are. A row continues the episode
    that is under way and whose s' has the bits of its s. Raises :class:`Ambiguous` if another one has them too, or
    if an episode begins where one was under way.
    """
    observations, following = words(batch.observation), words(batch.next_observation)
    before = np.full(len(batch), -1)
    under_way: dict[bytes, int] = {}
    for index, (here, there, last) in enumerate(zip(observations, following, batch.last.tolist())):
        before[index] = under_way.pop(here, -1)
        if not last and under_way.setdefault(there, index) != index:
            raise Ambiguous(f"two were at {np.frombuffer(there, dtype=np.float32).tolist()}")
    beginnings = {observations[index] for index in np.flatnonzero(before < 0)}
    for there, last in zip(following, batch.last.tolist()):
        if not last and there in beginnings:
            where = np.frombuffer(there, dtype=np.float32).tolist()
            raise Ambiguous(f"one began at {where}, where another one was under way")
    return before


def group_by_episode(batch: Batch, before: np.ndarray) -> list[np.ndarray]:
    """The indices of the rows of each episode. A row begins an episode if the row before it was ``last``, or had
    another s' than this row's s."""
    observations, following = batch.observation.view(np.uint32), batch.next_observation.view(np.uint32)
    continues = (before >= 0) & ~batch.last[before] & (observations == following[before]).all(axis=1)
    indices: list[list[int]] = []
    episode = np.empty(len(batch), dtype=np.int64)
    for index, (previous, goes_on) in enumerate(zip(before.tolist(), continues.tolist())):
        if goes_on:
            episode[index] = episode[previous]
            indices[episode[index]].append(index)
        else:
            episode[index] = len(indices)
            indices.append([index])
    return [np.array(one) for one in indices]
