"""A vector of Gymnasium environments of one kind, with autoreset and an episode's seed for every counter."""

import enum
import os
import random
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from . import spaces
from .pictures import Pictures
from .spaces import Invalid, Unsupported, codec_of

SEEDS = 2**31
"""Seeds of episodes are below this: some simulators take no others."""

class Purpose(enum.IntEnum):
    """What an episode is for; part of its seed."""

    TRAINING = 1
    EVALUATION = 2
    PROCESS = 3
    """No episode: the seed of ``random`` and ``numpy.random``."""


@dataclass
class Blocks:
    """The blocks of a response, each environment after environment."""

    observations: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.float32]
    truncated: NDArray[np.float32]

    @classmethod
    def of(cls, response: NDArray[np.float32], count: int, width: int) -> "Blocks":
        """Views into a response of ``length(count, width)`` numbers."""
        n = count * width
        return cls(
            response[:n].reshape(count, width),
            response[n : 2 * n].reshape(count, width),
            response[2 * n :][:count],
            response[2 * n + count :][:count],
            response[2 * n + 2 * count :][:count],
        )

    @staticmethod
    def length(count: int, width: int) -> int:
        return 2 * count * width + 3 * count


@dataclass
class Slot:
    """An environment and its episode."""

    environment: gym.Env[Any, Any]
    next_training: int = 0
    next_evaluation: int = 0
    episode: int = 0
    steps: int = 0
    over: bool = False


class Environments:
    """``count`` environments, each in its own episode.

    Training episode k of environment e is seeded by (seed, server, stream, e, k), evaluation episode k by (seed, k): an
    episode is reached by its counters, whatever was run before.
    """

    def __init__(
        self,
        name: str,
        parameters: dict[str, Any],
        count: int,
        seed: int,
        server: int,
        stream: int,
        pictures: Pictures | None = None,
    ) -> None:
        """``pictures`` are drawn of the first environment."""
        self._name = name
        self._pictures = pictures
        _seed_process(seed, server, stream)
        parameters = {"disable_env_checker": True, **parameters}
        os.environ["SHOAL_SERVER"] = str(server)
        self._slots = [Slot(_make(name, parameters, e, pictures)) for e in range(count)]
        first = self._slots[0].environment
        self.observation = codec_of(first.observation_space, "observations")
        self.action = codec_of(first.action_space, "actions")
        limit = first.spec.max_episode_steps if first.spec else None
        if limit is None:
            raise Unsupported(
                "it has no time limit: give one, as with --set environment.max_episode_steps=1000"
            )
        self.time_limit = int(limit)
        self._seed, self._server, self._stream = seed, server, stream
        self._purpose = Purpose.TRAINING
        self._end_of_evaluation: int | None = None

    def __len__(self) -> int:
        return len(self._slots)

    def begin_next(self, blocks: Blocks) -> None:
        """Each environment begins its next training episode. Raises ``Invalid`` if one breaks Gymnasium's interface."""
        self._purpose = Purpose.TRAINING
        self._begin_all(blocks)

    def begin_training(self, episode: int, blocks: Blocks) -> None:
        """Each environment begins this training episode of its own, and counts on from there. Raises ``Invalid`` as
        above."""
        for slot in self._slots:
            slot.next_training = episode
        self.begin_next(blocks)

    def begin_evaluation(self, first: int, count: int, blocks: Blocks) -> None:
        """Environment e begins evaluation episode ``first`` + e; at its end it continues with the one ``len(self)``
        later, as long as that is one of the ``count`` first; 0 is no limit. Raises ``Invalid`` as above."""
        self._purpose = Purpose.EVALUATION
        for e, slot in enumerate(self._slots):
            slot.next_evaluation = first + e
        self._end_of_evaluation = first + count if count else None
        self._begin_all(blocks)

    def step(self, actions: NDArray[Any], blocks: Blocks) -> None:
        """Every environment takes a step with its action, an element of the action space. Raises ``Invalid`` if one
        breaks Gymnasium's interface; then new episodes must be begun."""
        next_observations = self.observation.view(blocks.next_observations)
        over = []
        for e, (slot, action) in enumerate(zip(self._slots, actions, strict=True)):
            if slot.over:
                # Its last evaluation episode has ended.
                next_observations[e] = self.observation.view(blocks.observations)[e] = 0
                blocks.rewards[e] = blocks.terminated[e] = blocks.truncated[e] = 0
                continue
            slot.steps += 1
            try:
                # Gymnasium's wrappers guarantee five values.
                observation, reward, terminated, truncated, _ = slot.environment.step(action)
                next_observations[e] = self.observation.encode(observation)
                blocks.rewards[e] = spaces.reward(reward)
                terminated = spaces.flag(terminated, "terminated")
                truncated = spaces.flag(truncated, "truncated")
            except Invalid as reason:
                raise self._invalid(e, "step", reason) from None
            blocks.terminated[e] = terminated
            # A step that does both has terminated (`docs/PROTOCOL.md`).
            blocks.truncated[e] = truncated and not terminated
            if terminated or truncated:
                over.append(e)
        blocks.observations[:] = blocks.next_observations
        self._draw()
        for e in over:
            self._begin(e, blocks)

    def close(self) -> None:
        for slot in self._slots:
            slot.environment.close()

    def _begin_all(self, blocks: Blocks) -> None:
        for e in range(len(self)):
            self._begin(e, blocks)
        self._draw()

    def _draw(self) -> None:
        if self._pictures is not None:
            self._pictures.draw(self._slots[0].environment)

    def _begin(self, e: int, blocks: Blocks) -> None:
        slot = self._slots[e]
        if self._purpose is Purpose.EVALUATION:
            episode = slot.next_evaluation
            slot.over = self._end_of_evaluation is not None and episode >= self._end_of_evaluation
            if slot.over:
                blocks.observations[e] = 0
                return
            words = [self._seed, Purpose.EVALUATION, episode]
            slot.next_evaluation += len(self)
        else:
            episode = slot.next_training
            slot.over = False
            words = [self._seed, Purpose.TRAINING, self._server, self._stream, e, episode]
            slot.next_training += 1
        slot.episode, slot.steps = episode, 0
        try:
            observation = _pair(slot.environment.reset(seed=_seed_of(words)))
            self.observation.view(blocks.observations)[e] = self.observation.encode(observation)
        except Invalid as reason:
            raise self._invalid(e, "reset", reason) from None

    def _invalid(self, e: int, method: str, reason: Invalid) -> Invalid:
        """``reason``, and where the value came from."""
        purpose = "evaluation" if self._purpose is Purpose.EVALUATION else "training"
        where = f"environment {e}, {purpose} episode {self._slots[e].episode}, step {self._slots[e].steps}"
        return Invalid(f"{self._name}: {method} returned {reason} ({where})")


def _make(name: str, parameters: dict[str, Any], e: int, pictures: Pictures | None) -> gym.Env[Any, Any]:
    os.environ["SHOAL_ENVIRONMENT"] = str(e)
    if pictures is not None and e == 0:
        return pictures.make(name, parameters)
    return gym.make(name, **parameters)


def _seed_of(words: list[int]) -> int:
    return int(np.random.SeedSequence(words).generate_state(1)[0]) % SEEDS


def _seed_process(seed: int, server: int, stream: int) -> None:
    """Seeds the global generators of Python and NumPy, which an environment may use beside its own. In lockstep every
    start draws the same numbers."""
    word = _seed_of([seed, Purpose.PROCESS, server, stream])
    random.seed(word)
    np.random.seed(word)


def _pair(result: Any) -> Any:
    """The observation of what ``reset`` returns."""
    if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
        raise Invalid("something else than a pair of observation and info")
    return result[0]
