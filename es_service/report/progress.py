"""What a run shows while it runs: a live table on a terminal, one plain line a second elsewhere."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

Row = Mapping[str, Any]
ShowRow = Callable[[Row], None]
ShowNotice = Callable[[str], None]
TABLE_ROWS = 12
RATE_WINDOW = 20
"""Generations over which steps per second are averaged for display."""
_PARTS = ("rollout", "gradient", "evaluation", "driver", "store")


@contextmanager
def show_progress(console: Console, errors: Console, title: str) -> Iterator[tuple[ShowRow, ShowNotice]]:
    """Yield two functions: one to call with every history row, one with every notice."""
    if not console.is_terminal:
        yield _plain_lines(console), partial(_print_notice, errors)
        return
    recent: deque[Row] = deque(maxlen=RATE_WINDOW)
    with Live(Text(f"{title}: starting workers"), console=console, refresh_per_second=5) as live:

        def show(row: Row) -> None:
            recent.append(row)
            live.update(live_table(title, recent))

        yield show, partial(_print_notice, live.console)  # above the table


def _print_notice(console: Console, notice: str) -> None:
    console.print(f"note: {notice}", highlight=False, markup=False, soft_wrap=True)


def live_table(title: str, recent: deque[Row]) -> Group:
    """The last generations, and where their time went."""
    table = Table(title=title, title_justify="left", header_style="bold")
    for name in ("generation", "centre fitness", "best so far", "population median", "env steps", "steps/s", "invalid"):
        table.add_column(name, justify="right")
    for row in list(recent)[-TABLE_ROWS:]:
        table.add_row(
            str(row["generation"]),
            f"{row['centre_fitness_mean']:.2f} ± {row['centre_fitness_std']:.2f}",
            f"{row['best_fitness']:.2f}",
            _number(row["population_fitness_median"]),
            f"{row['env_steps']:,}",
            f"{row['steps_per_second']:,.0f}",
            str(row.get("invalid_members") or 0),
        )
    return Group(table, Text(time_by_part(recent)))


def time_by_part(rows: deque[Row] | list[Row]) -> str:
    """Shares of the time of some generations: "time: rollout 81 %, gradient 6 %, ..."; faults if there were any."""
    seconds = {part: sum(row[f"seconds_{part}"] or 0.0 for row in rows) for part in _PARTS}
    whole = sum(seconds.values()) or 1.0
    per_generation = 1000.0 * whole / len(rows)
    text = f"{per_generation:.1f} ms a generation: " + ", ".join(
        f"{part} {100.0 * value / whole:.0f} %" for part, value in seconds.items()
    )
    lost = sum(row["lost_workers"] or 0 for row in rows)
    return text + (f"; workers replaced: {lost}" if lost else "")


def plain_line(row: Row) -> str:
    """One generation as one line."""
    return (
        f"generation {row['generation']}  centre {row['centre_fitness_mean']:.2f}  best {row['best_fitness']:.2f}  "
        f"env steps {row['env_steps']:,}  steps/s {row['steps_per_second']:,.0f}"
    )


def _plain_lines(console: Console) -> ShowRow:
    last_s = float("-inf")

    def show(row: Row) -> None:
        nonlocal last_s
        now = time.monotonic()
        if now - last_s >= 1.0:
            last_s = now
            console.print(plain_line(row), highlight=False, soft_wrap=True)

    return show


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
