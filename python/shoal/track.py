"""Copies what a run records to a tracker, Weights & Biases or MLflow, while it runs and afterwards.

``shoal track RUN --to mlflow`` calls this module. It needs the tracker's own Python package. It changes none of the
run's files. It adds ``tracking-<tracker>.json``, which says which run of the tracker this is, and how many lines of
each file were sent. So it may be interrupted and repeated; at most the lines that were being sent are sent twice.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .errors import ShoalError
from .locks import is_locked
from .run import Run
from .suite import Suite

#: The files that are followed, and what their metrics are called.
TABLES = {"evaluations": "evaluation", "learner": "learner", "episodes": "episode"}

#: Columns that are no measurements: times, numbers of things, and flags.
NOT_METRICS = {"wall_seconds", "env_steps", "actor", "environment", "best", "terminated"}

#: Lines that are sent together.
BATCH_LINES = 500

#: Files of a run that a tracker keeps, beside its figures.
ARTIFACTS = ("config.toml", "config/used.toml", "changes.csv", "report.html")

#: Seconds between two looks at a run.
POLL_SECONDS = 2.0


class Tracker(Protocol):
    """A run of a tracker."""

    #: The tracker's own name for it.
    id: str

    def settings(self, settings: Mapping[str, Any]) -> None:
        """Records the configuration: values by ``section.key``."""

    def metrics(self, rows: Sequence[tuple[float, int, Mapping[str, float]]]) -> None:
        """Records metrics: for each row its seconds since the start of the run, its step, and values by name."""

    def result(self, values: Mapping[str, float]) -> None:
        """Records the final result, by name."""

    def files(self, run: Run, paths: Sequence[Path]) -> None:
        """Keeps copies of these files of the run."""

    def close(self, state: str) -> None:
        """Ends the connection. The run is ``finished``, ``stopped`` or still ``running``."""


class MLflow:
    """A run of MLflow, in the store that ``MLFLOW_TRACKING_URI`` names, by default a local one."""

    def __init__(self, run: Run, project: str, group: str | None, begun: float, tracker_id: str | None) -> None:
        try:
            from mlflow import MlflowClient
            from mlflow.entities import Metric
        except ImportError as error:
            raise ShoalError("--to mlflow needs the package mlflow: pip install mlflow") from error
        self._client, self._metric = MlflowClient(), Metric
        experiment = self._client.get_experiment_by_name(project)
        number = experiment.experiment_id if experiment else self._client.create_experiment(project)
        if tracker_id is None:
            tags = {"shoal.run": str(run.path), **({"shoal.suite": group} if group else {})}
            tracker_id = self._client.create_run(number, run_name=run.path.name, tags=tags).info.run_id
        else:
            self._client.update_run(tracker_id, status="RUNNING")
        self.id: str = tracker_id
        self._begun = int(1000 * begun)

    def settings(self, settings: Mapping[str, Any]) -> None:
        existing = self._client.get_run(self.id).data.params
        for key, value in settings.items():
            # A parameter of MLflow cannot change; a changed one is a tag.
            if key not in existing:
                self._client.log_param(self.id, key, value)
            elif existing[key] != str(value):
                self._client.set_tag(self.id, f"changed.{key}", value)

    def metrics(self, rows: Sequence[tuple[float, int, Mapping[str, float]]]) -> None:
        metrics = [
            self._metric(name, value, self._begun + int(1000 * seconds), step)
            for seconds, step, values in rows
            for name, value in values.items()
        ]
        for first in range(0, len(metrics), BATCH_LINES):
            self._client.log_batch(self.id, metrics=metrics[first : first + BATCH_LINES])

    def result(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._client.log_metric(self.id, name, value)

    def files(self, run: Run, paths: Sequence[Path]) -> None:
        for path in paths:
            self._client.log_artifact(self.id, str(path))

    def close(self, state: str) -> None:
        if state != "running":
            self._client.set_terminated(self.id, "FINISHED" if state == "finished" else "KILLED")


class WeightsAndBiases:
    """A run of Weights & Biases, in the mode that ``WANDB_MODE`` names; ``offline`` needs no account."""

    def __init__(self, run: Run, project: str, group: str | None, begun: float, tracker_id: str | None) -> None:
        try:
            import wandb
        except ImportError as error:
            raise ShoalError("--to wandb needs the package wandb: pip install wandb") from error
        self._wandb = wandb
        directory = os.environ.get("WANDB_DIR", str(run.path))
        self._run = wandb.init(
            project=project, name=run.path.name, group=group, id=tracker_id, resume="allow", dir=directory
        )
        self.id: str = self._run.id
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    def settings(self, settings: Mapping[str, Any]) -> None:
        self._run.config.update(dict(settings), allow_val_change=True)

    def metrics(self, rows: Sequence[tuple[float, int, Mapping[str, float]]]) -> None:
        for seconds, step, values in rows:
            self._run.log({**values, "env_steps": step, "wall_seconds": seconds})

    def result(self, values: Mapping[str, float]) -> None:
        self._run.summary.update(dict(values))

    def files(self, run: Run, paths: Sequence[Path]) -> None:
        artifact = self._wandb.Artifact(f"shoal-{self.id}", type="run")
        for path in paths:
            artifact.add_file(str(path), name=str(path.relative_to(run.path)))
        self._run.log_artifact(artifact)

    def close(self, state: str) -> None:
        self._run.finish(exit_code=0 if state != "stopped" else 1)


TRACKERS: dict[str, type] = {"mlflow": MLflow, "wandb": WeightsAndBiases}


@contextlib.contextmanager
def errors_of(tracker: str) -> Iterator[None]:
    """Errors of the tracker's package become a :class:`ShoalError` of one line."""
    try:
        yield
    except (ShoalError, OSError):
        raise
    except Exception as error:
        raise ShoalError(f"{tracker}: {' '.join(str(error).split()) or type(error).__name__}") from error


def track(path: str | os.PathLike[str], to: str, *, project: str = "shoal", follow: bool = True) -> None:
    """Copies a run, or each run of a suite, to the tracker ``"mlflow"`` or ``"wandb"``.

    With ``follow``, this returns when no run is running any more; without, it copies what is there now. A run that a
    suite has not begun yet is tracked as soon as it has.
    """
    if to not in TRACKERS:
        raise ShoalError(f"there is no tracker {to!r}; choose one of {', '.join(TRACKERS)}")
    path = Path(path).absolute()
    group = path.name if (path / "suite.json").is_file() else None
    tracked: dict[Path, TrackedRun] = {}
    try:
        while True:
            for run in runs(path):
                if run.path not in tracked:
                    tracked[run.path] = TrackedRun(run, to, project, group)
            # Looked at before copying, so that a run's last lines are copied too.
            continues = any(map(is_locked, [path, *tracked]))
            for copy in tracked.values():
                copy.update()
            if not (follow and continues):
                break
            time.sleep(POLL_SECONDS)
    finally:
        with contextlib.ExitStack() as closing:
            # A tracker that fails does not keep the others open.
            for copy in tracked.values():
                closing.callback(copy.close)


def runs(path: Path) -> list[Run]:
    """The run of this directory, or the runs of this suite that have begun."""
    return Suite(path).runs if (path / "suite.json").is_file() else [Run(path)]


class TrackedRun:
    """A run and its copy in a tracker."""

    def __init__(self, run: Run, to: str, project: str, group: str | None) -> None:
        self.run = run
        self._file = run.path / f"tracking-{to}.json"
        state = self._load()
        self._begun: float = state.get("begun") or started(run)
        self._lines: dict[str, int] = state.get("lines", {})
        self._result: dict[str, Any] | None = state.get("result")
        self._to = to
        with errors_of(to):
            self._tracker: Tracker = TRACKERS[to](run, project, group, self._begun, state.get("id"))

    def update(self) -> None:
        """Copies what was added since."""
        settings = dict(flat(self.run.config))
        with errors_of(self._to):
            self._tracker.settings(settings)
        for name, prefix in TABLES.items():
            if not has_header(self.run.path / f"{name}.csv"):
                # The run starts: its launcher has not made its tables yet.
                continue
            table = self.run.table(name)
            done = self._lines.get(name, 0)
            added = list(rows(table[done:], prefix))
            with errors_of(self._to):
                self._tracker.metrics(added)
            self._lines[name] = len(table)
            self._save()

    def close(self) -> None:
        """Copies result and files, and ends the connection."""
        result = self.run.result
        if result is not None and result != self._result:
            for policy in result["policies"]:
                name = policy["policy"]
                values = {f"final/{name}_{key}": policy[key] for key in ("return_mean", "return_std", "episodes")}
                values = {key: value for key, value in values.items() if value is not None}
                with errors_of(self._to):
                    self._tracker.result(values)
            self._result = result
            self._save()
        files = [self.run.path / name for name in ARTIFACTS] + sorted(self.run.path.glob("*.svg"))
        with errors_of(self._to):
            self._tracker.files(self.run, [path for path in files if path.is_file()])
        outcome = self.run.path / "outcome.json"
        finished = outcome.is_file() and json.loads(outcome.read_text(encoding="utf-8"))["state"] == "finished"
        running = is_locked(self.run.path)
        with errors_of(self._to):
            self._tracker.close("running" if running else "finished" if finished else "stopped")

    def _load(self) -> dict[str, Any]:
        try:
            state = json.loads(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise ShoalError(f"{self._file} is damaged; remove it to copy the run once more, as a new one") from error
        return state

    def _save(self) -> None:
        state = {"id": self._tracker.id, "begun": self._begun, "lines": self._lines, "result": self._result}
        new = self._file.with_suffix(".json.new")
        with new.open("w", encoding="utf-8") as file:
            json.dump({"format": 1, **state}, file)
            file.flush()
            # Before it is renamed: a power loss must not leave an empty file with the final name.
            os.fsync(file.fileno())
        new.replace(self._file)


def started(run: Run) -> float:
    """When the run was started, in seconds since 1970."""
    file = run.path / "start.json"
    try:
        return float(json.loads(file.read_text(encoding="utf-8"))["started"])
    except FileNotFoundError:
        # A run of an earlier version. Its configuration is written again when a setting changes.
        return (run.path / "config.toml").stat().st_mtime
    except (ValueError, KeyError, TypeError) as error:
        raise ShoalError(f"{file} is damaged; remove it, and the time of config.toml counts as the start") from error


def has_header(path: Path) -> bool:
    """Whether a table exists and its first line is whole."""
    try:
        with path.open("rb") as file:
            return file.readline().endswith(b"\n")
    except FileNotFoundError:
        return False


def flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of a nested table by their dotted keys; lists as text."""
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", json.dumps(value) if isinstance(value, list) else value


def rows(table: np.ndarray, prefix: str) -> Iterator[tuple[float, int, dict[str, float]]]:
    """The lines of a table with their metrics. Empty cells are left out."""
    names = [name for name in table.dtype.names or () if name not in NOT_METRICS and table[name].dtype != object]
    for row in table:
        values = {f"{prefix}/{name}": float(row[name]) for name in names if np.isfinite(row[name])}
        yield float(row["wall_seconds"]), int(row["env_steps"]), values


def main() -> int:
    parser = argparse.ArgumentParser(prog="shoal track", description="Copies what a run or suite records to a tracker.")
    parser.add_argument("run", help="the directory of a run or suite")
    parser.add_argument("--to", choices=sorted(TRACKERS), required=True)
    parser.add_argument("--project", default="shoal", help="project or experiment of the tracker [default: shoal]")
    parser.add_argument("--once", action="store_true", help="copy what is there now, and do not wait for the end")
    arguments = parser.parse_args()
    try:
        track(arguments.run, arguments.to, project=arguments.project, follow=not arguments.once)
        print(f"{arguments.run} is in {arguments.to}, project {arguments.project}", file=sys.stderr)
    except (ShoalError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
