"""Pictures of an environment for a program that watches it: ``docs/PROTOCOL.md``, "Pictures"."""

import json
import os
import sys
from collections.abc import Callable
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

FORMAT = 1
HEIGHT = 480
"""The greatest height in pixels, unless another one is asked for."""

MODE = "rgb_array"


class NoPicture(Exception):
    """Why an environment cannot be drawn."""


class Pictures:
    """Draws one environment into a file whenever the last picture was taken away. An environment that cannot be drawn is no
    error: the file says why."""

    def __init__(self, file: str, height: int = HEIGHT) -> None:
        self._file = Path(file)
        self._height = height
        self._reason: str | None = None

    @classmethod
    def wanted(cls) -> "Pictures | None":
        """As the process's environment variables ask for."""
        file = os.environ.get("SHOAL_PICTURES")
        if not file:
            return None
        height = os.environ.get("SHOAL_PICTURES_HEIGHT", "")
        return cls(file, max(1, int(height)) if height.isdigit() else HEIGHT)

    def make(self, name: str, parameters: dict[str, Any]) -> gym.Env[Any, Any]:
        """The environment in a mode in which it can be drawn, if it has one."""
        if "render_mode" in parameters:
            return gym.make(name, **parameters)
        _without_display()
        try:
            return gym.make(name, render_mode=MODE, **{**size(name, self._height), **parameters})
        except Exception as reason:
            # If it cannot be made at all, the next line says so.
            environment = gym.make(name, **parameters)
            self._reason = _in_words(reason)
            return environment

    def draw(self, environment: gym.Env[Any, Any]) -> None:
        """Writes the current state's picture, unless nobody has asked for it."""
        if self._file.exists():
            return
        if self._reason is None:
            try:
                picture = scaled(_pixels(environment.render), self._height)
            except Exception as reason:
                self._reason = _in_words(reason)
        if self._reason is not None:
            self._write({"kind": "none", "reason": self._reason}, b"")
            return
        header: dict[str, Any] = {"kind": "rgb", "width": picture.shape[1], "height": picture.shape[0]}
        fps = environment.metadata.get("render_fps")
        if isinstance(fps, int | float) and 0 < fps < float("inf"):
            header["fps"] = fps
        self._write(header, picture.tobytes())

    def _write(self, header: dict[str, Any], pixels: bytes) -> None:
        line = json.dumps({"format": FORMAT, **header})
        try:
            self._file.write_bytes(line.encode() + b"\n" + pixels)
        except OSError as reason:
            print(f"cannot write a picture: {reason}", file=sys.stderr, flush=True)


def size(name: str, height: int) -> dict[str, Any]:
    """Arguments with which a simulator draws no more pixels than are kept: without a graphics card, drawing is slow."""
    try:
        entry_point = gym.spec(name).entry_point
    except gym.error.Error:
        return {}
    is_mujoco = isinstance(entry_point, str) and entry_point.startswith("gymnasium.envs.mujoco")
    return {"width": height, "height": height} if is_mujoco and height < HEIGHT else {}


def scaled(picture: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    """The picture at most ``height`` pixels high and twice as wide. Each pixel is the mean of the area that it covers."""
    rows, columns = picture.shape[:2]
    factor = max(rows / height, columns / (2 * height))
    if factor <= 1:
        return np.ascontiguousarray(picture)
    to_rows, to_columns = max(1, round(rows / factor)), max(1, round(columns / factor))
    fewer = np.tensordot(_means(rows, to_rows), picture.astype(np.float32), axes=(1, 0))
    fewer = np.tensordot(fewer, _means(columns, to_columns), axes=(1, 1)).transpose(0, 2, 1)
    return np.ascontiguousarray(np.clip(np.rint(fewer), 0, 255).astype(np.uint8))


def _means(count: int, to: int) -> NDArray[np.float32]:
    """Row i has the shares of ``count`` equal parts in part i of ``to``."""
    edges = np.arange(to + 1) * (count / to)
    parts = np.arange(count)
    covered = np.minimum(parts + 1, edges[1:, None]) - np.maximum(parts, edges[:-1, None])
    return (np.clip(covered, 0, None) * (to / count)).astype(np.float32)


def _pixels(render: Callable[[], Any]) -> NDArray[np.uint8]:
    picture = render()
    if picture is None:
        raise NoPicture(f"it has no render_mode {MODE}")
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        kind = f"an array of {picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
        raise NoPicture(f"its render returned {kind} instead of rows of pixels with three bytes each")
    if picture.size == 0:
        raise NoPicture("its render returned an empty picture")
    return picture


def _without_display() -> None:
    """Lets simulators draw on a machine without a screen. Both variables must be set before the simulator is imported."""
    if "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ:
        return
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    if "MUJOCO_GL" not in os.environ:
        # MuJoCo itself cannot be imported with a library that is missing.
        for library, name in [("EGL", "egl"), ("OSMesa", "osmesa")]:
            if find_library(library):
                os.environ["MUJOCO_GL"] = name
                break


def _in_words(reason: Exception) -> str:
    text = " ".join(str(reason).split())
    if isinstance(reason, NoPicture | gym.error.Error):
        return text
    return f"{type(reason).__name__}: {text}" if text else type(reason).__name__
