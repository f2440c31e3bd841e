"""Where a run stands, and what to do with it next."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console
from rich.table import Table

from es_service.report.progress import plain_line
from es_service.run_lock import lock_holder
from es_service.run_view import Run

FOLLOW_INTERVAL_S = 1.0


def print_status(console: Console, run: Run) -> None:
    """A short table: settings, progress, best result, who is writing."""
    rows = run.history_rows()
    constants = run.constants
    holder = lock_holder(run.folder)
    table = Table(show_header=False, box=None)
    table.add_row("run", str(run.folder))
    table.add_row("task", f"{constants['task.environment']}, {constants['task.episode_steps']} steps an episode")
    table.add_row("search", f"{constants['search.algorithm']}, {constants['search.pairs']} pairs, seed {constants['seed']}")
    if run.meta.parent:
        parent = run.meta.parent
        table.add_row("started from", f"{parent['folder']}, generation {parent['generation']}")
    table.add_row("driver", f"running on {holder['host']}, pid {holder['pid']}" if holder else "none is running")
    if not rows:
        table.add_row("generation", "none is finished yet")
    else:
        _add_progress(table, rows)
    console.print(table)


def follow_status(console: Console, run: Run) -> None:
    """Print a line for the newest generation, at most one a second, until no driver is running."""
    next_generation = 0
    while True:
        running = lock_holder(run.folder) is not None  # asked before reading, so that the last rows are not missed
        rows = run.history_rows(next_generation)
        if rows:
            next_generation = rows[-1]["generation"] + 1
            console.print(plain_line(rows[-1]), highlight=False, soft_wrap=True)
        if not running:
            console.print(f"no driver is running; go on with: es-service resume {run.folder}", soft_wrap=True)
            return
        time.sleep(FOLLOW_INTERVAL_S)


def print_summary(console: Console, run: Run, reason: str) -> None:
    """What a session ends with: the result, the folder, the next commands."""
    rows = run.history_rows()
    table = Table(show_header=False, box=None)
    _add_progress(table, rows)
    folder = run.folder
    console.print(f"\nDone: {reason}.", highlight=False)
    console.print(table)
    console.print(f"\nThe run is in {folder}. Next:", highlight=False, soft_wrap=True)
    for command in (
        f"es-service status {folder}",
        f"es-service digest {folder}",
        f"es-service resume {folder} --set budget.generations={rows[-1]['generation'] * 2}",
        f"es-service fork {folder} --set search.sigma=0.05 --set budget.generations={rows[-1]['generation'] * 2}",
    ):
        console.print(f"  {command}", highlight=False, soft_wrap=True)


def _add_progress(table: Table, rows: list[dict[str, Any]]) -> None:
    last = rows[-1]
    table.add_row("generation", str(last["generation"]))
    table.add_row("best fitness", f"{last['best_fitness']:.2f}")
    table.add_row("centre fitness", f"{last['centre_fitness_mean']:.2f} ± {last['centre_fitness_std']:.2f}")
    table.add_row("goal distance", f"{last['goal_distance']:.3f} at the end, {last['goal_distance_min']:.3f} at its least")
    rate = last["env_steps"] / last["wall_clock_s"] if last["wall_clock_s"] else 0.0
    table.add_row("environment steps", f"{last['env_steps']:,} in {last['episodes']:,} episodes")
    table.add_row("time", f"{last['wall_clock_s']:.1f} s, {rate:,.0f} steps/s overall")
