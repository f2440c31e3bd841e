"""The table that `es-service evaluate` prints: stored and fresh values side by side."""

from __future__ import annotations

import contextlib
import csv
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from es_service.cli.console import print_line
from es_service.errors import ConfigError, StoreError
from es_service.runs.evaluation import Fresh
from es_service.runs.view import Run

Write = Callable[[Mapping[str, Any]], None]


@contextlib.contextmanager
def csv_file(path: Path | None, note: Callable[[str], None]) -> Iterator[Write]:
    """Yield a function that writes one row to the CSV file at `path`, or does nothing if `path` is None.

    The rows are written to a new file beside `path`, which replaces `path` when the block ends. If the block ends
    with an error, the new file is kept, and `note` is called with a sentence that names it.

    Raises ConfigError for a name that does not end in .csv, so that no other kind of file is overwritten, and for a row
    with other columns than the first; StoreError if the file cannot be written.
    """
    if path is None:
        yield lambda row: None
        return
    if path.suffix != ".csv":
        raise ConfigError(f"--out {path}: must end in .csv")
    new = path.with_name(f"{path.name}.new")
    columns: list[str] = []
    with _explained(path):
        if path.is_dir():
            raise ConfigError(f"--out {path}: is a folder; give the name of a file")
        file = new.open("w", newline="")

    def write(row: Mapping[str, Any]) -> None:
        is_first = not columns
        columns.extend(row if is_first else ())
        if list(row) != columns:
            raise ConfigError(
                f"--out {path}: its columns are {', '.join(columns)}, and this run has {', '.join(row)}; evaluate runs "
                "with other descriptors separately"
            )
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        with _explained(path):
            if is_first:
                writer.writeheader()
            writer.writerow(row)
            file.flush()

    try:
        yield write
        with _explained(path):
            file.close()
            os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):  # closing writes the last rows, which fails on a full disk
            file.close()
        if not columns:
            new.unlink(missing_ok=True)
        else:
            note(f"the results so far are in {new}")
        raise


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror}; choose another --out") from error


def print_header(console: Console, run_width: int | None = None) -> None:
    """Print the names of the columns. `run_width`: width of the column with the run; None: there is none."""
    run = "" if run_width is None else f"{'run':<{run_width}}  "
    head = f"{'policy':<10} {'generation':>10} {'stored':>10} {'fresh':>10} {'± s.e.':>8} {'success':>11}  "
    print_line(console, f"{run}{head}descriptor (± std)")


def print_row(console: Console, row: Mapping[str, Any], names: list[str], run_width: int | None = None) -> None:
    """Print the line of a policy, of which `names` are the descriptor's dimensions."""
    run = "" if run_width is None else f"{row['run']:<{run_width}}  "
    values = f"{row['stored_fitness']:>10.2f} {row['fresh_fitness']:>10.2f} {row['fresh_standard_error']:>8.2f}"
    success = "-" if row["successes"] is None else f"{row['successes']}/{row['episodes']}"
    where = ", ".join(f"{name} {row[name]:.3g} ± {row[f'{name}_std']:.2g}" for name in names)
    print_line(console, f"{run}{row['policy']:<10} {row['generation']:>10} {values} {success:>11}  {where}")


def row_of(fresh: Fresh, names: list[str], run: Path | None = None) -> dict[str, Any]:
    """The row of a policy.

    Args:
        names: the descriptor's dimensions.
        run: the first column; None if all rows are of one run, which then have no such column.
    """
    candidate = fresh.candidate
    return {
        **({} if run is None else {"run": str(run)}),
        "policy": candidate.name,
        "generation": candidate.generation,
        "episodes": fresh.episodes,
        "stored_fitness": candidate.stored_fitness,
        "fresh_fitness": fresh.mean,
        "fresh_standard_error": fresh.standard_error,
        "successes": fresh.successes,
        **{name: float(value) for name, value in zip(names, fresh.descriptor, strict=True)},
        **{f"{name}_std": float(value) for name, value in zip(names, fresh.descriptor_std, strict=True)},
    }


def print_map_summary(console: Console, run: Run, results: list[Fresh]) -> None:
    """Print how many elites of a map still end in their cells, and its QD-score, stored and fresh."""
    elites = [fresh for fresh in results if fresh.candidate.cell is not None]
    offset = run.constants["map.qd_offset"]
    stayed = sum(fresh.cell == fresh.candidate.cell for fresh in elites)
    best: dict[int, float] = {}
    for fresh in elites:
        if fresh.cell is not None and math.isfinite(fresh.mean):
            best[fresh.cell] = max(best.get(fresh.cell, -math.inf), fresh.mean)
    stored = math.fsum(fresh.candidate.stored_fitness - offset for fresh in elites)
    again = math.fsum(fitness - offset for fitness in best.values())
    print_line(
        console,
        f"{len(elites)} elites: the mean descriptor of {stayed} still lies in their cell; a new map built from the "
        f"fresh values has {len(best)} filled cells.\n"
        f"QD-score (offset {offset:g}): {stored:,.0f} stored, {again:,.0f} fresh",
    )
