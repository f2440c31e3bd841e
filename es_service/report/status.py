"""Where a run stands, and what to do with it next."""

from __future__ import annotations

import shutil
import sys
import time

from rich.console import Console

from es_service.commands import command
from es_service.report.progress import Row, plain_line
from es_service.run_view import Run
from es_service.store.lock import lock_holder
from es_service.store.reader import read_newest, read_totals

FOLLOW_INTERVAL_S = 1.0


def print_status(console: Console, run: Run) -> None:
    """Settings, progress, best result, who is writing."""
    newest = read_newest(run.folder)
    constants, parent, holder = run.constants, run.meta.parent, lock_holder(run.folder)
    fields = {
        "run": str(run.folder),
        "task": f"{constants['task.environment']}, {constants['task.episode_steps']} steps an episode",
        "search": f"{constants['search.algorithm']}, {constants['search.pairs']} pairs, seed {constants['seed']}",
    }
    if parent:
        fields["started from"] = f"{parent['folder']}, generation {parent['generation']}"
    fields["driver"] = f"running on {holder['host']}, pid {holder['pid']}" if holder else "none is running"
    _print_fields(console, fields | (_progress(run, newest) if newest else {"generation": "none is finished yet"}))


def follow_status(console: Console, run: Run) -> None:
    """Print a line for the newest generation, at most one a second, until no driver is running."""
    next_generation = 0
    while True:
        running = lock_holder(run.folder) is not None  # asked before reading, so that the last rows are not missed
        newest = read_newest(run.folder)
        if newest and newest["generation"] >= next_generation:
            next_generation = newest["generation"] + 1
            console.print(plain_line(newest), highlight=False, soft_wrap=True)
        if not running:
            _print_line(console, f"no driver is running; go on with: {command('resume', run.folder)}")
            return
        time.sleep(FOLLOW_INTERVAL_S)


def print_summary(console: Console, run: Run, reason: str) -> None:
    """What a session ends with: the result, the folder, the next commands."""
    newest = read_newest(run.folder)
    assert newest is not None, "a session ends after a generation"
    folder, twice = run.folder, ("--set", f"budget.generations={max(1, newest['generation']) * 2}")
    _print_line(console, f"\nDone: {reason}.")
    _print_fields(console, _progress(run, newest))
    _print_line(console, f"\nThe run is in {folder}. Next:")
    program = "es-service" if shutil.which("es-service") else sys.argv[0]  # `make run` has it in .venv/bin only
    for words in (
        ("status", folder),
        ("evaluate", folder),
        ("digest", folder),
        ("resume", folder, *twice),
        ("fork", folder, "--set", f"search.sigma={run.constants['search.sigma'] * 2:g}", *twice),
    ):
        _print_line(console, f"  {command(*words, program=program)}")


def _progress(run: Run, last: Row) -> dict[str, str]:
    goal = {}
    if "goal_distance" in last:
        goal["goal distance"] = f"{last['goal_distance']:.3f} at the end, {last['goal_distance_min']:.3f} at its least"
    filled = {}
    if "map_cells" in last:
        filled["map"] = f"{last['map_cells']:,} cells, {100 * last['coverage']:.1f} %; QD-score {last['qd_score']:,.0f}"
    rate = last["env_steps"] / last["wall_clock_s"] if last["wall_clock_s"] else 0.0
    lost, retries = read_totals(run.folder, ("lost_workers", "retries"))
    faults = {}
    if lost or retries:
        faults["faults survived"] = f"{lost} workers replaced, {retries} chunks handed out again"
    return {
        "generation": str(last["generation"]),
        "best fitness": f"{last['best_fitness']:.2f}",
        "centre fitness": f"{last['centre_fitness_mean']:.2f} ± {last['centre_fitness_std']:.2f}",
        **goal,
        **filled,
        "novelty archive": f"{last['archive_size']:,} centres",
        "weight of fitness": f"{last['fitness_weight']:g} (novelty: {1.0 - last['fitness_weight']:g})",
        "environment steps": f"{last['env_steps']:,} in {last['episodes']:,} episodes",
        "time": f"{last['wall_clock_s']:.1f} s, {rate:,.0f} steps/s overall",
        **faults,
    }


def _print_fields(console: Console, fields: dict[str, str]) -> None:
    for name, value in fields.items():
        _print_line(console, f"{name:<18} {value}")


def _print_line(console: Console, text: str) -> None:
    """As it is: folders and commands are there to be copied, so nothing is wrapped or cut."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)
