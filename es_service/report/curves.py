"""Charts as SVG, each once for every axis that it can be drawn against, with the text that a pointer shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.report.markup import Frame, Markup, joined, spread, table, tag, tick_text, ticks
from es_service.report.series import X_AXES, Chart, lone
from es_service.report.summary import number

WIDTH, HEIGHT = 560, 250
STYLES = 7
"""Number of styles of curves in the stylesheet; more curves use them again."""
DOT_RADIUS = 3
"""In pixels; of a point without neighbours, which no line shows."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 10, 40


def draw_charts(
    charts: Sequence[Chart], x_axes: Mapping[str, NDArray[np.float64]]
) -> tuple[list[Markup], list[dict[str, Any]]]:
    """Charts whose points have the places of `x_axes` (column of X_AXES -> [K]), the same ones on every axis.

    Returns:
        figures; what the script needs of each: in `axes` column of X_AXES -> pixels across of each point, and in
        `texts` the same -> what is shown at each point, or under "" what is shown on all axes.
    """
    figures, points = [], []
    for chart in charts:
        figure, axes = draw({column: (chart, x_K) for column, x_K in x_axes.items()})
        texts = [
            f"generation {x_axes['generation'][k]:,.0f}: {values_text(chart, k)}"
            for k in range(len(x_axes["generation"]))
        ]
        figures.append(figure)
        points.append({"axes": axes, "texts": {"": texts}})
    return figures, points


def draw(chart_on: Mapping[str, tuple[Chart, NDArray[np.float64]]]) -> tuple[Markup, dict[str, list[float]]]:
    """A figure with a chart for each axis, of which the page shows one, and the pixels across of its points.

    Args:
        chart_on: column of X_AXES -> the chart on this axis and the places of its points, [K].
    """
    figures, axes = [], {}
    for column, (chart, x_K) in chart_on.items():
        label, scale = X_AXES[column], _scale(chart)
        frame = Frame(_x_range(x_K), _y_range(chart), _LEFT, _TOP, WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM)
        content = [axis_lines(frame, label, "%" if chart.percent else "")]
        if chart.band is not None:
            content.append(tag("path", d=area(frame, x_K, scale * chart.band[1], scale * chart.band[2]), class_="band"))
        for index, line in enumerate(chart.lines):
            if line.range_K is not None:
                low_K, high_K = (scale * values for values in line.range_K)
                content.append(tag("path", d=area(frame, x_K, low_K, high_K), class_=f"fill range s{index % STYLES}"))
        for index, line in enumerate(chart.lines):
            y_K, style = scale * line.y_K, f"s{index % STYLES}"
            lone_K = lone(x_K, y_K)
            content.append(tag("path", d=line_path(frame, x_K, y_K), class_=f"line {style}"))
            content += [
                tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=DOT_RADIUS, class_=f"fill {style}")
                for x, y in zip(frame.across(x_K[lone_K]), frame.down(y_K[lone_K]), strict=True)
            ]
        content.append(tag("line", class_="pointer", y1=_TOP, y2=HEIGHT - _BOTTOM))
        box, name = f"0 0 {WIDTH} {HEIGHT}", f"{chart.title} against {label}"
        figures.append(tag("svg", *content, viewBox=box, role="img", aria_label=name, class_=f"x x-{column}"))
        axes[column] = np.round(frame.across(x_K), 1).tolist()
    chart = next(iter(chart_on.values()))[0]
    legend = [_key(f"s{index % STYLES}", line.label) for index, line in enumerate(chart.lines)]
    if chart.band is not None:
        legend.append(tag("span", tag("i", class_="swatch"), chart.band[0], class_="key"))
    figure = tag(
        "figure",
        tag("figcaption", tag("b", chart.title), " ", tag("span", chart.note, class_="note")),
        tag("div", *figures, class_="plot"),
        tag("div", *legend, class_="legend"),
        class_="chart",
    )
    return figure, axes


def values_text(chart: Chart, k: int) -> str:
    """Values of all curves at a point, with their ranges."""
    scale, unit = _scale(chart), " %" if chart.percent else ""
    shown = []
    for line in chart.lines:
        text = f"{line.label} {number(scale * float(line.y_K[k]))}{unit}"
        if line.range_K is not None:
            text += " ({} to {})".format(*(number(scale * float(values[k])) for values in line.range_K))
        shown.append(text)
    return "; ".join(shown)


def _scale(chart: Chart) -> float:
    return 100.0 if chart.percent else 1.0


def _x_range(x_K: NDArray[np.float64]) -> tuple[float, float]:
    first, last = float(np.nanmin(x_K)), float(np.nanmax(x_K))
    return min(0.0, first), last if last > first else first + 1.0  # generation 0 alone must have some width, too


def _y_range(chart: Chart) -> tuple[float, float]:
    shown = [line.y_K for line in chart.lines] + [values for line in chart.lines for values in line.range_K or ()]
    low, high = spread([_scale(chart) * values for values in (*shown, *(chart.band[1:] if chart.band else ()))])
    return (0.0, min(100.0, high) if high > 0 else 1.0) if chart.percent else (low, high)


def axis_lines(frame: Frame, label: str, unit: str = "") -> Markup:
    """Grid lines, tick labels, and the label of the horizontal axis."""
    content = []
    bottom, right = frame.top + frame.height, frame.left + frame.width
    across, up = ticks(*frame.x, most=6), ticks(*frame.y, most=5)
    for value in up:
        y = f"{float(frame.down(value)):.1f}"
        text = tick_text(value, _step(up)) + unit
        content.append(tag("line", x1=frame.left, x2=right, y1=y, y2=y, class_="grid"))
        content.append(tag("text", text, x=frame.left - 6, y=y, dy="0.32em", class_="tick end"))
    for value in across:
        x = f"{float(frame.across(value)):.1f}"
        content.append(tag("line", x1=x, x2=x, y1=bottom, y2=bottom + 4, class_="axis"))
        content.append(tag("text", tick_text(value, _step(across)), x=x, y=bottom + 16, class_="tick middle"))
    content.append(tag("line", x1=frame.left, x2=right, y1=bottom, y2=bottom, class_="axis"))
    content.append(tag("text", label, x=frame.left + frame.width / 2, y=bottom + 33, class_="label middle"))
    return joined(content)


def _step(values: list[float]) -> float:
    return values[1] - values[0] if len(values) > 1 else abs(values[0]) if values and values[0] else 1.0


def line_path(frame: Frame, x_K: NDArray[np.float64], y_K: NDArray[np.float64]) -> str:
    """Path through points, with gaps where a value is missing; see `series.lone` for points between two gaps."""
    across, down = frame.across(x_K), frame.down(y_K)
    commands, drawing = [], False
    for x, y in zip(across, down, strict=True):
        if not (np.isfinite(x) and np.isfinite(y)):
            drawing = False
            continue
        commands.append(f"L{x:.1f} {y:.1f}" if drawing else f"M{x:.1f} {y:.1f}")
        drawing = True
    return "".join(commands)


def area(frame: Frame, x_K: NDArray[np.float64], low_K: NDArray[np.float64], high_K: NDArray[np.float64]) -> str:
    """Closed path around the region between two curves, without the points where one is missing."""
    fine_K = np.isfinite(low_K) & np.isfinite(high_K)
    if not fine_K.any():
        return ""
    across = frame.across(x_K[fine_K])
    points = [*zip(across, frame.down(high_K[fine_K]), strict=True)]
    points += reversed([*zip(across, frame.down(low_K[fine_K]), strict=True)])
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"


def _key(class_: str, label: str) -> Markup:
    mark = tag("svg", tag("path", d="M0 5h26", class_=f"line {class_}"), viewBox="0 0 26 10", class_="mark")
    return tag("span", mark, label, class_="key")


def phase_figure(
    seconds: Mapping[str, float], x_K: NDArray[np.float64], curves: Mapping[str, NDArray[np.float64]]
) -> Markup:
    """Where the time went: a bar of all phases, their table, and the time of a generation in the course of the run."""
    total = sum(seconds.values()) or 1.0
    bar, start = [], 0.0
    for index, (label, value) in enumerate(seconds.items()):
        width = 100 * value / total
        bar.append(tag("rect", tag("title", f"{label}: {width:.1f} %"), x=f"{start:.3f}%", width=f"{width:.3f}%",
                       height=26, class_=f"fill s{index}"))  # fmt: skip
        start += width
    rows = [
        (tag("span", tag("i", class_=f"dot s{index}"), label), f"{value:,.1f} s", f"{100 * value / total:.1f} %")
        for index, (label, value) in enumerate(seconds.items())
    ]
    sums, below = [], np.zeros(x_K.size)
    for values in curves.values():
        sums.append((below, below + 1e3 * values))
        below = below + 1e3 * values
    # Slow generations, such as the first two, which compile, must not flatten all others.
    top = min(3.0 * float(np.median(below)), 1.05 * float(below.max())) if below.size else 1.0
    caption = f"Milliseconds of a generation, by phase{'; higher peaks are cut off' if (below > top).any() else ''}"
    first, last = (float(x_K[0]), float(x_K[-1])) if x_K.size else (0.0, 1.0)
    frame = Frame((first, last if last > first else first + 1.0), (0.0, top or 1.0), _LEFT, _TOP,
                  WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM)  # fmt: skip
    layers = [
        tag("path", d=area(frame, x_K, np.minimum(low, frame.y[1]), np.minimum(high, frame.y[1])), class_=f"fill s{i}")
        for i, (low, high) in enumerate(sums)
    ]
    chart = tag("svg", *layers, axis_lines(frame, "generation"), viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img",
                aria_label="Milliseconds of a generation")  # fmt: skip
    return joined(
        [
            tag("svg", *bar, class_="bar", height=26, width="100%", role="img", aria_label="Shares of the time"),
            tag(
                "div",
                table(rows, ("phase", "seconds", "share"), "numbers"),
                tag("figure", tag("figcaption", caption), chart, class_="chart"),
                class_="columns",
            ),
        ]
    )
