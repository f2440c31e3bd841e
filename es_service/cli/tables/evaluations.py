"""The table that `es-service evaluate` prints: stored and fresh values side by side."""

from __future__ import annotations

import contextlib
import csv
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
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

    Raises ConfigError for a name that does not end in .csv, so that no other kind of file is overwritten, and
    StoreError if the file cannot be written.
    """
    if path is None:
        yield lambda row: None
        return
    if path.suffix != ".csv":
        raise ConfigError(f"--out {path}: must end in .csv")
    new, is_empty = path.with_name(f"{path.name}.new"), True
    with _explained(path):
        if path.is_dir():
            raise ConfigError(f"--out {path}: is a folder; give the name of a file")
        file = new.open("w", newline="")

    def write(row: Mapping[str, Any]) -> None:
        nonlocal is_empty
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        with _explained(path):
            if is_empty:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
        is_empty = False

    try:
        yield write
        with _explained(path):
            file.close()
            os.replace(new, path)
    except BaseException:
        with contextlib.suppress(OSError):  # closing writes the last rows, which fails on a full disk
            file.close()
        if is_empty:
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


def print_evaluations(console: Console, run: Run, results: Iterable[Fresh], write: Write, *, every: bool) -> None:
    """Print a line per policy as results arrive, and `write` its row; with `every`, end with a summary of the map."""
    names = run.descriptor_names
    found: list[Fresh] = []
    print_line(
        console, f"{'policy':<10} {'generation':>10} {'stored':>10} {'fresh':>10} {'± s.e.':>8}  descriptor (± std)"
    )
    for fresh in results:
        found.append(fresh)
        row = row_of(fresh, names)
        write(row)
        where = ", ".join(f"{name} {row[name]:.3g} ± {row[f'{name}_std']:.2g}" for name in names)
        one = fresh.candidate
        print_line(
            console,
            f"{one.name:<10} {one.generation:>10} {one.stored_fitness:>10.2f} {fresh.mean:>10.2f} "
            f"{fresh.standard_error:>8.2f}  {where}",
        )
    if every:
        print_line(console, _about_elites(run, [fresh for fresh in found if fresh.candidate.cell is not None]))


def row_of(fresh: Fresh, names: list[str]) -> dict[str, Any]:
    """The row of a policy, of which `names` are the descriptor's dimensions."""
    one = fresh.candidate
    return {
        "policy": one.name,
        "generation": one.generation,
        "episodes": fresh.fitness_E.size,
        "stored_fitness": one.stored_fitness,
        "fresh_fitness": fresh.mean,
        "fresh_standard_error": fresh.standard_error,
        **{name: float(value) for name, value in zip(names, fresh.descriptor, strict=True)},
        **{f"{name}_std": float(value) for name, value in zip(names, fresh.descriptor_std, strict=True)},
    }


def _about_elites(run: Run, elites: list[Fresh]) -> str:
    """Summary of a map: how many elites still end in their cells, and the QD-score, stored and fresh."""
    offset = run.constants["map.qd_offset"]
    stayed = sum(fresh.cell == fresh.candidate.cell for fresh in elites)
    best: dict[int, float] = {}
    for fresh in elites:
        if fresh.cell is not None and math.isfinite(fresh.mean):
            best[fresh.cell] = max(best.get(fresh.cell, -math.inf), fresh.mean)
    stored = math.fsum(fresh.candidate.stored_fitness - offset for fresh in elites)
    again = math.fsum(fitness - offset for fitness in best.values())
    return (
        f"{len(elites)} elites: the mean descriptor of {stayed} still lies in their cell; a new map built from the "
        f"fresh values has {len(best)} filled cells.\n"
        f"QD-score (offset {offset:g}): {stored:,.0f} stored, {again:,.0f} fresh"
    )
