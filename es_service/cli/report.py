"""The command `report`: what a run found, as a page that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from es_service.cli.commands import command


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write; default: report.html in the run's folder.")
    ] = None,
) -> None:
    """Write a page with the curves, the behaviour map and the policies of a run."""
    from es_service.report.write import write_report

    def evaluate(name: str) -> str:
        return command("evaluate", folder, *(["--best"] if name == "best" else ["--cell", name]))

    print(write_report(folder, out, evaluate))
