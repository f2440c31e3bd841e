"""Random shapes and numbers, for random functions of primitives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

LANES = 21
Case = tuple[Callable[..., Any], list[np.ndarray]]
"""(function of one lane, arguments [lane, ...])."""
Draw = Callable[..., Any]


def floats(draw: Draw, shape: tuple[int, ...], low: float = -3.0, high: float = 3.0) -> np.ndarray:
    """Ordinary numbers, and now and then the same one twice."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    x = rng.uniform(low, high, (LANES, *shape)).astype(np.float32)
    return np.where(rng.random(x.shape) < 0.1, np.float32(min(max(1.0, low), high)), x)


def special(draw: Draw, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers among which are zeros of both signs, infinities and NaN."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    pool = np.array([0.0, -0.0, 1.0, -1.0, 2.5, np.inf, -np.inf, np.nan, 1e30], np.float32)
    return rng.choice(pool, (LANES, *shape))


def integers(draw: Draw, shape: tuple[int, ...], dtype: str = "int32") -> np.ndarray:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    wide = rng.integers(0, 2**32, (LANES, *shape)).astype(np.uint32)
    return np.where(rng.random(wide.shape) < 0.5, wide, wide % 7).astype(np.uint32).view(dtype)


def booleans(draw: Draw, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(draw(st.integers(0, 2**32 - 1))).random((LANES, *shape)) < 0.5


def shape(draw: Draw, least: int = 0, most: int = 3) -> tuple[int, ...]:
    return tuple(draw(st.lists(st.integers(1, 4), min_size=least, max_size=most)))
