"""HTML and SVG as text in which everything is escaped that was not made here; the scales and colours of figures.

A user controls many texts of a report: names of folders, tasks, options and descriptor dimensions. `tag` escapes every
child and attribute that is not `Markup`, so markup in such a text is shown and never interpreted.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Markup(str):
    """Text that is HTML or SVG already."""

    __slots__ = ()


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """An element. A child or attribute that is None or False is left out; `class_` stands for class, `_` for `-`."""
    shown = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    return Markup(f"<{name}{shown}>" if name == "input" else f"<{name}{shown}>{joined(children)}</{name}>")


def joined(children: Iterable[object]) -> Markup:
    """Children one after another, each escaped unless it is Markup."""
    return Markup(
        "".join(
            child if isinstance(child, Markup) else html.escape(str(child))
            for child in children
            if child is not None and child is not False
        )
    )


def data_script(name: str, value: Any) -> Markup:
    """A script element that holds `value` as JSON, which the page reads by the element's id."""
    # Neither "</script>" nor "<!--" may appear in the text of a script element.
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c").replace("&", "\\u0026")
    return tag("script", Markup(text), type="application/json", id=name)


def packed(values: ArrayLike, dtype: str) -> str:
    """Numbers in base64, little-endian, rounded and clipped to an integer type such as "int16"."""
    kind = np.iinfo(dtype)
    whole = np.clip(np.rint(np.nan_to_num(np.asarray(values, np.float64))), kind.min, kind.max)
    return base64.b64encode(whole.astype(np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


MOST_COLUMNS = 6
"""Most columns beside the first of a table that must be seen as a whole, also on paper."""


def table(rows: Iterable[tuple[object, ...]], head: tuple[str, ...] = (), class_: str = "fields") -> Markup:
    """A table; the first cell of each row is its heading."""
    top = tag("thead", tag("tr", *(tag("th", text, scope="col") for text in head))) if head else None
    body = [tag("tr", tag("th", first, scope="row"), *(tag("td", cell) for cell in rest)) for first, *rest in rows]
    return tag("div", tag("table", top, tag("tbody", *body), class_=class_), class_="scroll")


def tables(rows: Sequence[tuple[object, ...]], head: tuple[str, ...], class_: str) -> Markup:
    """A table as several ones, one below the other, each with the first column and at most MOST_COLUMNS others."""
    parts = -(-(len(head) - 1) // MOST_COLUMNS)
    size = -(-(len(head) - 1) // parts)
    return joined(
        table([(row[0], *row[at : at + size]) for row in rows], (head[0], *head[at : at + size]), class_)
        for at in range(1, len(head), size)
    )


class Frame(NamedTuple):
    """A rectangle of the plane and its place in a figure in pixels; y points up in the plane, down in the figure."""

    x: tuple[float, float]
    y: tuple[float, float]
    left: float
    top: float
    width: float
    height: float

    def across(self, x: ArrayLike) -> NDArray[np.float64]:
        """Pixels from the left of the figure."""
        low, high = self.x
        return self.left + (np.asarray(x, np.float64) - low) / (high - low) * self.width

    def down(self, y: ArrayLike) -> NDArray[np.float64]:
        """Pixels from the top of the figure."""
        low, high = self.y
        return self.top + (high - np.asarray(y, np.float64)) / (high - low) * self.height


def spread(values: Iterable[ArrayLike], margin: float = 0.05) -> tuple[float, float]:
    """(low, high) around all finite values, with a margin; (0, 1) if there are none."""
    finite = np.concatenate([np.ravel(np.asarray(array, np.float64)) for array in values] or [np.zeros(0)])
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    room = (high - low) * margin or max(abs(high) * 0.1, 0.5)
    return low - room, high + room


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers between two numbers, at most `most`, at a distance of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [index * step + 0.0 for index in range(first, math.floor(high / step + 1e-9) + 1)]


def tick_text(value: float, step: float) -> str:
    """A number on an axis whose ticks are `step` apart, such as 20, 0.25 or 3M."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= size or (step >= size and value):
            unit = 1e3 if letter == "k" else size
            return f"{value / unit:.10g}{letter}"
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value:.{decimals}f}" if decimals < 7 else f"{value:.1e}"


# Colours that people with any colour vision can tell apart, and that keep their order in a grey print.
#
# Values are shown with viridis, whose lightness rises evenly (its authors put it into the public domain, CC0). Curves
# have the colours of Okabe and Ito, and differ in their dashes, too; the stylesheet has both.

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
