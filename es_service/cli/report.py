"""The commands `report` and `export`: what runs found, as pages and figures, and as files for other programs; and
`watch`, the live page of runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from es_service import api
from es_service.cli.common import (
    BoundsOption,
    RunArgument,
    RunsArgument,
    bounds_of,
    evaluation_of,
    is_single,
    of_each,
    place_of,
    print_note,
    readable,
)
from es_service.errors import ConfigError, WayOut
from es_service.protocol.machine import given_path

if TYPE_CHECKING:
    from es_service.report.data import RunData

DEFAULT_AXIS = "env_steps"


def report(
    folders: RunsArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", parser=given_path, help="File to write; default for one run or sweep: report.html in its folder."
        ),
    ] = None,
    replay: Annotated[
        list[str] | None,
        typer.Option(
            "--replay",
            metavar="best|certified|I,J|none",
            help="Replay the best centre and the certified policy (default, unless this executes code of a user), a "
            "cell's elite, or none; can be repeated.",
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
        Path | None,
        typer.Option("--figures", parser=given_path, metavar="DIR", help="Also write each figure as SVG, PDF and PNG."),
    ] = None,
    paired: Annotated[
        bool, typer.Option("--paired", help="Test groups of compared runs by pairs of equal seeds.")
    ] = False,
    bounds: BoundsOption = None,
    label: Annotated[
        list[str] | None,
        typer.Option("--label", metavar="GROUP=TEXT", help="Show a group under another name; can be repeated."),
    ] = None,
    metric: Annotated[
        list[str] | None,
        typer.Option("--metric", metavar="NAME", help="Column of --figures and --statistics; can be repeated."),
    ] = None,
    against: Annotated[
        str,
        typer.Option(
            "--against",
            metavar="COLUMN",
            help="Axis of the curves of --figures: env_steps, generation, wall_clock_s, rollout_s or cpu_s.",
        ),
    ] = DEFAULT_AXIS,
    statistics: Annotated[
        Path | None,
        typer.Option(
            "--statistics",
            parser=given_path,
            metavar="FILE",
            help="Also write the statistics between groups, as FILE.json, .csv or .tex.",
        ),
    ] = None,
) -> None:
    """Write a page about a run: its curves, its map, its policies; or one that compares several runs, or a sweep."""
    from es_service.report.write import REPORT, write_report

    ignored = {
        f"--against {against}": against != DEFAULT_AXIS,
        f"--metric {(metric or [None])[0]}": metric and statistics is None,
    }
    if figures is None and (options := [option for option, is_given in ignored.items() if is_given]):
        raise ConfigError(f"{options[0]} is for figures; add --figures DIR, or leave it out")
    if not is_single(folders):
        if replay:
            raise ConfigError("--replay: shows policies of one run; give one run, or leave it out")
        if out is None and len(folders) > 1:
            raise ConfigError("a comparison of runs belongs to none of their folders; add --out FILE")
        drawn = figures, metric or (), against
        how = _How(group_by or (), threshold, paired, statistics, bounds_of(bounds or ()), label or (), *drawn)
        _compare(folders, out or folders[0] / REPORT, how)
        return
    if group_by or threshold is not None or paired or statistics or bounds or label:
        of_several = "--group-by, --threshold, --paired, --bounds, --label and --statistics"
        print_note(f"note: {of_several} have no effect with one run")
    [folder] = folders
    wanted = list(dict.fromkeys(replay or ["best"]))
    if "none" in wanted and len(wanted) > 1:
        raise ConfigError("--replay none cannot be combined with other replays; leave it out")
    cells = [place_of(text, "--replay") for text in wanted if text not in ("best", "certified", "none")]

    for file in write_report(
        folder,
        out,
        best="best" in wanted,
        certified="certified" in wanted if replay else None,
        cells=cells,
        trusted=replay is not None,
        evaluate=evaluation_of(folder),
        figures=figures,
        metrics=metric or (),
        against=against,
    ):
        print(file)


class _How(NamedTuple):
    group_by: Sequence[str]
    threshold: float | None
    paired: bool
    statistics: Path | None
    bounds: dict[str, tuple[float, float]]
    labels: Sequence[str]
    figures: Path | None
    metrics: Sequence[str]
    against: str


def _compare(folders: Sequence[Path], out: Path, how: _How) -> None:
    """Write the comparison of all runs with a finished generation; exit with code 1 if a run cannot be read."""
    from es_service.report.compare import GROUP, labelled, normalised, swept_keys
    from es_service.report.write import read_compared, write_comparison

    problems: list[dict[str, str]] = []

    def comparable() -> Iterator[RunData]:
        for folder, data in readable(of_each(folders, read_compared), problems):
            if data.history["generation"].size:
                yield data
            else:
                print_note(f"note: {folder} is left out, since it has no finished generation yet")

    runs, group_by = normalised(list(comparable()), how.bounds), how.group_by
    if len(folders) == 1 and not group_by and not all(run.group for run in runs):
        group_by = swept_keys(runs)
    if how.labels:
        runs, group_by = labelled(runs, group_by, dict(_pair(word) for word in how.labels)), GROUP
    for file in write_comparison(
        runs,
        out,
        group_by,
        how.threshold,
        how.figures,
        paired=how.paired,
        statistics=how.statistics,
        metrics=how.metrics,
        against=how.against,
    ):
        print(file)
    if problems:
        raise typer.Exit(1)


def _pair(word: str) -> tuple[str, str]:
    name, equals, text = word.rpartition("=")
    if not equals or not text:
        raise ConfigError(f"--label {word}: write GROUP=TEXT", field="label", value=word)
    return name.strip(), text.strip()


def export(
    folder: RunArgument,
    to: Annotated[
        str, typer.Option("--to", help="Format: csv, parquet, npz, onnx, ribs or tensorboard.", show_default=False)
    ],
    out: Annotated[
        Path | None, typer.Option("--out", parser=given_path, help="Folder to write into; default: RUN/export.")
    ] = None,
) -> None:
    """Write history, novelty archive and map as tables, policies as arrays or models, or the history as events."""
    from es_service.runs.export import export as write

    for file in write(api.open_run(folder), to, out if out is not None else folder / "export"):
        print(file)


def watch(
    folders: Annotated[
        list[Path],
        typer.Argument(
            parser=given_path, metavar="FOLDER...", help="Folders with runs below them.", show_default=False
        ),
    ],
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; another than this machine's own needs a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on; 0 for a free one.")] = 8642,
    trust: Annotated[
        bool, typer.Option("--trust", help="Let replays execute code of users that configs of the runs name.")
    ] = False,
) -> None:
    """Serve a page that shows all runs below some folders while they run; Ctrl-C ends it."""
    try:
        from es_service.watch.server import serve
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        ways_out = [WayOut("install", "install it", extra="watch")]
        raise ConfigError(f"watch needs {error.name}", field="watch", ways_out=ways_out) from error
    for folder in folders:
        if not folder.exists():
            print_note(f"note: {folder} does not exist yet")
        elif not folder.is_dir():
            raise ConfigError(f"{folder} is a file; give the folder of a run, or one that contains runs")

    def show(address: str) -> None:
        print(address, flush=True)
        if "?token=" in address:
            print_note("note: whoever has this address can see the page, and have replays recorded; it is not shown "
                       "again. It is sent without encryption.")  # fmt: skip

    serve(folders, evaluation_of, show, host=host, port=port, trusted=trust)
