"""The commands that only read and print: `status`, `digest`, `config` and `list`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from es_service import api
from es_service.cli.options import RunArgument, console, print_note
from es_service.cli.tables.catalogue import print_catalogue
from es_service.cli.tables.overview import print_overview
from es_service.cli.tables.status import follow_status, print_status
from es_service.config.shipped import shipped_text
from es_service.config.tasks import TASKS
from es_service.errors import ConfigError
from es_service.runs.standing import newest_runs
from es_service.store import digest


def status(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of runs; default: the newest under runs/.", show_default=False)
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Watch one run until its driver ends.")] = False,
) -> None:
    """Show the state of a run, also while it is running; for several runs, print one line each."""
    if follow and len(folders or ()) != 1:
        raise ConfigError(f"--follow: needs exactly one folder, got {len(folders or ())}; give one, or omit --follow")
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


def digest_(
    folder: RunArgument,
    parts: Annotated[bool, typer.Option("--parts", help="Also print a line for each part of the run.")] = False,
) -> None:
    """Check all data of a run and print a SHA-256 of everything deterministic in it."""
    found, mixed = digest.checked_parts(folder)
    if parts:
        for name, value in found.items():
            print(f"{value}  {name}")
    print(f"{digest.digest_of(found)}{'  mixed' if mixed else ''}")


def config_(
    name: Annotated[str, typer.Argument(help="Name of a shipped config, as `list` shows it.", show_default=False)],
) -> None:
    """Print a shipped config, which you can save as a file and edit."""
    print(shipped_text(name), end="")


def list_() -> None:
    """Show tasks, algorithms, presets and shipped configs."""
    print_catalogue(console, TASKS)
