"""Progress of a sweep: a live table on a terminal; elsewhere, a line for each run that starts or ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from es_service.cli.console import print_line
from es_service.errors import counted
from es_service.report.progress import ShowNotice, print_notice, short
from es_service.runs.sweep import OnProgress, SweptRun

STATES = ("running", "failed", "stopped", "waiting", "finished")
"""The order in which runs are shown where not all have room."""
ROWS_AROUND = 9
"""Screen lines needed for the table's frame, its title and the line below it, which may take two."""


@contextmanager
def show_sweep(console: Console, errors: Console, title: str) -> Iterator[tuple[OnProgress, ShowNotice]]:
    """Yield two functions: one to call with all runs of a sweep when they have changed, one with every notice."""
    if not console.is_terminal or console.is_dumb_terminal:
        yield partial(_print_changes, console, {}), partial(print_notice, errors)
        return
    with Live(console=console, refresh_per_second=4) as live:

        def show(runs: Sequence[SweptRun]) -> None:
            with suppress(SystemExit):  # rich's answer to a closed output; the runs continue
                live.update(live_table(title, runs, console.width, console.height))

        yield show, partial(print_notice, live.console)


def live_table(title: str, runs: Sequence[SweptRun], width: int, height: int) -> Group:
    """Table of the runs in their order; those that run and those that failed, and fewer columns, on a small screen."""
    columns: dict[str, Callable[[SweptRun], str]] = {
        "run": lambda run: run.name,
        "state": lambda run: run.state,
        "generation": lambda run: _of(run, "generation", "generations"),
        "best": lambda run: f"{run.row['best_fitness']:.2f}" if run.row else "-",
        "env steps": lambda run: _of(run, "env_steps", "env_steps"),
        "steps/s": lambda run: short(run.row["steps_per_second"]) if run.row and run.state == "running" else "-",
        "cells": lambda run: str(run.row["map_cells"]) if run.row and "map_cells" in run.row else "-",
    }
    shown = [name for name, least in zip(columns, (0, 0, 50, 60, 80, 95, 105), strict=True) if width >= least]
    room = max(1, height - ROWS_AROUND)
    chosen = {id(run) for run in sorted(runs, key=lambda run: STATES.index(run.state))[:room]}
    table = Table(title=Text(title, style="italic"), title_justify="left", header_style="bold")
    for name in shown:
        left = name in ("run", "state")
        table.add_column(name, justify="left" if left else "right", no_wrap=True, overflow="ellipsis")
    for run in runs:
        if id(run) in chosen:
            table.add_row(*(Text(columns[name](run)) for name in shown))
    more = f"and {len(runs) - len(chosen)} more; " if len(runs) > len(chosen) else ""
    return Group(table, Text(more + count_line(runs)))


def count_line(runs: Sequence[SweptRun]) -> str:
    """How many runs are in each state, such as "12 runs: 2 running, 10 waiting"."""
    counts = Counter(run.state for run in runs)
    states = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    return f"{counted(len(runs), 'run')}: {states}"


def _of(run: SweptRun, column: str, limit: str) -> str:
    if run.row is None:
        return "-"
    most = run.limits.get(limit)
    return short(run.row[column]) + (f" of {short(most)}" if most else "")


def _print_changes(console: Console, before: dict[str, str], runs: Sequence[SweptRun]) -> None:
    lines = []
    for run in runs:
        if run.state != before.get(run.name, "waiting"):
            at = f" at generation {run.row['generation']}" if run.row else ""
            why = f": {run.reason}" if run.reason else ""
            lines.append(f"{run.name}  {run.state}{at}{why}")
        before[run.name] = run.state
    if all(run.state not in ("waiting", "running") for run in runs):
        lines.append(count_line(runs))
    for line in lines:
        with suppress(SystemExit):  # rich's answer to a closed output
            print_line(console, line)
