"""The commands `report` and `export`: what runs found, as pages and figures, and as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from es_service import api
from es_service.cli.commands import command
from es_service.cli.options import RunArgument, place_of, print_note
from es_service.errors import ConfigError


def report(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File to write; default for one run: report.html in its folder."),
    ] = None,
    replay: Annotated[
        list[str] | None,
        typer.Option(
            "--replay",
            metavar="best|I,J|none",
            help="Replay the best centre (default, unless this executes code of a user), a cell's elite, or none; "
            "can be repeated.",
        ),
    ] = None,
    group_by: Annotated[
        list[str] | None,
        typer.Option("--group-by", metavar="KEY", help="Compare groups with equal values of a key; can be repeated."),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option("--threshold", help="Fitness from which a compared run is solved; default: its target fitness."),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Also write each figure as SVG and PNG.")
    ] = None,
) -> None:
    """Write a page about a run: its curves, its map, its policies; or a page that compares several runs."""
    from es_service.report.write import write_comparison, write_report

    if len(folders) > 1:
        if replay:
            raise ConfigError("--replay: shows policies of one run; give one run, or leave it out")
        if out is None:
            raise ConfigError("a comparison of runs belongs to none of their folders; add --out FILE")
        for file in write_comparison(folders, out, group_by or (), threshold, figures):
            print(file)
        return
    if group_by or threshold is not None:
        print_note("note: --group-by and --threshold have no effect with one run")
    [folder] = folders
    wanted = list(dict.fromkeys(replay or ["best"]))
    if "none" in wanted and len(wanted) > 1:
        raise ConfigError("--replay none cannot be combined with other replays; leave it out")
    cells = [place_of(text, "--replay") for text in wanted if text not in ("best", "none")]

    def evaluate(name: str) -> str:
        return command("evaluate", folder, *(["--best"] if name == "best" else ["--cell", name]))

    for file in write_report(
        folder,
        out,
        best="best" in wanted,
        cells=cells,
        trusted=replay is not None,
        evaluate=evaluate,
        figures=figures,
    ):
        print(file)


def export(
    folder: RunArgument,
    to: Annotated[
        str, typer.Option("--to", help="Format: csv, parquet, npz, ribs or tensorboard.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write into; default: RUN/export.")] = None,
) -> None:
    """Write history, novelty archive and behaviour map as tables, the policies as arrays, or the history as events."""
    from es_service.runs.export import export as write

    for file in write(api.open_run(folder), to, out if out is not None else folder / "export"):
        print(file)
