"""How the elements of Gymnasium's spaces become numbers and back."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Unsupported(Exception):
    """What cannot be served."""


class Box:
    """A box of any shape; its elements travel flattened."""

    discrete = 0

    def __init__(self, space: gym.spaces.Box) -> None:
        self._space = space
        self._shape: tuple[int, ...] = tuple(space.shape)
        self.width = int(np.prod(self._shape))

    def bounds(self) -> list[NDArray[np.float32]]:
        """Least and greatest values, as they are said of oneself."""
        return [np.asarray(b, dtype=np.float32).reshape(-1) for b in (self._space.low, self._space.high)]

    def view(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """``block``, ``width`` numbers for each environment, with an element of the space for each."""
        return block.reshape(len(block), *self._shape)

    def number(self, element: Any) -> Any:
        """What stands for an element in such a view."""
        return element

    def elements(self, numbers: NDArray[np.float32]) -> NDArray[Any]:
        """The elements that ``width`` numbers each stand for, in memory of their own. ``ValueError`` for none."""
        if not np.isfinite(numbers).all():
            raise ValueError(f"{numbers} are not finite")
        return numbers.astype(self._space.dtype).reshape(-1, *self._shape)


class Discrete:
    """Indices, counted from 0 on the way."""

    width = 1

    def __init__(self, space: gym.spaces.Discrete) -> None:
        self.discrete = int(space.n)
        self._start = int(space.start)

    def bounds(self) -> list[NDArray[np.float32]]:
        """Nothing: how many there are says everything."""
        return []

    def view(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """``block`` with a number for each environment."""
        return block.reshape(len(block))

    def number(self, element: Any) -> int:
        """What stands for an element in such a view."""
        return int(element) - self._start

    def elements(self, numbers: NDArray[np.float32]) -> NDArray[Any]:
        """The elements that the numbers stand for. ``ValueError`` for none."""
        indices = numbers.astype(np.int64)
        if (indices != numbers).any() or (indices < 0).any() or (indices >= self.discrete).any():
            raise ValueError(f"{numbers} are no indices below {self.discrete}")
        return indices + self._start


def served(space: gym.Space[Any], what: str) -> Box | Discrete:
    """How a space is served; ``what`` is whose elements: of observations or of actions."""
    if isinstance(space, gym.spaces.Discrete):
        return Discrete(space)
    if isinstance(space, gym.spaces.Box):
        return Box(space)
    raise Unsupported(f"its {what} are {space}, and only Box and Discrete can be served")
