"""The command `evaluate`: policies of runs on fresh episodes, and the table of stored and fresh values."""

from __future__ import annotations

import contextlib
import csv
import math
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from es_service import api
from es_service.cli.common import (
    JsonOption,
    LogLevelOption,
    RunsArgument,
    ShowOutputOption,
    console,
    errors,
    is_single,
    items_of_each,
    of_each,
    output_shown,
    place_of,
    print_json,
    print_line,
    print_note,
    readable,
)
from es_service.errors import ConfigError, StoreError, decimals
from es_service.protocol.machine import given_path
from es_service.report.progress import print_notice
from es_service.report.summary import qd_score
from es_service.runs.evaluation import Fresh
from es_service.runs.view import Run


def evaluate(
    folders: RunsArgument,
    best: Annotated[bool, typer.Option("--best", help="Evaluate the best centre (default).")] = False,
    centre: Annotated[bool, typer.Option("--centre", help="Evaluate the newest centre.")] = False,
    cell: Annotated[
        list[str] | None, typer.Option("--cell", metavar="I,J", help="Evaluate a cell's elite; can be repeated.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Evaluate every elite of the map.")] = False,
    top: Annotated[
        int | None, typer.Option("--top", min=0, help="Evaluate the fittest elites; with --certify: 10 if left out.")
    ] = None,
    generation: Annotated[
        int | None, typer.Option("--generation", min=0, help="Generation whose state is kept; default: the newest.")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option("--episodes", min=1, help="Episodes per policy; default: 100, with --certify 256.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of the episodes; default: 0.")
    ] = None,
    certify: Annotated[
        bool,
        typer.Option(
            "--certify",
            help="Select the best of the policies (default: the best centre and the fittest elites) with episodes of "
            "their own, certify it in new episodes, and store the result in the run.",
        ),
    ] = False,
    keep: Annotated[
        int | None, typer.Option("--keep", min=1, help="With --certify: policies that are certified; default: 1.")
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(
            "--by",
            help="With --certify: select by return, last_reward, success or goal_distance; default: by task.fitness, "
            "or by success in a run that polishes for a target set.",
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            "--task",
            metavar="NAME",
            help="With --certify: certify in another task, too, such as gymnasium:Ant-v5; a name as in a config.",
            show_default=False,
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="With --task: an option of it, e.g. task.options.x=5."),
    ] = None,
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default: one per core.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", parser=given_path, help="Also write the rows to this CSV file.")
    ] = None,
    show_output: ShowOutputOption = False,
    as_json: JsonOption = False,
    log_level: LogLevelOption = None,
) -> None:
    """Evaluate policies of a run, or of several, on fresh episodes; print the results beside the stored values."""
    from es_service.cli.status import print_certified
    from es_service.runs import evaluation
    from es_service.runs.certification import certify_run

    if every and cell:
        raise ConfigError("--all and --cell cannot be combined: --all includes every cell; give one of them")
    cells = list(dict.fromkeys(place_of(text) for text in cell or ()))
    if workers is not None:  # before the first run, since the other runs would have the same problem
        for _, result in of_each(folders, lambda folder: evaluation.evaluation_config(api.open_run(folder), workers)):
            if isinstance(result, ConfigError) and result.field == "compute.workers":
                raise result
    alone = {"--all": every or None, "--seed": seed} if certify else {"--keep": keep, "--by": by, "--task": task}
    for option, value in alone.items():
        if value is not None and certify:
            raise ConfigError(f"{option} and --certify cannot be combined; leave one of them out")
        if value is not None:
            raise ConfigError(f"{option} {value} needs --certify; add it, or leave {option} out")
    if set_ and task is None:
        raise ConfigError(f"--set {set_[0]} needs --task, whose options it sets; add it, or leave --set out")
    single = is_single(folders)
    begun = of_each(folders, lambda run: run)
    width = None if single else max((len(str(run)) for run, result in begun if result is not None), default=0)
    told = {"on_notice": partial(print_notice, errors), "on_output": output_shown(show_output)}

    def fresh_rows(folder: Path) -> Iterator[dict[str, Any]]:
        run = api.open_run(folder)
        best_too = best or not (centre or cell or every or top)
        chosen = evaluation.candidates(
            run, best=best_too, centre=centre, cells=cells, every=every, top=top or 0, generation=generation
        )
        if single and not as_json:
            print_header(console)
        results = []
        for fresh in evaluation.evaluate(run, chosen, episodes or 100, workers, seed or 0, **told):
            results.append(fresh)
            row = row_of(fresh, run.descriptor_names, None if single else folder)
            if not as_json:
                print_row(console, row, run.descriptor_names, width)
            yield row
        if every and not as_json:
            print_map_summary(console, run, results)

    def certified_rows(folder: Path) -> Iterator[dict[str, Any]]:
        anything = best or centre or cells
        given: dict[str, Any] = {"episodes": episodes, "keep": keep, "by": by, "task": task, "overrides": set_}
        certified = certify_run(
            folder, best=best or not anything, centre=centre, cells=cells, top=0 if anything and top is None else top,
            generation=generation, workers=workers, **told,
            **{name: value for name, value in given.items() if value is not None},
        )  # fmt: skip
        if not as_json:
            print_line(console, f"{folder}: certification {certified[0].number}")
            print_certified(console, certified)
        for policy in certified:
            yield ({} if single else {"run": str(folder)}) | policy.row()

    rows_of = certified_rows if certify else fresh_rows
    rows: list[dict[str, Any]] = []
    problems: list[dict[str, str]] = []
    with csv_file(out, print_note) as write:
        if single:
            evaluated_rows = rows_of(folders[0])
        else:
            if not as_json and not certify:
                print_header(console, width)
            evaluated_rows = (row for _, row in readable(items_of_each(folders, rows_of), problems))
        for row in evaluated_rows:
            rows.append(row)
            write(row)
    if as_json:
        print_json([*rows, *problems])
    if problems:
        raise typer.Exit(1)


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
    values = f"{decimals(row['stored_fitness']):>10} {decimals(row['fresh_fitness']):>10} "
    values += f"{decimals(row['fresh_standard_error']):>8}"
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
    before, best = (
        _best_of_cells([(fresh.candidate.cell, fresh.candidate.stored_fitness) for fresh in elites]),
        _best_of_cells([(fresh.cell, fresh.mean) for fresh in elites]),
    )
    stored, again = (math.fsum(fitness - offset for fitness in values.values()) for values in (before, best))
    print_line(
        console,
        f"{len(elites)} elites: the mean descriptor of {stayed} still lies in their cell; a new map built from the "
        f"fresh values has {len(best)} filled cells.\n"
        f"QD-score (offset {offset:g}): {qd_score(stored)} stored, {qd_score(again)} fresh",
    )


def _best_of_cells(places: list[tuple[int | None, float]]) -> dict[int, float]:
    """Highest finite fitness in each cell."""
    best: dict[int, float] = {}
    for cell, fitness in places:
        if cell is not None and math.isfinite(fitness):
            best[cell] = max(best.get(cell, -math.inf), fitness)
    return best
