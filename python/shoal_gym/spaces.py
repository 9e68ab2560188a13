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

    def view(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """``block``, ``width`` numbers for each environment, with an element of the space for each."""
        return block.reshape(len(block), *self.space.shape)

    def number(self, element: Any) -> Any:
        """What stands for an element in such a view."""
        return int(element) - int(self.space.start) if self.discrete else element

    def elements(self, numbers: NDArray[np.float32]) -> NDArray[Any]:
        """The elements that ``width`` numbers each stand for, in memory of their own. ``ValueError`` for what is none."""
        if self.discrete:
            indices = numbers.astype(self.space.dtype)
            if (indices != numbers).any() or (indices < 0).any() or (indices >= self.discrete).any():
                raise ValueError(f"{numbers} are no indices below {self.discrete}")
            return indices + self.space.start
        if not np.isfinite(numbers).all():
            raise ValueError(f"{numbers} are not finite")
        return numbers.astype(self.space.dtype).reshape(-1, *self.space.shape)
