"""Progress of a run: a table that changes in place on a terminal and in a notebook; elsewhere, also with TERM=dumb, at
most one plain line per second. The consoles are the caller's, and print text as it is."""

from __future__ import annotations

import importlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich import get_console
from rich.console import Console, Group, RenderableType
from rich.jupyter import JupyterMixin
from rich.live import Live
from rich.table import Table
from rich.text import Text

from es_service.errors import decimals
from es_service.loop.history import Row, evaluated_word

ShowRow = Callable[[Row], None]
ShowNotice = Callable[[str], None]
TABLE_ROWS = 12
ROWS_AROUND = 9
"""Screen lines needed for the table's frame, its title and the line below it."""
RATE_WINDOW = 20
"""Generations over which steps per second are averaged for display."""
NOTEBOOK_S = 0.2
"""Least time between two changes of the table in a notebook, in seconds."""
_PARTS = ("rollout", "gradient", "evaluation", "driver", "store")


@contextmanager
def show_progress(console: Console, errors: Console, title: str) -> Iterator[tuple[ShowRow, ShowNotice]]:
    """Yield two functions: one to call with every history row, one with every notice."""
    if not console.is_terminal or console.is_dumb_terminal:  # a dumb terminal cannot redraw a table
        yield _plain_lines(console), partial(print_notice, errors)
        return
    recent: deque[Row] = deque(maxlen=RATE_WINDOW)
    with Live(Text(f"{title}: starting workers"), console=console, refresh_per_second=5) as live:

        def show(row: Row) -> None:
            recent.append(row)
            live.update(live_table(title, recent, console.width, console.height))

        yield show, partial(print_notice, live.console)  # notices appear above the table


def in_notebook() -> bool:
    """Whether this program is the kernel of a notebook."""
    return Console().is_jupyter


@contextmanager
def show_in_notebook(title: str) -> Iterator[ShowRow]:
    """Yield a function to call with every history row; it changes a table in the output of the notebook's cell."""
    recent: deque[Row] = deque(maxlen=RATE_WINDOW)
    waiting = _InNotebook(Text(f"{title}: starting workers"))
    output, shown_s = importlib.import_module("IPython.display").display(waiting, display_id=True), -math.inf

    def update() -> None:
        table = live_table(title, recent, get_console().width, TABLE_ROWS + ROWS_AROUND) if recent else None
        output.update(_InNotebook(table or Text(f"{title}: no generation was run")))

    def show(row: Row) -> None:
        nonlocal shown_s
        recent.append(row)
        if (now := time.monotonic()) - shown_s >= NOTEBOOK_S:
            shown_s = now
            update()

    try:
        yield show
    finally:
        update()


class _InNotebook(JupyterMixin):
    """Something that a notebook shows as HTML."""

    def __init__(self, content: RenderableType) -> None:
        self._content = content

    def __rich__(self) -> RenderableType:
        return self._content


def print_notice(console: Console, notice: str) -> None:
    console.print(f"note: {notice}", soft_wrap=True)


def _spread(std: float) -> str:
    """The spread of a mean; empty for 0, that of a single episode or of equal ones."""
    return f" ± {decimals(std)}" if std else ""


def live_table(title: str, recent: deque[Row], width: int, height: int) -> Group:
    """Table of the last generations, and their time by part; fewer columns and rows on a small screen."""
    evaluated = f"{evaluated_word(recent[-1])} fitness"
    columns: dict[str, Callable[[Row], str]] = {
        "generation": lambda row: str(row["generation"]),
        evaluated: lambda row: decimals(row["centre_fitness_mean"]) + _spread(row["centre_fitness_std"]),
        "best so far": lambda row: decimals(row["best_fitness"]),
        "env steps": lambda row: short(row["env_steps"]),
        "steps/s": lambda row: short(row["steps_per_second"]),
        "population median": lambda row: _number(row["population_fitness_median"]),
        "cells": lambda row: str(row.get("map_cells", "-")),
        "invalid": lambda row: str(row["invalid_members"]),
    }
    shown = [name for name, least in zip(columns, (0, 0, 45, 60, 75, 100, 108, 118), strict=True) if width >= least]
    table = Table(title=Text(title), title_justify="left", header_style="bold")  # a Text is shown as it is
    for name in shown:
        table.add_column(name, justify="right", no_wrap=True)
    for row in list(recent)[-max(1, min(TABLE_ROWS, height - ROWS_AROUND)) :]:
        table.add_row(*(columns[name](row) for name in shown))
    return Group(table, Text(time_by_part(recent)))


def time_by_part(rows: deque[Row] | list[Row]) -> str:
    """Mean time of generations, its shares by part ("5.0 ms a generation: rollout 81 %, ..."), and lost workers."""
    seconds = {part: sum(row[f"seconds_{part}"] or 0.0 for row in rows) for part in _PARTS}
    whole = sum(seconds.values()) or 1.0
    per_generation = 1000.0 * whole / len(rows)
    text = f"{per_generation:.1f} ms a generation: " + ", ".join(
        f"{part} {100.0 * value / whole:.0f} %" for part, value in seconds.items()
    )
    lost = sum(row["lost_workers"] or 0 for row in rows)
    return text + (f"; workers replaced: {lost}" if lost else "")


def plain_line(row: Row) -> str:
    return (
        f"generation {row['generation']}  {evaluated_word(row)} {decimals(row['centre_fitness_mean'])}  "
        f"best {decimals(row['best_fitness'])}  env steps {row['env_steps']:,}  steps/s {row['steps_per_second']:,.0f}"
    )


def _plain_lines(console: Console) -> ShowRow:
    last_s, lost = float("-inf"), 0

    def show(row: Row) -> None:
        nonlocal last_s, lost
        lost += row["lost_workers"]
        now = time.monotonic()
        if now - last_s >= 1.0:
            faults = f"  workers replaced {lost}" if lost else ""
            console.print(plain_line(row) + faults, soft_wrap=True)
            last_s, lost = now, 0

    return show


def _number(value: float | None) -> str:
    return "-" if value is None else decimals(value)


def short(value: float) -> str:
    """A count with three significant digits: 850, 12.3 k, 4.56 M."""
    value = float(f"{value:.3g}")
    for unit, size in (("T", 1e12), ("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.0f}"
