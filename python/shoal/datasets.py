"""Datasets of `Minari <https://minari.farama.org>`_: a run's replay becomes one.

``shoal export RUN --minari ID`` calls this module. It needs Minari's own Python package.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import episodes
from .errors import ShoalError
from .policy import ALGORITHMS
from .run import Run

if TYPE_CHECKING:
    import gymnasium
    import minari

    from .transitions import Batch

#: What a machine without Minari needs. Minari stores with h5py and imports pillow for it.
MISSING = "this needs the package minari: pip install minari h5py pillow"

#: Keys of ``[environment]`` that are no arguments of ``gymnasium.make``.
NO_ARGUMENTS = {"name", "server", "faults", "start_seconds", "parameters"}


@contextlib.contextmanager
def using_minari() -> Iterator[Any]:
    """Minari's package with its warnings silenced. Its exceptions become a :class:`ShoalError` of one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import h5py  # noqa: F401
            import minari
        except ImportError as error:
            raise ShoalError(MISSING) from error
        try:
            yield minari
        except ShoalError:
            raise
        except ImportError as error:
            raise ShoalError(f"{MISSING} ({error})") from error
        except Exception as error:
            raise ShoalError(f"Minari: {' '.join(str(error).split()) or type(error).__name__}") from error


def to_minari(
    run: Run,
    dataset_id: str,
    *,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
) -> minari.MinariDataset:
    """Writes the replay of a run to a new dataset of Minari; :meth:`shoal.Run.to_minari` describes it."""
    found = episodes.episodes(run)
    config = run.config
    with using_minari() as minari:
        check_id(dataset_id)
        if minari.storage.get_dataset_path(dataset_id).exists():
            raise ShoalError(f"{dataset_id} exists already: choose another version, or `minari delete {dataset_id}`")
        if not found.indices:
            raise ShoalError(f"{run.path} has no transitions of its own to export")
        environment = environment_of(config)
        spaces = {
            which: space_of(config["spec"][which], environment and getattr(environment, f"{which}_space"))
            for which in ("observation", "action")
        }
        try:
            return minari.create_dataset_from_buffers(
                dataset_id,
                [buffer(found.batch, indices, spaces) for indices in found.indices],
                env=environment.spec if environment else None,
                algorithm_name=f"Shoal {next(name for name in ALGORITHMS if name in config)}",
                author=author,
                author_email=author_email,
                code_permalink=code_permalink,
                description=description or described(run, found),
                observation_space=spaces["observation"],
                action_space=spaces["action"],
            )
        except BaseException as error:
            # Half a dataset would block the next attempt. A dataset that another process has made is kept.
            if "already exists" not in str(error):
                shutil.rmtree(minari.storage.get_dataset_path(dataset_id), ignore_errors=True)
            raise


def check_id(dataset_id: str) -> None:
    """Raises :class:`ShoalError` for what is not the name of a dataset with a version."""
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:
        raise ShoalError(f"{dataset_id!r} is not a dataset's name: write one like pendulum/expert-v0") from error


def environment_of(config: Mapping[str, Any]) -> gymnasium.Env[Any, Any] | None:
    """The run's environment if it is one of Gymnasium."""
    import gymnasium

    section = config["environment"]
    name = section["name"].removeprefix("gym:")
    if name == section["name"]:
        return None
    arguments = {key: value for key, value in section.items() if key not in NO_ARGUMENTS}
    try:
        return gymnasium.make(name, **arguments, **section.get("parameters", {}))
    except Exception as error:
        raise ShoalError(f"gymnasium.make({name!r}) fails here: {' '.join(str(error).split())}") from error


def space_of(space: Mapping[str, Any], original: gymnasium.Space[Any] | None) -> gymnasium.Space[Any]:
    """The space of a run's configuration as Gymnasium's, in the shape of the environment's own. Boxes are float32, as
    the rows are."""
    from gymnasium import spaces

    if "discrete" in space:
        return spaces.Discrete(int(space["discrete"]["n"]), start=int(space["discrete"].get("start", 0)))
    low, high = (np.array(space["box"][end], dtype=np.float32) for end in ("low", "high"))
    shape = (original.shape if original else None) or low.shape
    if int(np.prod(shape)) != len(low):
        raise ShoalError(f"the environment has {original} here, and the run has {len(low)} numbers")
    return spaces.Box(low.reshape(shape), high.reshape(shape), dtype=np.float32)


def elements(lines: np.ndarray, space: gymnasium.Space[Any]) -> np.ndarray:
    """Elements of the space from lines of the replay."""
    if hasattr(space, "n"):
        return lines[:, 0].astype(np.int64) + int(space.start)
    return lines.reshape(len(lines), *space.shape)


def buffer(batch: Batch, indices: np.ndarray, spaces: Mapping[str, gymnasium.Space[Any]]) -> Any:
    """An episode as Minari takes it."""
    from minari.data_collector import EpisodeBuffer

    observations = np.concatenate([batch.observation[indices], batch.next_observation[indices[-1:]]])
    last, terminated = batch.last[indices], batch.discount[indices] == 0
    return EpisodeBuffer(
        observations=elements(observations, spaces["observation"]),
        actions=elements(batch.action[indices], spaces["action"]),
        rewards=batch.reward[indices],
        terminations=terminated,
        truncations=last & ~terminated,
    )


def described(run: Run, found: episodes.Episodes) -> str:
    """What a reader of the dataset should know."""
    environment = run.config["environment"]["name"]
    text = f"The replay of the run {run.path.name} of Shoal in the environment {environment}."
    if found.initial_rows:
        text += f" Left out: {found.initial_rows} rows with which the run began."
    if found.overwritten:
        text += f" Its first {found.overwritten} rows were overwritten: the episodes under way then begin later."
    return text


def main() -> int:
    parser = argparse.ArgumentParser(prog="shoal export", description="Writes the replay of a run to a Minari dataset.")
    parser.add_argument("run", help="the directory of a run")
    parser.add_argument("--minari", required=True, metavar="ID", help="the dataset to make, like pendulum/expert-v0")
    parser.add_argument("--author", help="who made it")
    arguments = parser.parse_args()
    try:
        dataset = to_minari(Run(arguments.run), arguments.minari, author=arguments.author)
    except ShoalError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    print(f"{arguments.minari}: {dataset.total_episodes} episodes, {dataset.total_steps} steps", file=sys.stderr)
    print(dataset.spec.data_path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
