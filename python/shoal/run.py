"""A run: its files, and the commands for it."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import program, tables
from .errors import ShoalError
from .locks import is_locked
from .policy import Policy
from .transitions import Transitions

if TYPE_CHECKING:
    import minari
    import pandas

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


class Run:
    """A run in its directory, running or not.

    Raises :class:`ShoalError` if the directory has no run.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()
        if not (self.path / "config.toml").is_file():
            is_suite = (self.path / "suite.json").is_file()
            why = "it is a suite of runs, and shoal.Suite(…).runs has them" if is_suite else "it has no config.toml"
            raise ShoalError(f"{self.path} is not a run directory: {why}")

    def __repr__(self) -> str:
        return f"shoal.Run({str(self.path)!r})"

    @property
    def config(self) -> dict[str, Any]:
        """The configuration that the run was last used with, by section and key."""
        used = self.path / "config" / "used.toml"
        # Runs of earlier versions have config.toml alone.
        path = used if used.exists() else self.path / "config.toml"
        try:
            return tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, tomllib.TOMLDecodeError) as error:
            raise ShoalError(f"{path} cannot be read: {error}") from error

    @property
    def evaluations(self) -> np.ndarray:
        """The evaluations of its policies: a structured array with a field for each column of ``evaluations.csv``."""
        return self.table("evaluations")

    @property
    def episodes(self) -> np.ndarray:
        """The training episodes: a structured array with a field for each column of ``episodes.csv``."""
        return self.table("episodes")

    @property
    def learner(self) -> np.ndarray:
        """The learner's progress: a structured array with a field for each column of ``learner.csv``."""
        return self.table("learner")

    def table(self, name: str) -> np.ndarray:
        """``<name>.csv`` of the run as a structured array: ``evaluations``, ``episodes``, ``learner``, ``incidents``,
        ``changes`` or ``hosts``."""
        return tables.read(self.path / f"{name}.csv")

    def frame(self, name: str = "evaluations") -> pandas.DataFrame:
        """``<name>.csv`` of the run as a ``DataFrame``. This needs pandas."""
        try:
            import pandas
        except ImportError as error:
            raise ShoalError("frame() needs pandas: pip install pandas") from error
        return pandas.DataFrame(self.table(name))

    @property
    def result(self) -> dict[str, Any] | None:
        """The final evaluation of a finished run (``final-evaluation.json``); ``None`` before."""
        path = self.path / "final-evaluation.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def policy(self, which: str = "best") -> Policy:
        """The ``"best"`` policy of the run's evaluations, or its ``"last"`` one. It can be called with observations."""
        if which not in ("best", "last"):
            raise ShoalError(f"there is no policy {which!r}; choose 'best' or 'last'")
        return Policy(self.path / "checkpoints" / f"{which}.policy", self.config)

    def transitions(self) -> Transitions:
        """The run's replay, mapped read-only, even while the run continues."""
        return Transitions(self.path / "replay.bin")

    def to_minari(
        self,
        dataset_id: str,
        *,
        author: str | None = None,
        author_email: str | None = None,
        code_permalink: str | None = None,
        description: str | None = None,
    ) -> minari.MinariDataset:
        """Writes the run's replay to a new dataset of Minari, like ``"pendulum/expert-v0"``, and returns it.

        The dataset has every row that the run collected itself and the ring still has, unchanged, in the environment's
        units: boxes as float32, discrete observations and actions as the environment's integers. Rows with which the
        run began (``with_replay``, demonstrations) are left out. An episode whose beginning was overwritten begins
        later. An episode that was cut ends neither terminated nor truncated.

        This needs minari, h5py and pillow. Raises :class:`ShoalError` for a replay that has no steps of the environment
        (``replay.n_step``, a γ of 0), and where episodes of several actors cannot be told apart.
        """
        from . import datasets

        return datasets.to_minari(
            self,
            dataset_id,
            author=author,
            author_email=author_email,
            code_permalink=code_permalink,
            description=description,
        )

    def status(self) -> dict[str, Any]:
        """What ``shoal status --json`` says."""
        return json.loads(program.call(["status", self.path, "--json"], accepted=(0, program.NOT_RUNNING_EXIT_CODE)))

    def scale(self, actors: int) -> None:
        """Changes the number of actors while the run is running."""
        program.call(["scale", self.path, "--actors", str(actors)])

    def stop(self) -> None:
        """Ends the run in order: all that was sent is committed and saved. :meth:`resume` continues it.

        Does nothing if the run is not running, as when it has just ended. Raises :class:`ShoalError` if the training is
        finished and the final evaluation is under way; :meth:`wait` waits for that.
        """
        try:
            program.call(["stop", self.path])
        except ShoalError as error:
            if not str(error).startswith(program.NOT_RUNNING_MESSAGE):
                raise

    def wait(self, timeout: float | None = None) -> Run:
        """Waits until the run is no longer running, for at most ``timeout`` seconds. Returns the run.

        Raises ``TimeoutError`` if it is still running, and :class:`ShoalError` if it failed.
        """
        give_up = None if timeout is None else time.monotonic() + timeout
        while is_locked(self.path):
            if give_up is not None and time.monotonic() > give_up:
                raise TimeoutError(f"{self.path} is still running after {timeout} s")
            time.sleep(0.5)
        outcome = self.path / "outcome.json"
        end = json.loads(outcome.read_text(encoding="utf-8")) if outcome.exists() else {}
        if end.get("state") == "failed":
            raise ShoalError(f"{self.path} failed: {end['reason']}")
        if end.get("state") == "running":
            raise ShoalError(f"the launcher of {self.path} was killed; resume() continues the run")
        return self

    def resume(self, *, steps: int | None = None, set: Mapping[str, Any] | None = None, quiet: bool = False) -> Run:
        """Continues the run to its end, or to a new number of ``steps``, with changed settings. Returns the run."""
        command = [program.program(), "resume", str(self.path), "--json"]
        command += ["--steps", str(steps)] if steps is not None else []
        program.follow(command + program.settings(set), quiet)
        return self

    def evaluate(self, episodes: int | None = None) -> dict[str, Any]:
        """Evaluates the best policy again, as ``shoal eval --json`` does."""
        options = ["--episodes", str(episodes)] if episodes is not None else []
        return json.loads(program.call(["eval", self.path, "--json", *options]))
