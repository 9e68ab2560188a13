"""Policies in numpy, without the program."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import ShoalError

#: The first bytes of a policy file, and the format that this package reads (``common/policy/src/policy_file.rs``).
MAGIC = b"SHOALPOL"
VERSION = 1

#: The words before the parameters.
HEADER = struct.Struct("<QQQddQQ")

#: A normalised number is clipped to this range on both sides of 0 (``common/policy/src/network/normalise.rs``).
OBSERVATION_CLIP = np.float32(10.0)


class Policy:
    """A policy of a run without exploration, as the evaluator uses it.

    Calling it with one observation, a vector or an index, returns one action. Calling it with a batch, whose first
    axis counts the observations, returns a batch. Actions are in the environment's own units: ``float32`` vectors, or
    ``int64`` numbers for discrete actions.

    Attributes:
        version: the number of the policy, which grows with each publication.
        env_steps: environment steps that it was learned from.
        return_mean: mean return of its evaluation; NaN if it has none.
        return_std: standard deviation of that return.
        episodes: episodes of that evaluation.
        algorithm: the section of the configuration that it was learned with, such as ``"ddpg"``.
    """

    def __init__(self, path: Path, config: Mapping[str, Any]) -> None:
        body = unseal(path)
        words = HEADER.unpack_from(body)
        _, self.version, self.env_steps, self.return_mean, self.return_std, self.episodes, count = words
        parameters = np.frombuffer(body, dtype="<f4", offset=HEADER.size)
        if len(parameters) != count:
            raise ShoalError(f"{path}: its parts do not fit together")
        self.algorithm = next((name for name in ALGORITHMS if name in config), "")
        if not self.algorithm or "spec" not in config:
            raise ShoalError(f"{path}: the run's configuration has no spaces, or no algorithm that this package knows")
        self._observation, self._action = config["spec"]["observation"], config["spec"]["action"]
        settings = config[self.algorithm]
        outputs, self._output_kind = ALGORITHMS[self.algorithm](size(self._action), settings)
        self._dueling = bool(settings.get("dueling", False))
        self._table: np.ndarray | None = None
        self._layers: list[tuple[np.ndarray, np.ndarray]] = []
        self._normaliser: tuple[np.ndarray, np.ndarray] | None = None
        expected = self._read(parameters, settings, outputs, config)
        if expected != len(parameters):
            raise ShoalError(f"{path} has {len(parameters)} parameters, but its network has {expected}")
        self._tanh = settings.get("activation") == "tanh"

    def _read(
        self, parameters: np.ndarray, settings: Mapping[str, Any], outputs: int, config: Mapping[str, Any]
    ) -> int:
        """Splits the parameters into tables or layers. Returns how many there must be."""
        if self._output_kind == "table":
            states = size(self._observation)
            if len(parameters) == states * outputs:
                self._table = parameters.reshape(states, outputs)
            return states * outputs
        sizes = [width(self._observation), *settings["hidden"], outputs]
        place = 0
        for inputs, units in zip(sizes, sizes[1:]):
            weights, biases = parameters[place:][: inputs * units], parameters[place + inputs * units :][:units]
            place += (inputs + 1) * units
            if place <= len(parameters):
                # In the file, the weights of an input are consecutive.
                self._layers.append((weights.reshape(inputs, units), biases))
        if config.get("observation", {}).get("normalise", False):
            mean, factor = parameters[place:][: sizes[0]], parameters[place + sizes[0] :][: sizes[0]]
            self._normaliser = (mean, factor)
            place += 2 * sizes[0]
        return place

    def __call__(self, observations: npt.ArrayLike) -> np.ndarray:
        """The actions for one observation or for a batch of them."""
        outputs, single = self._outputs(observations)
        if self._output_kind in ("table", "scores"):
            actions = np.argmax(outputs, axis=1) + int(self._action["discrete"].get("start", 0))
        else:
            low, high = (np.asarray(self._action["box"][end], dtype=np.float32) for end in ("low", "high"))
            half = high / 2 - low / 2
            means = outputs[:, : len(low)]
            actions = np.clip(low / 2 + high / 2 + half * np.tanh(means), low, high)
        return actions[0] if single else actions

    def scores(self, observations: npt.ArrayLike) -> np.ndarray:
        """The score of each discrete action: its value, or the logit of its probability (REINFORCE)."""
        if self._output_kind not in ("table", "scores"):
            raise ShoalError("a policy with real-valued actions has no scores")
        outputs, single = self._outputs(observations)
        return outputs[0] if single else outputs

    def _outputs(self, observations: npt.ArrayLike) -> tuple[np.ndarray, bool]:
        if self._table is not None:
            states = np.asarray(observations)
            start = int(self._observation["discrete"].get("start", 0))
            rows = np.clip(states.reshape(-1).astype(np.int64) - start, 0, len(self._table) - 1)
            return self._table[rows], states.ndim == 0
        inputs = width(self._observation)
        if "discrete" in self._observation:
            # A network sees an index as a number, counted from 0.
            states = np.asarray(observations)
            single = states.ndim == 0
            x = (states.reshape(-1, 1) - int(self._observation["discrete"].get("start", 0))).astype(np.float32)
        else:
            x = np.asarray(observations, dtype=np.float32)
            # An observation of any shape is a vector here: a batch has its observations along the first axis.
            single = x.ndim <= 1
            x = x.reshape(1 if single else len(x), -1)
        if x.shape[1] != inputs:
            raise ShoalError(
                f"an observation has {inputs} numbers, but {x.shape[1]} were given; a batch has shape (n, {inputs})"
            )
        if self._normaliser is not None:
            mean, factor = self._normaliser
            x = np.clip((x - mean) * factor, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for weights, biases in self._layers[:-1]:
            x = x @ weights + biases
            x = np.tanh(x) if self._tanh else np.maximum(x, 0)
        weights, biases = self._layers[-1]
        x = x @ weights + biases
        if self._dueling:
            # Q = V + A - mean of A (Wang et al. 2016, equation 9).
            x = x[:, :1] + x[:, 1:] - x[:, 1:].mean(axis=1, keepdims=True)
        return x, single


#: For each algorithm: the outputs of its policy's network, given the width of an action, and what they are.
ALGORITHMS = {
    "ddpg": lambda actions, _: (actions, "means"),
    "td3": lambda actions, _: (actions, "means"),
    # All means, then the logarithms of all standard deviations.
    "sac": lambda actions, _: (2 * actions, "means"),
    "dqn": lambda actions, settings: (actions + int(settings.get("dueling", False)), "scores"),
    "reinforce": lambda actions, _: (actions, "scores"),
    "q-learning": lambda actions, _: (actions, "table"),
    "sarsa": lambda actions, _: (actions, "table"),
}


def size(space: Mapping[str, Any]) -> int:
    """The numbers of a box, or how many indices a discrete space has."""
    return len(space["box"]["low"]) if "box" in space else int(space["discrete"]["n"])


def width(space: Mapping[str, Any]) -> int:
    """The numbers of an observation: one for an index."""
    return len(space["box"]["low"]) if "box" in space else 1


def unseal(path: Path) -> bytes:
    """The contents of a policy file, whose checksum has been compared."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise ShoalError(f"{path}: there is no policy here; has the run been evaluated yet?") from error
    except OSError as error:
        raise ShoalError(f"{path} cannot be read: {error.strerror}") from error
    if data[:8] != MAGIC:
        raise ShoalError(f"{path} is not a policy file")
    if len(data) < 16 + HEADER.size or zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        raise ShoalError(f"{path} is damaged or cut short (checksum)")
    version = int.from_bytes(data[8:12], "little")
    if version != VERSION:
        raise ShoalError(f"{path} has format {version}; this package reads format {VERSION}")
    return data[12:-4]
