"""How the elements of Gymnasium's spaces become numbers and back, and what is not an element at all."""

from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Unsupported(Exception):
    """An environment that cannot be served."""


class Invalid(Exception):
    """An environment returned something that its spaces, or Gymnasium's interface, do not allow."""


class Box:
    """A box of any shape; its elements travel flattened."""

    discrete = 0
    start = 0

    def __init__(self, space: gym.spaces.Box) -> None:
        self._space = space
        self._shape: tuple[int, ...] = tuple(space.shape)
        self._integers = np.issubdtype(space.dtype, np.integer)
        self.width = int(np.prod(self._shape))

    def bounds(self) -> list[NDArray[np.float32]]:
        """Least and greatest values, as a description of the space has them."""
        return [np.asarray(b, dtype=np.float32).reshape(-1) for b in (self._space.low, self._space.high)]

    def view(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """``block``, ``width`` numbers for each environment, with an element of the space for each."""
        return block.reshape(len(block), *self._shape)

    def encode(self, element: Any) -> NDArray[np.float32]:
        """What represents an element in such a view. Raises ``Invalid`` for what is no element."""
        array = _array(element)
        if array.shape != self._shape:
            raise Invalid(f"an observation of shape {array.shape}, and its space has shape {self._shape}")
        if array.dtype.kind not in "biuf":
            raise Invalid(f"an observation of {array.dtype} instead of numbers")
        with np.errstate(over="ignore"):
            converted = array.astype(np.float32)
        if not np.isfinite(converted).all():
            at = int(np.flatnonzero(~np.isfinite(converted))[0])
            raise Invalid(f"an observation whose number {at} is {array.reshape(-1)[at]}, which is not finite as a 32-bit float")
        return converted

    def decode(self, numbers: NDArray[np.float32]) -> NDArray[Any]:
        """The elements that ``width`` numbers each represent, within the bounds and in memory of their own. Raises
        ``ValueError`` for numbers that represent none."""
        if not np.isfinite(numbers).all():
            raise ValueError(f"{numbers} are not finite")
        elements = numbers.astype(np.float64).reshape(-1, *self._shape)
        if self._integers:
            elements = np.rint(elements)
        # The last clip is in the type of the space: a bound such as 0.05 is another number in 64 bits than in the 32
        # bits of a response.
        low, high = self._space.low, self._space.high
        inside = np.clip(elements, low.astype(np.float64), high.astype(np.float64)).astype(self._space.dtype)
        return np.clip(inside, low, high)


class Discrete:
    """Indices, counted from 0 on the way."""

    width = 1

    def __init__(self, space: gym.spaces.Discrete) -> None:
        self.discrete = int(space.n)
        self.start = int(space.start)

    def bounds(self) -> list[NDArray[np.float32]]:
        """Where it begins to count."""
        return [np.asarray([self.start], dtype=np.float32)]

    def view(self, block: NDArray[np.float32]) -> NDArray[np.float32]:
        """``block`` with a number for each environment."""
        return block.reshape(len(block))

    def encode(self, element: Any) -> int:
        """What represents an element in such a view. Raises ``Invalid`` for what is no element."""
        array = _array(element)
        if array.shape != () or array.dtype.kind not in "iuf" or not np.isfinite(array) or array != np.rint(array):
            raise Invalid(f"the observation {_short(element)}, and its space has integers")
        index = int(array) - self.start
        if not 0 <= index < self.discrete:
            last = self.start + self.discrete - 1
            raise Invalid(f"the observation {int(array)}, and its space has {self.start} to {last}")
        return index

    def decode(self, numbers: NDArray[np.float32]) -> NDArray[Any]:
        """The elements that the numbers represent. Raises ``ValueError`` for numbers that represent none."""
        indices = numbers.astype(np.int64)
        if (indices != numbers).any() or (indices < 0).any() or (indices >= self.discrete).any():
            raise ValueError(f"{numbers} are no indices below {self.discrete}")
        return indices + self.start


def codec_of(space: gym.Space[Any], what: str) -> Box | Discrete:
    """How a space is served; ``what`` is whose elements: of observations or of actions."""
    if isinstance(space, gym.spaces.Discrete):
        return Discrete(space)
    if isinstance(space, gym.spaces.Box):
        return Box(space)
    raise Unsupported(f"its {what} are {space}, and only Box and Discrete can be served")


def reward(value: Any) -> float:
    """A reward as a number. Raises ``Invalid`` for what is none."""
    number = value.item() if isinstance(value, np.generic | np.ndarray) and value.ndim == 0 else value
    if not isinstance(number, Real):
        raise Invalid(f"a reward that is {_short(value)} instead of a number")
    try:
        with np.errstate(over="ignore"):
            finite = bool(np.isfinite(np.float32(number)))
    except OverflowError:
        finite = False
    if not finite:
        raise Invalid(f"a reward that is {_short(number)}, which is not finite as a 32-bit float")
    return float(number)


def flag(value: Any, what: str) -> bool:
    """``terminated`` or ``truncated`` as a boolean. Raises ``Invalid`` for what is none."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, np.ndarray) and value.shape == () and value.dtype == np.bool_:
        return bool(value)
    if isinstance(value, int | np.integer) and value in (0, 1):
        return bool(value)
    raise Invalid(f"{what} that is {_short(value)} instead of a boolean")


def _array(element: Any) -> NDArray[Any]:
    """An observation as an array. Raises ``Invalid`` for what cannot be one, such as lists of different lengths."""
    try:
        return np.asarray(element)
    except (ValueError, TypeError, OverflowError) as error:
        raise Invalid(f"the observation {_short(element)}, which is no array of numbers") from error


def _short(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except ValueError:
        # Python writes no integer of more than 4,300 digits.
        text = f"a long {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."
