"""The commands that only read and print: `status`, `digest`, `config` and `list`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.padding import Padding

from es_service import api
from es_service.cli.commands import command
from es_service.cli.console import console, print_line
from es_service.cli.data import catalogue_data, digest_data, print_json, status_data
from es_service.cli.options import JsonOption, print_note
from es_service.cli.several import RunsArgument, is_single, of_each, problem_data, readable
from es_service.cli.tables.catalogue import print_catalogue
from es_service.cli.tables.overview import NOT_STARTED, print_overview
from es_service.cli.tables.status import follow_status, print_status
from es_service.config.given import shipped_text
from es_service.config.keys import unknown_key
from es_service.config.tasks import TASKS
from es_service.config.text import one_of
from es_service.config.values import described_keys
from es_service.errors import ConfigError, ServiceError
from es_service.protocol.system import given_path
from es_service.runs.folders import runs_of
from es_service.runs.run_status import newest_runs, read_status
from es_service.search.algorithms import OURS
from es_service.store import digest

NEWEST = 10
"""Most runs that `status` shows without a folder."""


def status(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            parser=given_path,
            metavar="[RUN]...",
            help="Folders of runs or of sweeps; default: the newest runs under runs/.",
            show_default=False,
        ),
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Watch one run until its driver ends.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a run, also while it is running; for a sweep or several runs, print one line each."""
    if follow and len(folders or ()) != 1:
        raise ConfigError(f"--follow: needs exactly one folder, got {len(folders or ())}; give one, or omit --follow")
    if follow and as_json:
        raise ConfigError("--follow and --json cannot be combined; omit one of them")
    if not folders:
        found = newest_runs(api.RUNS_FOLDER)
        folders = found[:NEWEST]
        if not folders and not as_json:
            print_note(f"there is no run under {api.RUNS_FOLDER}/ in this folder; give the folder of a run")
            return
        if len(found) > NEWEST and not as_json:
            everything = command("status", f"{api.RUNS_FOLDER}/")
            print_note(f"the {NEWEST} newest of {len(found)} runs under {api.RUNS_FOLDER}/; all: {everything}")
    elif is_single(folders) and not as_json:
        run = api.open_run(folders[0])
        (follow_status if follow else print_status)(console, run)
        return
    if follow:
        names = ", ".join(run.name for run in runs_of(folders[0]))
        raise ConfigError(f"--follow: needs one run; {folders[0]} has several: {names}")
    shown = _print_statuses(folders) if as_json else print_overview(console, folders)
    raise typer.Exit(0 if shown else 1)


def _print_statuses(folders: list[Path]) -> bool:
    """Print a list with an object for each run; return whether all runs could be read."""
    statuses: list[dict[str, Any]] = []
    for folder, data in of_each(folders, lambda run: status_data(read_status(api.open_run(run)))):
        if isinstance(data, ServiceError):
            statuses.append(problem_data(folder, data))
        else:
            statuses.append(data or {"run": str(folder), "state": NOT_STARTED, "newest": None})
    print_json(statuses)
    return not any("error" in run_status for run_status in statuses)


def digest_(
    folders: RunsArgument,
    parts: Annotated[bool, typer.Option("--parts", help="Also print a line for each part of the run.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check all data of a run and print a SHA-256 of everything deterministic in it; of several runs, a line each."""
    single = is_single(folders)

    def show(folder: Path) -> dict[str, Any]:
        part_digests, mixed = digest.checked_parts(folder)
        if not as_json:
            for name, value in part_digests.items() if parts else ():
                print(f"{value}  {name}")
            where = "" if single else f"  {folder}"
            print(f"{digest.digest_of(part_digests)}{where}{'  mixed' if mixed else ''}", flush=True)
        return ({} if single else {"run": str(folder)}) | digest_data(part_digests, mixed=mixed)

    problems: list[dict[str, str]] = []
    results = show(folders[0]) if single else [data for _, data in readable(of_each(folders, show), problems)]
    if as_json:
        print_json(results if single else [*results, *problems])
    if problems:
        raise typer.Exit(1)


def config_(
    name: Annotated[
        str, typer.Argument(help="Name of a shipped config, as `list` shows it; with --keys, a key or section.")
    ] = "",
    keys: Annotated[bool, typer.Option("--keys", help="Describe the keys of configs instead.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Print a shipped config, which you can save as a file and edit, or what keys mean."""
    if not keys:
        if as_json:
            raise ConfigError("--json is for --keys; a shipped config is YAML already")
        print(shipped_text(name), end="")
        return
    everything = described_keys(OURS)
    rows = [row for row in everything if f"{row.key}.".startswith(f"{name}." if name else "")]
    if not rows:
        problem = unknown_key(name, [row.key for row in everything], None)
        raise ConfigError(problem.sentence, field=name, suggestion=problem.suggestion)
    if as_json:
        print_json([row._asdict() for row in rows])
        return
    for row in rows:
        print_line(console, f"{row.key} = {row.default}", style="bold")
        others, of_methods = [method for method in OURS if method not in row.methods], ""
        if others and row.methods:
            which = f"all but {one_of(others, 'and')}" if len(others) < len(row.methods) else one_of(row.methods, "and")
            of_methods = f" A key of {which}."
        console.print(Padding(f"{row.meaning} Must be {row.allowed}.{of_methods}", (0, 0, 0, 4)))


def list_(as_json: JsonOption = False) -> None:
    """Show tasks, algorithms, presets and shipped configs."""
    if as_json:
        print_json(catalogue_data(TASKS))
    else:
        print_catalogue(console, TASKS)
