"""Colours that people with any colour vision can tell apart, and that keep their order in a grey print.

Values are shown with viridis, whose lightness rises evenly (its authors put it into the public domain, CC0). Curves
have the colours of Okabe and Ito, and differ in their dashes, too; the stylesheet has both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

_VIRIDIS = (
    "440154", "481a6c", "472f7d", "414487", "39568c", "31688e", "2a788e", "23888e",
    "1f988b", "22a884", "35b779", "54c568", "7ad151", "a5db36", "d2e21b", "fde725",
)  # fmt: skip
LEVELS = 32
"""Number of colours of the scale of values."""


def _levels() -> tuple[str, ...]:
    anchors = np.array([[int(colour[i : i + 2], 16) for i in (0, 2, 4)] for colour in _VIRIDIS], float)
    places = np.linspace(0, len(anchors) - 1, LEVELS)
    channels = [np.interp(places, np.arange(len(anchors)), channel) for channel in anchors.T]
    return tuple("#" + "".join(f"{round(value):02x}" for value in rgb) for rgb in zip(*channels, strict=True))


SCALE = _levels()
"""The colours of values, from low to high."""


def level(values: ArrayLike, low: float, high: float) -> np.ndarray:
    """Index in SCALE of each value between `low` and `high`; values beyond them get the first or last colour."""
    share = (np.asarray(values, float) - low) / ((high - low) or 1.0)
    return np.clip(np.nan_to_num(share) * LEVELS, 0, LEVELS - 1).astype(np.int64)


def value_range(values: ArrayLike) -> tuple[float, float]:
    """Values between which colours are spread: all but the lowest hundredth, so that one bad value hides no others."""
    finite = np.asarray(values, float)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(np.quantile(finite, 0.01)), float(finite.max())
    return (low, high) if low < high else (low - 0.5, high + 0.5)
