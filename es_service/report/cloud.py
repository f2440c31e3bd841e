"""All evaluated centres, or policies, as a cloud of points, with a slider over the generations.

The points are drawn by the page on a canvas, because there may be many; their places and colours are computed here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from es_service.errors import counted
from es_service.report import floor
from es_service.report.colours import SCALE, level, value_range
from es_service.report.data import RunData
from es_service.report.facts import number
from es_service.report.markup import Frame, Markup, packed, spread, tag

MOST_POINTS = 20_000
STOPS = 200
"""Most places of the slider."""


def cloud(data: RunData) -> tuple[Markup, dict[str, Any], tuple[float, float], str] | None:
    """The cloud of a run; None if no evaluation was valid.

    Returns:
        figure; what its script needs: `x`, `y` in tenths of a pixel and `level` (index in `colours`) in base64, and in
        `stops` [points shown, text] of each place of the slider; fitness of the first and last colour; explanation.
    """
    names, nouns = data.names, data.evaluated
    place_N_B = np.stack([data.centres[name] for name in names], axis=1)
    fitness_N, generation_N = data.centres["fitness_mean"], data.centres["generation"]
    fine_N = np.isfinite(place_N_B).all(axis=1) & np.isfinite(fitness_N)
    kept = np.flatnonzero(fine_N)
    if not kept.size:
        return None
    valid = kept.size
    if valid > MOST_POINTS:
        kept = kept[np.linspace(0, valid - 1, MOST_POINTS).astype(int)]
    place_N_B, fitness_N, generation_N = place_N_B[kept], fitness_N[kept], generation_N[kept]
    x_N = place_N_B[:, 0]
    if len(names) == 1:
        y_N, labels = fitness_N, (names[0], "fitness")
        frame = Frame(data.bounds[0], spread([fitness_N]), floor.LEFT, floor.TOP, floor.WIDTH - 62, 320)
    else:
        y_N, labels = place_N_B[:, 1], (names[0], names[1])
        frame = floor.plan_frame(data.bounds[:2])
    (x_low, x_high), (y_low, y_high) = frame.x, frame.y
    colours = value_range(fitness_N)
    width, height = floor.size(frame)
    walls = floor.walls_and_goal(frame, data.task) if len(names) == 2 else None
    box = f"0 0 {width:.0f} {height:.0f}"
    figure = tag(
        "div",
        tag("svg", floor.ground(frame, labels), viewBox=box, role="img", aria_label=f"Evaluated {nouns[1]}"),
        tag("canvas", width=2 * round(width), height=2 * round(height), id="cloud"),
        tag("svg", walls, viewBox=box, class_="above"),
        class_="layers",
    )
    ends = np.unique(np.linspace(0, generation_N[-1], STOPS).astype(int))
    counts = np.searchsorted(generation_N, ends, side="right").tolist()
    points = {
        "x": packed(10 * frame.across(np.clip(x_N, x_low, x_high)), "int16"),
        "y": packed(10 * frame.down(np.clip(y_N, y_low, y_high)), "int16"),
        "level": packed(level(fitness_N, *colours), "int8"),
        "colours": SCALE,
        "stops": [
            [count, f"generation {end:,}: {counted(count, *nouns)}, best {number(best)}"]
            for end, count, best in zip(ends.tolist(), counts, _best_until(fitness_N, counts), strict=True)
        ],
    }
    which = f"Each point is an evaluated {nouns[0]}, at its mean descriptor"
    more = f"; {len(kept):,} of {valid:,} are shown, at equal distances" if valid > len(kept) else ""
    also = f", in the first two of {len(names)} dimensions" if len(names) > 2 else ""
    return figure, points, colours, f"{which}{also}; the colour is its fitness{more}."


def _best_until(fitness_N: np.ndarray, counts: list[int]) -> list[float]:
    best_N = np.maximum.accumulate(fitness_N)
    return [float(best_N[count - 1]) if count else float("nan") for count in counts]
