"""Overview of several runs, one line each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from es_service.cli.console import print_line
from es_service.cli.several import of_each
from es_service.errors import ServiceError
from es_service.report.progress import short
from es_service.runs.folders import output_of
from es_service.runs.run_status import RunStatus, read_status, state
from es_service.runs.view import open_run

_COLUMNS = ("run", "algorithm", "task", "seed", "generation", "env steps", "best", "cells", "state")
NOT_STARTED = "not started"
"""State of a sweep's run that has no folder yet."""


def print_overview(console: Console, folders: Sequence[Path]) -> bool:
    """Print a line for each run, with the error if it cannot be read; return whether all could be read.

    Args:
        folders: those of runs or of sweeps.
    """
    rows, problems = [], 0
    for folder, result in of_each(folders, lambda run: _row(read_status(open_run(run)))):
        if isinstance(result, ServiceError):
            rows.append(_without_row(folder, f"error: {' '.join(result.sentence.split())}"))
            problems += 1
        elif result is None:
            output = output_of(folder)
            rows.append(_without_row(folder, NOT_STARTED + (f"; its output is in {output}" if output else "")))
        else:
            rows.append(result)
    widths = [max(map(len, column)) for column in zip(_COLUMNS, *rows, strict=True)]
    for row in (_COLUMNS, *rows):
        line = "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        print_line(console, line)
    return not problems


def _without_row(folder: Path, state: str) -> tuple[str, ...]:
    return (str(folder), *["-"] * (len(_COLUMNS) - 2), state)


def _row(status: RunStatus) -> tuple[str, ...]:
    constants, limits, row = status.run.constants, status.limits, status.row
    who = (str(status.run.folder), constants["search.algorithm"], constants["task.environment"], str(constants["seed"]))
    if row is None:
        return (*who, *["-"] * (len(_COLUMNS) - len(who) - 1), state(status))
    generations, steps = limits.get("generations"), limits.get("env_steps")
    return (
        *who,
        f"{row['generation']:,}" + (f" of {generations:,}" if generations else ""),
        short(row["env_steps"]) + (f" of {short(steps)}" if steps else ""),
        f"{row['best_fitness']:.2f}",
        f"{row['map_cells']:,}" if "map_cells" in row else "-",
        state(status),
    )
