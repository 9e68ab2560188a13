"""A dataset of Minari as rows for a replay: ``shoal train … --demonstrations DATASET`` reads it through this module.

The file has the form of the program's other sealed files: the bytes ``SHOALDEM``, the format's number (u32), a body,
and a CRC-32 of all before. The body is the length of a header (u64), the header as TOML, and the rows as f32: ``s, a,
r, terminated, s', last``. All numbers are little-endian. The program computes a row's discount from ``terminated``
and its own γ. ``run/src/demonstrations.rs`` reads it.
"""

from __future__ import annotations

import argparse
import os
import sys
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from .datasets import using_minari
from .errors import ShoalError
from .program import toml_string

if TYPE_CHECKING:
    import gymnasium
    import minari

MAGIC = b"SHOALDEM"
VERSION = 1


def load(dataset: str) -> tuple[str, np.ndarray]:
    """The header and the rows for a dataset: its name, or a directory in Minari's format."""
    with using_minari() as minari:
        found = opened(minari, dataset)
        spaces = {
            "observation": numbers_of(found.spec.observation_space, "observations"),
            "action": numbers_of(found.spec.action_space, "actions"),
        }
        episodes = [rows(episode, spaces) for episode in found.iterate_episodes()]
        environment = found.spec.env_spec.id if found.spec.env_spec else None
    if not episodes:
        raise ShoalError(f"{dataset} has no episodes")
    lines = np.concatenate(episodes)
    header = [
        f"dataset = {toml_string(found.spec.dataset_id)}",
        f"episodes = {len(episodes)}",
        f"rows = {len(lines)}",
        *(f"{which} = {space.toml()}" for which, space in spaces.items()),
    ]
    if environment is not None:
        header.append(f"environment = {toml_string(environment)}")
    return "\n".join(header) + "\n", lines


def opened(minari: Any, dataset: str) -> minari.MinariDataset:
    """The dataset in this directory, or of this name."""
    directory = Path(dataset)
    if (directory / "data").is_dir():
        return minari.MinariDataset(directory / "data")
    try:
        return minari.load_dataset(dataset)
    except FileNotFoundError as error:
        place = minari.storage.get_dataset_path(dataset)
        raise ShoalError(f"there is no dataset {dataset} at {place}; `minari download {dataset}` gets one") from error


class Box:
    """Numbers for the elements of a box, flattened."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        self.shape = space.shape
        self._bounds = [np.asarray(end, dtype=np.float32).reshape(-1) for end in (space.low, space.high)]
        self.width = len(self._bounds[0])

    def toml(self) -> str:
        low, high = (", ".join(repr(float(number)) for number in end) for end in self._bounds)
        return f"{{ box = {{ low = [{low}], high = [{high}] }} }}"

    def numbers(self, elements: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            return np.asarray(elements).astype("<f4").reshape(-1, self.width)


class Discrete:
    """Numbers for the elements of a discrete space: indices from 0."""

    shape = ()
    width = 1

    def __init__(self, space: gymnasium.spaces.Discrete) -> None:
        self._n, self._start = int(space.n), int(space.start)

    def toml(self) -> str:
        start = f", start = {self._start}" if self._start else ""
        return f"{{ discrete = {{ n = {self._n}{start} }} }}"

    def numbers(self, elements: Any) -> np.ndarray:
        return (np.asarray(elements) - self._start).astype("<f4").reshape(-1, 1)


def numbers_of(space: gymnasium.Space[Any], what: str) -> Box | Discrete:
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return Discrete(space)
    if isinstance(space, spaces.Box):
        return Box(space)
    raise ShoalError(f"the dataset's {what} are {' '.join(str(space).split())}, and only Box and Discrete can be used")


def rows(episode: minari.EpisodeData, spaces: dict[str, Box | Discrete]) -> np.ndarray:
    """The rows of an episode, as an actor would have written them, with ``terminated`` for the discount."""
    steps = len(episode.rewards)
    for elements, space, count in [
        (episode.observations, spaces["observation"], steps + 1),
        (episode.actions, spaces["action"], steps),
    ]:
        if np.shape(elements) != (count, *space.shape):
            raise ShoalError(
                f"episode {episode.id} has elements of shape {np.shape(elements)} instead of {(count, *space.shape)}"
            )
    observations = spaces["observation"].numbers(episode.observations)
    actions = spaces["action"].numbers(episode.actions)
    terminated = np.asarray(episode.terminations, dtype=bool)
    last = terminated | np.asarray(episode.truncations, dtype=bool)
    with np.errstate(over="ignore"):
        rewards = np.asarray(episode.rewards).astype("<f4").reshape(-1, 1)
    ends = [flags.astype("<f4").reshape(-1, 1) for flags in (terminated, last)]
    return np.hstack([observations[:-1], actions, rewards, ends[0], observations[1:], ends[1]])


def write(dataset: str, to: BinaryIO) -> None:
    """Writes the file for a dataset."""
    header, lines = load(dataset)
    text = header.encode()
    parts = [MAGIC, VERSION.to_bytes(4, "little"), len(text).to_bytes(8, "little"), text]
    checksum = zlib.crc32(b"".join(parts))
    data = np.ascontiguousarray(lines, dtype="<f4").data.cast("B")
    to.write(b"".join(parts))
    to.write(data)
    to.write(zlib.crc32(data, checksum).to_bytes(4, "little"))
    to.flush()


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m shoal.demonstrations", description="Writes a dataset of Minari as rows for a replay."
    )
    parser.add_argument("dataset", help="its name, like pendulum/expert-v0, or a directory in Minari's format")
    parser.add_argument("out", help="the file to write; - for standard output")
    arguments = parser.parse_args()
    try:
        if arguments.out != "-":
            with open(arguments.out, "wb") as to:
                write(arguments.dataset, to)
            return 0
        # What packages print must not get between the rows.
        with os.fdopen(os.dup(1), "wb") as to:
            os.dup2(2, 1)
            write(arguments.dataset, to)
    except ShoalError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {arguments.out}: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
