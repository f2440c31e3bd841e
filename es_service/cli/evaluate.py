"""The command `evaluate`: policies of runs on fresh episodes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from es_service import api
from es_service.cli.console import console, errors, print_line
from es_service.cli.data import print_json
from es_service.cli.options import JsonOption, LogLevelOption, place_of, print_note
from es_service.cli.several import RunsArgument, is_single, items_of_each, of_each, readable
from es_service.errors import ConfigError
from es_service.protocol.system import given_path
from es_service.report.progress import print_notice


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
            help="With --certify: select by return, last_reward, success or goal_distance; default: by task.fitness.",
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
    as_json: JsonOption = False,
    log_level: LogLevelOption = None,
) -> None:
    """Evaluate policies of a run, or of several, on fresh episodes; print the results beside the stored values."""
    from es_service.cli.tables.certified import print_certified
    from es_service.cli.tables.evaluations import csv_file, print_header, print_map_summary, print_row, row_of
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
    tell = partial(print_notice, errors)

    def fresh_rows(folder: Path) -> Iterator[dict[str, Any]]:
        run = api.open_run(folder)
        best_too = best or not (centre or cell or every or top)
        chosen = evaluation.candidates(
            run, best=best_too, centre=centre, cells=cells, every=every, top=top or 0, generation=generation
        )
        if single and not as_json:
            print_header(console)
        results = []
        for fresh in evaluation.evaluate(run, chosen, episodes or 100, workers, seed or 0, on_compile=tell):
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
            generation=generation, workers=workers, on_notice=tell,
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
