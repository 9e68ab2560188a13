"""How the elements of Gymnasium's spaces become numbers and back."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Unsupported(Exception):
    """A space that cannot be served."""


@dataclass(frozen=True)
class Space:
    """A ``Box``, flattened, or a ``Discrete``, counted from 0. Every element travels as ``width`` numbers."""

    space: gym.spaces.Box | gym.spaces.Discrete
    width: int
    discrete: int
    """How many values there are; 0 for a box."""

    @classmethod
    def of(cls, space: gym.Space, what: str) -> "Space":
        """``what`` is whose elements: of observations or of actions."""
        if isinstance(space, gym.spaces.Discrete):
            return cls(space, 1, int(space.n))
        if isinstance(space, gym.spaces.Box) and space.shape is not None:
            return cls(space, int(np.prod(space.shape)), 0)
        raise Unsupported(f"its {what} are {space}, and only Box and Discrete can be served")

    def bounds(self) -> list[NDArray[np.float32]]:
        """Least and greatest values of a box; nothing for a discrete space."""
        if self.discrete:
            return []
        return [np.asarray(b, dtype=np.float32).reshape(-1) for b in (self.space.low, self.space.high)]

    def write(self, element: Any, numbers: NDArray[np.float32]) -> None:
        """Writes an element as ``width`` numbers."""
        if self.discrete:
            numbers[0] = int(element) - int(self.space.start)
        else:
            numbers[:] = np.reshape(element, -1)

    def read(self, numbers: NDArray[np.float32]) -> Any:
        """The element that ``width`` numbers stand for, in memory of its own. ``ValueError`` for what is none."""
        if self.discrete:
            index = int(numbers[0])
            if index != numbers[0] or not 0 <= index < self.discrete:
                raise ValueError(f"{numbers[0]} is no index below {self.discrete}")
            return self.space.dtype.type(index + self.space.start)
        if not np.isfinite(numbers).all():
            raise ValueError(f"{numbers} is not finite")
        return np.array(numbers, dtype=self.space.dtype).reshape(self.space.shape)
