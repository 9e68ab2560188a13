"""A vector of Gymnasium environments of one kind, with autoreset and an episode's seed for every counter."""

import enum
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from .spaces import Unsupported, served


class Purpose(enum.IntEnum):
    """What an episode is for; part of its seed."""

    TRAINING = 1
    EVALUATION = 2


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


class Environments:
    """``count`` environments, each in its own episode.

    Training episode k of environment e is seeded by (seed, server, stream, e, k), evaluation episode k by (seed, k): an
    episode is reached by its counters, whatever was run before.
    """

    def __init__(
        self, name: str, parameters: dict[str, Any], count: int, seed: int, server: int, stream: int
    ) -> None:
        parameters = {"disable_env_checker": True, **parameters}
        self._environments = [gym.make(name, **parameters) for _ in range(count)]
        first = self._environments[0]
        self.observation = served(first.observation_space, "observations")
        self.action = served(first.action_space, "actions")
        limit = first.spec.max_episode_steps if first.spec else None
        if limit is None:
            raise Unsupported(
                "it has no time limit: give one, as with --set environment.max_episode_steps=1000"
            )
        self.time_limit = int(limit)
        self._seed, self._server, self._stream = seed, server, stream
        self._purpose = Purpose.TRAINING
        self._next_training = [0] * count
        self._next_evaluation = [0] * count

    def __len__(self) -> int:
        return len(self._environments)

    def begin_next(self, blocks: Blocks) -> None:
        """Each environment begins its next training episode."""
        self._purpose = Purpose.TRAINING
        self._begin_all(blocks)

    def begin_training(self, episode: int, blocks: Blocks) -> None:
        """Each environment begins this training episode of its own, and counts on from there."""
        self._next_training = [episode] * len(self)
        self.begin_next(blocks)

    def begin_evaluation(self, first: int, blocks: Blocks) -> None:
        """Environment e begins evaluation episode ``first`` + e; at its end it goes on with the one ``len(self)`` later."""
        self._purpose = Purpose.EVALUATION
        self._next_evaluation = [first + e for e in range(len(self))]
        self._begin_all(blocks)

    def step(self, actions: NDArray[np.float32], blocks: Blocks) -> None:
        """Every environment takes a step; ``ValueError``, and nothing done, where an action is none."""
        chosen = self.action.elements(actions)
        next_observations = self.observation.view(blocks.next_observations)
        over = []
        for e, (environment, action) in enumerate(zip(self._environments, chosen, strict=True)):
            observation, reward, terminated, truncated, _ = environment.step(action)
            next_observations[e] = self.observation.number(observation)
            blocks.rewards[e] = reward
            blocks.terminated[e] = terminated
            # A terminal state is one, at whatever step it is reached.
            blocks.truncated[e] = truncated and not terminated
            if terminated or truncated:
                over.append(e)
        blocks.observations[:] = blocks.next_observations
        for e in over:
            self._begin(e, blocks)

    def close(self) -> None:
        for environment in self._environments:
            environment.close()

    def _begin_all(self, blocks: Blocks) -> None:
        for e in range(len(self)):
            self._begin(e, blocks)

    def _begin(self, e: int, blocks: Blocks) -> None:
        if self._purpose is Purpose.EVALUATION:
            words = [self._seed, Purpose.EVALUATION, self._next_evaluation[e]]
            self._next_evaluation[e] += len(self)
        else:
            words = [self._seed, Purpose.TRAINING, self._server, self._stream, e, self._next_training[e]]
            self._next_training[e] += 1
        seed = int(np.random.SeedSequence(words).generate_state(1)[0])
        observation, _ = self._environments[e].reset(seed=seed)
        self.observation.view(blocks.observations)[e] = self.observation.number(observation)
