"""Parameters of a function that is a task: their names, bounds and start, and the numbers that a search moves.

Axis: D parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import Domain, stream_keys, uniforms

FREE = (-1e300, 1e300)
"""Bounds of a parameter that has none."""


class ParameterSpec(NamedTuple):
    """Parameters of a function, in their order."""

    names: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...]
    """(low, high), or FREE."""
    start: tuple[float, ...]
    """Where a search starts, in the units of the function."""

    @staticmethod
    def from_fields(names: Any, bounds: Any, start: Any) -> ParameterSpec:
        """The parameters from their fields as JSON has them."""
        pairs = tuple((float(low), float(high)) for low, high in bounds)
        return ParameterSpec(tuple(names), pairs, tuple(map(float, start)))

    def named(self, searched: Any) -> dict[str, float]:
        """Parameters of what a search moves, [D], by name."""
        return dict(zip(self.names, self.values(searched).tolist(), strict=True))

    def text(self, searched: Any, most: int | None = None) -> str:
        """Names and values of what a search moves, [D], such as `width = 0.3, height = 1.0`.

        Args:
            most: how many of them are shown; None for all.
        """
        named = [f"{name} = {value!r}" for name, value in self.named(searched).items()]
        left = 0 if most is None else len(named) - most
        return ", ".join(named[:most]) + (f" and {left} more" if left > 0 else "")

    def values(self, searched: Any) -> NDArray[np.float64]:
        """Parameters [..., D] of what a search moves: -1 and 1 stand for the bounds, at which is put what is beyond."""
        low_D, high_D, middle_D, half_D = self._scales()
        return np.clip(middle_D + half_D * np.asarray(searched, np.float64), low_D, high_D)

    def first(self, seed: int, centre: int) -> NDArray[np.float32]:
        """What a search moves, as a centre of it begins: the first one at the start, and the others anywhere between
        the bounds, or within 1 of the start where there are none."""
        low_D, _, middle_D, half_D = self._scales()
        start_D = (np.asarray(self.start) - middle_D) / half_D
        if centre == 0:
            return start_D.astype(np.float32)
        key = stream_keys(seed, Domain.INITIALISATION, 0, centre)
        drawn_D = 2.0 * uniforms(key, np.arange(len(self.names), dtype=np.uint32)).astype(np.float64) - 1.0
        return np.where(low_D == FREE[0], start_D + drawn_D, drawn_D).astype(np.float32)

    def _scales(self) -> tuple[NDArray[np.float64], ...]:
        """Lower and upper bounds, their middles, and half of the distances between them; 0 and 1 if there are none."""
        low_D, high_D = np.asarray(self.bounds, np.float64).reshape(-1, 2).T
        is_free_D = low_D == FREE[0]
        return (
            low_D,
            high_D,
            np.where(is_free_D, 0.0, 0.5 * low_D + 0.5 * high_D),
            np.where(is_free_D, 1.0, 0.5 * high_D - 0.5 * low_D),
        )
