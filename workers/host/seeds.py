"""Seeds of resets for the generators of users, and a generator with the noise of this project."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import NORMAL_STD, normal_integers, uniforms


def seed_of(reset_key_4: NDArray[np.uint32]) -> int:
    """The seed of a reset, a whole number below 2^31, which every generator accepts, from its stream key."""
    return int(reset_key_4[0]) >> 1


class KeyedGenerator(np.random.Generator):
    """A generator of NumPy whose uniform and normal variates are those of a stream, one coordinate after another.

    An environment that draws its start with it has the start of a task in JAX that draws the same variates of the key
    in the same order. Other methods draw from PCG64 with the seed of the key, as do calls with further arguments.
    """

    def __init__(self, reset_key_4: NDArray[np.uint32]) -> None:
        super().__init__(np.random.PCG64(seed_of(reset_key_4)))
        self._key, self._next = reset_key_4, 0

    def random(self, size: Any = None, *more: Any, **named: Any) -> Any:
        """Uniform variates in [0, 1)."""
        if more or named:
            return super().random(size, *more, **named)
        return self._drawn(uniforms, size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Uniform variates in [low, high)."""
        shape = np.broadcast_shapes(np.shape(low), np.shape(high)) if size is None else size
        return low + (np.asarray(high) - low) * self._drawn(uniforms, shape or None)

    def standard_normal(self, size: Any = None, *more: Any, **named: Any) -> Any:
        """Standard normal variates."""
        if more or named:
            return super().standard_normal(size, *more, **named)
        return self._drawn(lambda key, at: normal_integers(np, key, at) / NORMAL_STD, size)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal variates."""
        shape = np.broadcast_shapes(np.shape(loc), np.shape(scale)) if size is None else size
        return loc + scale * self.standard_normal(shape or None)

    def _drawn(self, variates: Any, size: Any) -> Any:
        """Variates at the next coordinates: a number, or an array of the shape `size`."""
        count = 1 if size is None else int(np.prod(size))
        coordinate = np.arange(self._next, self._next + count, dtype=np.uint32)
        self._next += count
        drawn = np.asarray(variates(self._key, coordinate), np.float64)
        return float(drawn[0]) if size is None else drawn.reshape(size)
