"""The command `report`: what a run found, as a page that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from es_service.cli.commands import command
from es_service.cli.options import place_of
from es_service.errors import ConfigError


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write; default: report.html in the run's folder.")
    ] = None,
    replay: Annotated[
        list[str] | None,
        typer.Option(
            "--replay",
            metavar="best|I,J|none",
            help="Replay the best centre (default), a cell's elite, or none; can be repeated.",
        ),
    ] = None,
) -> None:
    """Write a page with the curves, the behaviour map and the policies of a run."""
    from es_service.report.write import write_report

    wanted = list(dict.fromkeys(replay or ["best"]))
    if "none" in wanted and len(wanted) > 1:
        raise ConfigError("--replay none cannot be combined with other replays; leave it out")
    cells = [place_of(text, "--replay") for text in wanted if text not in ("best", "none")]

    def evaluate(name: str) -> str:
        return command("evaluate", folder, *(["--best"] if name == "best" else ["--cell", name]))

    print(write_report(folder, out, best="best" in wanted, cells=cells, evaluate=evaluate))
