"""The program ``shoal``: where it is, how it is called, and how a training is started."""

from __future__ import annotations

import collections
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import ShoalError

if TYPE_CHECKING:
    from .run import Run
    from .suite import Suite

#: Lines of the program's messages that are kept for an error.
KEPT_LINES = 20

#: How the program's messages are read, whatever the locale is.
TEXT: Any = {"encoding": "utf-8", "errors": "replace"}


def program() -> str:
    """The path of the program: ``$SHOAL``, else this installation's if a wheel brought one, else ``shoal`` in
    ``PATH``, else beside the Python interpreter."""
    named = os.environ.get("SHOAL")
    beside = Path(sys.executable).parent / "shoal"
    found = named or installed() or shutil.which("shoal") or (str(beside) if beside.exists() else None)
    if found is None:
        raise ShoalError(
            "there is no program `shoal` in PATH: install it with `cargo install --path .` in Shoal's directory, "
            "or name it in the environment variable SHOAL"
        )
    return found


def installed() -> str | None:
    """The program that was installed together with this package."""
    try:
        files = importlib.metadata.files("shoal-gym") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    programs = (Path(file.locate()) for file in files if file.parts[-2:] == ("bin", "shoal"))
    return next((os.path.normpath(path) for path in programs if path.exists()), None)


def text_of(value: Any) -> str:
    """A value of a setting as the option ``--set`` takes it."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.ndarray):
        # The shortest text of each number in its own precision: 0.1 for float32(0.1).
        return text_of(value[()] if value.ndim == 0 else list(value))
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        pairs = (f"{toml_string(str(key))} = {toml_value(item)}" for key, item in value.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    return str(value)


def toml_value(value: Any) -> str:
    return toml_string(value) if isinstance(value, str) else text_of(value)


def toml_string(text: str) -> str:
    """The text as TOML writes it. JSON's escapes of characters above U+FFFF are surrogates, which TOML refuses."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def settings(values: Mapping[str, Any] | None) -> list[str]:
    """The options ``--set`` for these keys and values."""
    return [part for key, value in (values or {}).items() for part in ("--set", f"{key}={text_of(value)}")]


#: The exit code of `shoal status` for a run that is not running.
NOT_RUNNING_EXIT_CODE = 3

#: How the message of `shoal stop` begins for such a run.
NOT_RUNNING_MESSAGE = "nothing runs in "


def call(arguments: Sequence[str | os.PathLike[str]], accepted: Sequence[int] = (0,)) -> str:
    """Runs the program to its end and returns what it printed.

    Raises :class:`ShoalError` with its message if its exit code is none of those ``accepted``.
    """
    command = [program(), *(os.fspath(argument) for argument in arguments)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, **TEXT)
    if done.returncode not in accepted:
        raise failure(done.stderr, done.returncode)
    return done.stdout


def failure(messages: str, code: int) -> ShoalError:
    """The error for a program that ended with ``code`` after these messages."""
    lines = [line for line in messages.splitlines() if line.strip()]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    message = errors[-1] if errors else lines[-1] if lines else f"shoal ended with exit code {code}"
    return ShoalError(message, code)


def follow(command: Sequence[str], quiet: bool) -> str:
    """Runs a training to its end, shows its lines while it runs, and returns what it printed.

    If this Python is interrupted, the training is too: it saves what it has, and then ``KeyboardInterrupt`` is raised.
    If it is killed, the training ends and can be resumed.
    """
    # The kernel kills the program when the thread that started it ends; that thread waits here. Once the launcher is
    # dead, the roles save what they have and end.
    command = [program(), "tied", str(os.getpid()), *command]
    last: collections.deque[str] = collections.deque(maxlen=KEPT_LINES)
    with tempfile.TemporaryFile("w+", **TEXT) as printed:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.PIPE, start_new_session=True, **TEXT
        )
        assert child.stderr is not None
        try:
            for line in child.stderr:
                last.append(line)
                # An error becomes an exception.
                if not quiet and not line.startswith("error: "):
                    print(line, end="", file=sys.stderr, flush=True)
            code = child.wait()
        except BaseException:
            child.terminate()
            # Its last lines are read too: a full pipe would keep it from ending.
            child.communicate()
            raise
        if code != 0:
            raise failure("".join(last), code)
        printed.seek(0)
        return printed.read()


def train(
    what: str,
    *,
    run: str | os.PathLike[str] | None = None,
    steps: int | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    actors: int | None = None,
    envs: int | None = None,
    method: str | None = None,
    lockstep: bool = False,
    set: Mapping[str, Any] | None = None,
    from_run: str | os.PathLike[str] | Run | None = None,
    with_replay: bool = False,
    demonstrations: str | None = None,
    wait: bool = True,
    quiet: bool = False,
) -> Run:
    """Trains ``what``: a preset (``"pendulum"``), an environment (``"gym:Pendulum-v1"``) or a configuration file.

    ``set`` has settings by their keys, as in ``{"ddpg.tau": 0.005}``; ``shoal train --help-config`` lists them. Values
    may be numpy's. The other arguments are the options of ``shoal train``. ``run`` is the directory to create, by default
    ``runs/<what>-<n>``.

    With ``wait``, this returns when the training has finished, and shows its lines unless ``quiet``. If this Python is
    killed meanwhile, the run ends too, and can be resumed. Without ``wait``, it returns as soon as all actors work. The
    training then continues even if this Python ends; :meth:`Run.stop` ends it.

    Raises :class:`ShoalError` if the program refuses or fails.
    """
    from .run import Run

    arguments = _arguments(
        what,
        run=run,
        steps=steps,
        episodes=episodes,
        seed=seed,
        actors=actors,
        envs=envs,
        method=method,
        lockstep=lockstep,
        set=set,
        from_run=from_run,
        with_replay=with_replay,
        demonstrations=demonstrations,
    )
    printed = follow([program(), *arguments], quiet) if wait else call([*arguments, "--detach", "--quiet"])
    return Run(json.loads(printed)["run"])


def train_suite(
    what: str,
    *,
    seeds: Iterable[int] | None = None,
    sweep: Mapping[str, Iterable[Any]] | None = None,
    halving: bool = False,
    jobs: int | None = None,
    quiet: bool = False,
    **options: Any,
) -> Suite:
    """Trains a suite: a run for each of these ``seeds``, with each combination of the values of the keys in ``sweep``,
    as in ``{"ddpg.tau": [0.001, 0.005]}``. Returns it when all its runs have been trained.

    ``halving`` ends bad settings early. ``jobs`` is the number of runs at a time, by default what the machine allows.
    The other ``options`` are the arguments of :func:`train`, except ``seed`` and ``wait``, and all runs have them. ``run`` is
    the directory of the suite. Called again with the same options, this continues a suite that was interrupted.

    Raises :class:`ShoalError` if the program refuses, or a run fails.
    """
    from .suite import Suite

    if seeds is None and not sweep:
        raise ShoalError("a suite needs several seeds or values: give seeds or sweep, or call train() for one run")
    arguments = _arguments(what, **options)
    if seeds is not None:
        arguments += ["--seeds", ",".join(str(seed) for seed in seeds)]
    for key, values in (sweep or {}).items():
        arguments += ["--sweep", f"{key}={','.join(_item(value) for value in values)}"]
    arguments += ["--halving"] if halving else []
    arguments += ["--jobs", str(jobs)] if jobs is not None else []
    return Suite(json.loads(follow([program(), *arguments], quiet))["suite"])


def _item(value: Any) -> str:
    """A value in the list of ``--sweep``, in which commas separate values."""
    return toml_string(value) if isinstance(value, str) and "," in value else text_of(value)


#: The arguments of :func:`train` that are options with a value.
OPTIONS = {
    "run": "--run",
    "steps": "--steps",
    "episodes": "--episodes",
    "seed": "--seed",
    "actors": "--actors",
    "envs": "--envs",
    "method": "--method",
    "from_run": "--from",
    "demonstrations": "--demonstrations",
}

#: The arguments of :func:`train` that are options without a value.
SWITCHES = {"lockstep": "--lockstep", "with_replay": "--with-replay"}


def _arguments(what: str, set: Mapping[str, Any] | None = None, **given: Any) -> list[str]:
    """The arguments of the program for these arguments of :func:`train`."""
    unknown = given.keys() - OPTIONS.keys() - SWITCHES.keys()
    if unknown:
        raise TypeError(f"unexpected argument {min(unknown)!r}")
    arguments = ["train", what, "--json"]
    for name, option in OPTIONS.items():
        value = given.get(name)
        if value is not None:
            arguments += [option, str(getattr(value, "path", value) if name == "from_run" else value)]
    arguments += [option for name, option in SWITCHES.items() if given.get(name)]
    return arguments + settings(set)
