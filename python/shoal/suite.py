"""A suite: several runs in one directory that differ in their seed and in the values of some keys."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import program, tables
from .errors import ShoalError
from .locks import is_locked
from .run import Run


class Suite:
    """A suite in its directory, whether or not a process works on it.

    Raises :class:`ShoalError` if the directory has no suite.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()
        if not (self.path / "suite.json").is_file():
            raise ShoalError(f"{self.path} is not the directory of a suite: it has no suite.json")

    def __repr__(self) -> str:
        return f"shoal.Suite({str(self.path)!r})"

    @property
    def trials(self) -> list[dict[str, Any]]:
        """All runs of the suite in their order, started or not. ``name`` is the name of the run's directory, ``seed``
        its seed (``None``: the preset's), and ``set`` the settings in which it differs, each as
        ``"SECTION.KEY=VALUE"``."""
        file = self.path / "suite.json"
        try:
            return [
                {"name": str(trial["name"]), "seed": trial["seed"], "set": list(trial["set"])}
                for trial in json.loads(file.read_text(encoding="utf-8"))["trials"]
            ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ShoalError(f"{file} cannot be read: {error}") from error

    @property
    def runs(self) -> list[Run]:
        """Its runs that have begun."""
        paths = (self.path / trial["name"] for trial in self.trials)
        return [Run(path) for path in paths if (path / "config.toml").is_file()]

    @property
    def results(self) -> np.ndarray:
        """A structured array with a row for each trial: ``run`` is its name, ``seed`` its seed, then come the keys in
        which the runs differ, and ``return_mean`` and ``return_std`` of the best policy's final evaluation. What is not
        known (yet) is NaN or empty."""
        trials = self.trials
        own = [dict(assignment.split("=", 1) for assignment in trial["set"]) for trial in trials]
        keys = list(dict.fromkeys(key for values in own for key in values))
        results = [_result(self.path / trial["name"]) for trial in trials]

        def numbers(name: str) -> np.ndarray:
            return np.array([np.nan if of.get(name) is None else of[name] for of in results], dtype=np.float64)

        columns = {
            "run": np.array([trial["name"] for trial in trials], dtype=object),
            "seed": tables.column(["" if trial["seed"] is None else str(trial["seed"]) for trial in trials]),
            **{key: tables.column([values.get(key, "") for values in own]) for key in keys},
            "return_mean": numbers("return_mean"),
            "return_std": numbers("return_std"),
        }
        return tables.of_columns(columns)

    def resume(
        self,
        *,
        steps: int | None = None,
        set: Mapping[str, Any] | None = None,
        jobs: int | None = None,
        quiet: bool = False,
    ) -> Suite:
        """Continues all its runs to their end, or to a new number of ``steps``, with changed settings, ``jobs`` at a
        time. Returns the suite."""
        command = [program.program(), "resume", str(self.path), "--json"]
        options = [("--steps", steps), ("--jobs", jobs)]
        command += [str(part) for option, value in options if value is not None for part in (option, value)]
        program.follow(command + program.settings(set), quiet)
        return self

    def wait(self, timeout: float | None = None) -> Suite:
        """Waits until no process works on the suite, for at most ``timeout`` seconds. Returns the suite.

        Raises ``TimeoutError`` if one still does.
        """
        give_up = None if timeout is None else time.monotonic() + timeout
        while is_locked(self.path):
            if give_up is not None and time.monotonic() > give_up:
                raise TimeoutError(f"{self.path} is still worked on after {timeout} s")
            time.sleep(0.5)
        return self


def _result(run: Path) -> dict[str, Any]:
    """The final evaluation of the run's best policy; empty if there is none."""
    result = Run(run).result if (run / "config.toml").is_file() else None
    policies = result["policies"] if result else []
    return next((policy for policy in policies if policy["policy"] == result["kept"]), {})
