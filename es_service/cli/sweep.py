"""The command `sweep`, and `run --seeds`: several runs of one config, and the page that compares them.

Progress is a live table on a terminal; elsewhere, a line for each run that starts or ends.
"""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from es_service import api
from es_service.cli.common import (
    AddressOption,
    BoundsOption,
    EngineOption,
    LinesOption,
    LogLevelOption,
    LogOption,
    SetOption,
    bounds_of,
    console,
    errors,
    overrides,
    print_config_notes,
    print_error,
    print_json_line,
    print_line,
    print_note,
)
from es_service.config.given import parse_overrides
from es_service.config.text import split_values, unknown_name
from es_service.errors import ConfigError, Interrupted, Problem, counted, decimals
from es_service.protocol.machine import given_path
from es_service.report.progress import ShowNotice, print_notice, short
from es_service.runs.sweep import COSTS, Certifying, OnProgress, SweptRun, run_planned
from es_service.runs.sweep_plan import Labelled, left_out_notes, plan
from es_service.runs.tracking import check_trackers

SeedsOption = Annotated[
    str | None,
    typer.Option("--seeds", metavar="A:B", help="A run for each seed from A to B-1, or of a list such as 0,7."),
]
GridOption = Annotated[
    list[str] | None,
    typer.Option("--grid", metavar="KEY=A,B", help="Run with each value of a key; several keys are combined."),
]
ParallelOption = Annotated[
    int | None,
    typer.Option("--parallel", min=1, help="Runs at a time, which share the cores; default: one per core."),
]
GOALS, HELD = "goals.csv", 0.5
"""The file with a row for each goal, and the share of episodes from which a policy counts as one that reaches it."""


def sweep(
    configs: Annotated[
        list[Path],
        typer.Argument(
            parser=given_path,
            metavar="CONFIG...",
            help="YAML files, or names of shipped configs; each of several is a group.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option("--out", parser=given_path, help="Folder, in which each run gets a folder.", show_default=False),
    ],
    label: Annotated[
        list[str] | None,
        typer.Option("--label", help="Name of the group of each config, in their order; default: that of the file."),
    ] = None,
    grid: GridOption = None,
    seeds: SeedsOption = None,
    set_: SetOption = None,
    parallel: ParallelOption = None,
    certify: Annotated[bool, typer.Option("--certify", help="Certify each run at its end, as evaluate does.")] = False,
    certify_at: Annotated[
        list[str] | None,
        typer.Option(
            "--certify-at",
            metavar="[COST=]N,...",
            help="Certify runs at these costs, too, and at the end: environment steps, or rollout_s= or cpu_s= and "
            "seconds.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Workers of each run; default: an equal share of the cores.")
    ] = None,
    engine: EngineOption = None,
    address: AddressOption = None,
    bounds: BoundsOption = None,
    log: LogOption = None,
    log_level: LogLevelOption = None,
    as_json: LinesOption = False,
) -> None:
    """Run configs with several settings and seeds, and compare the runs. The same command again continues it."""
    if not grid and seeds is None and len(configs) < 2:
        raise ConfigError("a sweep needs --grid KEY=A,B or --seeds A:B, or both, or several configs")
    wanted = overrides(set_, workers=workers, engine=engine, address=address)
    certifying = Certifying(points_of(certify_at or ())) if certify or certify_at else None
    options, named = _options_of_each(log, log_level), labelled(configs, label or ())
    given = grid_of(grid or ()), seeds, parallel, options, certifying, bounds_of(bounds or ())
    run_sweep(named, out, wanted, *given, as_json=as_json)


def run_seeds(
    config: Path,
    seeds: str,
    out: Path | None,
    wanted: Sequence[str],
    seed: int | None,
    log: list[str] | None,
    log_level: str | None,
    *,
    as_json: bool,
) -> None:
    """`run --seeds`: a sweep without a grid."""
    if seed is not None:
        raise ConfigError("--seed and --seeds cannot be combined; give one of them")
    folder = out if out is not None else api.default_folder(api.load_config(config, wanted), "seeds")
    options = _options_of_each(log, log_level)
    run_sweep(labelled([config], ()), folder, wanted, {}, seeds, None, options, as_json=as_json)


def polish_goals(
    parent: Path,
    goals: str,
    out: Path,
    wanted: Sequence[str],
    seeds: str | None,
    parallel: int | None,
    trackers: list[str] | None,
    log_level: str | None,
) -> None:
    """`polish --goals`: a run for each goal and seed, which are certified, and a table of what their policies do."""
    from es_service.runs.goals import goal_configs

    configs = goal_configs(parent, [name.strip() for name in goals.split(",")], wanted)
    options = _options_of_each(trackers, log_level)
    run_sweep(configs, out, wanted, {}, seeds, parallel, options, Certifying(), as_json=False, shows=_show_goals)


def _show_goals(runs: Sequence[SweptRun], out: Path) -> None:
    """Print what the certified policy of each goal does, and write it to a file."""
    import pandas as pd

    from es_service.runs.goals import goals_reached

    reached = goals_reached(run.folder for run in runs if run.row is not None)
    if reached.empty:
        return
    reached.to_csv(out / GOALS, index=False)
    for row in reached.to_dict("records"):
        share, low, high = (row[name] for name in ("success", "success_low", "success_high"))
        if pd.notna(share):
            value = f"{share:.0%} of {row['episodes']} episodes succeed ({low:.0%} to {high:.0%})"
        elif pd.notna(row["episodes"]):
            value = f"a mean return of {row['return_mean']:.6g} in {row['episodes']} episodes"
        else:
            value = "not certified"
        print_line(console, f"goal {row['goal']}, seed {row['seed']}: {value}, after {row['env_steps']:,} steps")
    if reached.success.notna().any():
        held = int((reached.success >= HELD).sum())
        print_line(console, f"{held} of {len(reached)} policies succeed in at least half of their episodes")
    print(out / GOALS)


def _options_of_each(trackers: list[str] | None, log_level: str | None) -> list[str]:
    """Options of this command that its runs get. Raises ConfigError if a tracker cannot be used."""
    check_trackers(trackers or ())
    level = [] if log_level is None else ["--log-level", log_level]
    return [*(f"--log={tracker}" for tracker in trackers or ()), *level]


def labelled(configs: Sequence[Path], labels: Sequence[str]) -> list[Labelled]:
    """Configs with the labels of their groups; one alone needs none."""
    if labels and len(labels) != len(configs):
        raise ConfigError(
            f"--label: there are {len(labels)} for {counted(len(configs), 'config')}; give one for each",
            field="label",
            value=list(labels),
        )
    default = [""] if len(configs) == 1 else [config.stem for config in configs]
    return list(map(Labelled, labels or default, configs))


def run_sweep(
    configs: Sequence[Labelled],
    out: Path,
    wanted: Sequence[str],
    grid: dict[str, list[Any]],
    seeds: str | None,
    parallel: int | None,
    options: Sequence[str],
    certifying: Certifying | None = None,
    bounds: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    *,
    as_json: bool,
    shows: Callable[[Sequence[SweptRun], Path], object] | None = None,
) -> None:
    """Run a sweep to its end and write the comparison; exit with code 1 if a run failed.

    Args:
        bounds: as of `write_comparison`.
        shows: called with the runs and `out` in place of the comparison.
        as_json: whether to print a line of JSON for each run that has changed, and one for the comparison.
    """
    planned = plan(configs, out, grid, None if seeds is None else seeds_of(seeds), wanted)
    _check_bounds(bounds, {run.config.task.environment for run in planned})
    for config in configs:
        print_config_notes(config.source, [run.config for run in planned if run.source == config.source])
    for note in left_out_notes(planned):
        print_note(f"note: {note}")
    try:
        with json_lines(errors) if as_json else show_sweep(console, errors, str(out)) as (show, note):
            runs = run_planned(planned, out, parallel, show, note, options, certifying)
    except Interrupted:
        print_note(
            "interrupted; every finished generation of every run is saved. The same command again, with "
            f"--out {shlex.quote(str(out))}, continues"
        )
        raise
    if shows is not None:
        shows(runs, out)
    else:
        _compare(runs, out, bounds, (lambda file: print_json_line({"report": str(file)})) if as_json else print)
    for run in runs:
        if run.state == "stopped":
            print_note(f"{run.name} is not finished: {run.reason}. Raise budget.wall_clock_s")
    failed = [run for run in runs if run.state == "failed"]
    for run in failed:
        print_error(f"{run.name} failed: {run.reason}")
    if failed:
        print_note("the same command again resumes the runs that failed")
        raise typer.Exit(1)


def _check_bounds(bounds: Mapping[str, tuple[float, float]], tasks: Set[str]) -> None:
    """Raise ConfigError for bounds of another task, and for a task that lacks them where others have some."""
    if not bounds:
        return
    from es_service.report.compare import bounds_of_task

    for task in sorted(bounds.keys() - tasks):
        raise unknown_name("task", task, sorted(tasks), "bounds")
    for task in sorted(tasks):
        bounds_of_task(bounds, task)


def _compare(
    runs: Sequence[SweptRun],
    out: Path,
    bounds: Mapping[str, tuple[float, float]],
    shows: Callable[[Path], object],
) -> None:
    """Write the page that compares the runs with a finished generation; a note if they cannot be compared."""
    from es_service.report.write import REPORT, write_comparison

    folders = [run.folder for run in runs if run.row is not None]
    if not folders:
        return
    try:
        for file in write_comparison(folders, out / REPORT, bounds=bounds):
            shows(file)
    except ConfigError as error:
        several = " (--bounds of sweep and report)" if error.field == "task.environment" and not bounds else ""
        print_note(f"note: there is no comparison, since {error.sentence}{several}")


def seeds_of(text: str) -> list[int]:
    """Seeds from text such as 0:5, which is 0 to 4, or 0,7 or 0:3,10:12."""
    seeds: list[int] = []
    for part in text.split(","):
        if (match := re.fullmatch(r"\s*(\d+)(?::(\d+))?\s*", part)) is None:
            raise ConfigError(
                f"--seeds {text}: {part or 'an empty part'} is no seed; must be a range such as 0:5, which is 0 to 4, "
                "or seeds separated by commas, such as 0,7",
                field="seeds",
                value=text,
            )
        first, last = int(match[1]), int(match[2]) if match[2] else int(match[1]) + 1
        if last <= first:
            raise ConfigError(
                f"--seeds {text}: {part} has no seed, since a range ends before its second number; "
                f"did you mean {last}:{first + 1}?",
                field="seeds",
                value=text,
                suggestion=f"{last}:{first + 1}",
            )
        seeds += range(first, last)
    return seeds


def points_of(words: Sequence[str]) -> dict[str, list[float]]:
    """Values by cost from words such as 1e7,1e8 (environment steps) and cpu_s=60,120. Raises ConfigError."""
    points: dict[str, list[float]] = {}
    for word in words:
        cost, equals, text = word.rpartition("=")
        if equals and cost not in COSTS:
            raise unknown_name("cost", cost, COSTS, "certify_at")
        for part in text.split(","):
            try:
                value = float(part)
            except ValueError:
                value = math.nan
            if not 0 < value < math.inf:
                what = f"--certify-at {word}: {part!r} is no cost; write numbers above 0, such as 1e7,1e8 or cpu_s=60"
                raise ConfigError(what, field="certify_at", value=word)
            points.setdefault(cost or "env_steps", []).append(value)
    return points


def grid_of(words: Sequence[str]) -> dict[str, list[Any]]:
    """Values by key, from words such as "search.sigma=0.05,0.1". Raises ConfigError with all problems."""
    grid: dict[str, list[Any]] = {}
    problems: list[Problem] = []
    for word in words:
        key, equals, text = (part.strip() for part in word.partition("="))
        if not equals or not key or not text:
            problems.append(Problem(f"--grid {word}: write KEY=A,B, such as search.sigma=0.05,0.1", key))
        elif key in grid:
            problems.append(Problem(f"--grid {word}: {key} has values already; give all of them at once", key))
        else:
            try:
                texts = split_values(text)
            except ValueError as error:
                problems.append(Problem(f"--grid {word}: {error}", key, text))
                continue
            grid[key] = []
            for value_text in texts:
                values, wrong = parse_overrides([f"{key}={value_text}"])
                problems += wrong
                grid[key] += values.values()
    if problems:
        raise ConfigError.listing("--grid: " + ("1 problem" if len(problems) == 1 else "several problems"), problems)
    return grid


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


@contextmanager
def json_lines(errors: Console) -> Iterator[tuple[OnProgress, ShowNotice]]:
    """As `show_sweep`, with a line of JSON for each run that has changed."""
    before: dict[str, SweptRun] = {}

    def show(runs: Sequence[SweptRun]) -> None:
        with suppress(SystemExit):  # a closed output; the runs continue
            for run in runs:
                if run != before.get(run.name):
                    before[run.name] = run
                    print_json_line(
                        {
                            "run": run.name,
                            "folder": str(run.folder),
                            "state": run.state,
                            "reason": run.reason,
                            "newest": run.row,
                        }
                    )

    yield show, partial(print_notice, errors)


def live_table(title: str, runs: Sequence[SweptRun], width: int, height: int) -> Group:
    """Table of the runs in their order; those that run and those that failed, and fewer columns, on a small screen."""
    columns: dict[str, Callable[[SweptRun], str]] = {
        "run": lambda run: run.name,
        "state": lambda run: run.state,
        "generation": lambda run: _of(run, "generation", "generations"),
        "best": lambda run: decimals(run.row["best_fitness"]) if run.row else "-",
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
