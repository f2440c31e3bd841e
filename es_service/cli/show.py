"""The commands that only read and print: `status`, `digest`, `config` and `list`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from es_service import api
from es_service.cli.console import console
from es_service.cli.data import catalogue_data, print_json, standing_data
from es_service.cli.options import JsonOption, RunArgument, print_note
from es_service.cli.tables.catalogue import print_catalogue
from es_service.cli.tables.overview import print_overview
from es_service.cli.tables.status import follow_status, print_status
from es_service.config.shipped import shipped_text
from es_service.config.tasks import TASKS
from es_service.errors import ConfigError, ServiceError
from es_service.runs.standing import look, newest_runs
from es_service.store import digest


def status(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of runs; default: the newest under runs/.", show_default=False)
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Watch one run until its driver ends.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a run, also while it is running; for several runs, print one line each."""
    if follow and len(folders or ()) != 1:
        raise ConfigError(f"--follow: needs exactly one folder, got {len(folders or ())}; give one, or omit --follow")
    if follow and as_json:
        raise ConfigError("--follow and --json cannot be combined; omit one of them")
    if as_json:
        raise typer.Exit(0 if _print_standings(folders or newest_runs(api.RUNS_FOLDER)) else 1)
    if not folders:
        folders = newest_runs(api.RUNS_FOLDER)
        if not folders:
            print_note(f"there is no run under {api.RUNS_FOLDER}/ in this folder; give the folder of a run")
            return
        print_overview(console, folders)
        return
    if len(folders) > 1:
        raise typer.Exit(0 if print_overview(console, folders) else 1)
    run = api.open_run(folders[0])
    if follow:
        follow_status(console, run)
    else:
        print_status(console, run)


def _print_standings(folders: list[Path]) -> bool:
    """Print a list with an object for each run; returns whether all runs could be read."""
    found: list[dict[str, Any]] = []
    for folder in folders:
        try:
            found.append(standing_data(look(api.open_run(folder))))
        except ServiceError as error:
            found.append({"run": str(folder), "error": error.sentence})
    print_json(found)
    return not any("error" in one for one in found)


def digest_(
    folder: RunArgument,
    parts: Annotated[bool, typer.Option("--parts", help="Also print a line for each part of the run.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check all data of a run and print a SHA-256 of everything deterministic in it."""
    found, mixed = digest.checked_parts(folder)
    if as_json:
        print_json({"digest": digest.digest_of(found), "mixed": mixed, "parts": found})
        return
    if parts:
        for name, value in found.items():
            print(f"{value}  {name}")
    print(f"{digest.digest_of(found)}{'  mixed' if mixed else ''}")


def config_(
    name: Annotated[str, typer.Argument(help="Name of a shipped config, as `list` shows it.", show_default=False)],
) -> None:
    """Print a shipped config, which you can save as a file and edit."""
    print(shipped_text(name), end="")


def list_(as_json: JsonOption = False) -> None:
    """Show tasks, algorithms, presets and shipped configs."""
    if as_json:
        print_json(catalogue_data(TASKS))
    else:
        print_catalogue(console, TASKS)
