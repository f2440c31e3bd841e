"""Options that several commands share, and the config keys that they set.

A command that takes several runs gets folders of runs or of sweeps, of which each run is read by itself, so that one
that is damaged hides no other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer

from es_service.cli.printing import assignments, error_message, print_error, print_note
from es_service.config.model import implied_by
from es_service.errors import ConfigError, ServiceError
from es_service.logs import FORMAT
from es_service.protocol.system import given_path
from es_service.runs.folders import runs_of
from es_service.store.folder import holds_run

ConfigArgument = Annotated[
    Path, typer.Argument(parser=given_path, help="YAML file, or the name of a shipped config.", show_default=False)
]
RunArgument = Annotated[Path, typer.Argument(parser=given_path, help="Folder of a run.", show_default=False)]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one key, e.g. search.sigma=0.05.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", parser=given_path, help="Folder of the new run; default: a new one under runs/.")
]
OrResumeOption = Annotated[
    bool, typer.Option("--or-resume", help="Resume the run if the --out folder already holds it.")
]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of all random numbers.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", help="Number of workers; default: as configured.")]
EngineOption = Annotated[str | None, typer.Option("--engine", help="What runs the workers: inline or ray.")]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Refuse to continue with other code, packages or kind of processor.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
LinesOption = Annotated[bool, typer.Option("--json", help="Print JSON, a line for each row, instead of text.")]
AddressOption = Annotated[
    str | None, typer.Option("--address", help="Ray cluster to join: HOST:PORT, or auto. Implies --engine ray.")
]


ShowOutputOption = Annotated[
    bool, typer.Option("--show-output", help="Print what workers print, simulators included, on stderr.")
]
LogOption = Annotated[
    list[str] | None,
    typer.Option(
        "--log",
        metavar="TRACKER",
        help="Send the history to tensorboard, wandb or mlflow; can be repeated.",
        show_default=False,
    ),
]


class _NoteHandler(logging.Handler):
    """Prints a log record on stderr, above a live table if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        print_note(self.format(record))


def _print_log(level: str | None) -> str | None:
    """Print the log records of es_service from a level on; none without a level. Returns the value of the option."""
    if level is not None:
        handler = _NoteHandler(level.upper())
        handler.setFormatter(logging.Formatter(FORMAT))
        log = logging.getLogger("es_service")
        log.addHandler(handler)
        log.setLevel(level.upper())
    return level


LogLevelOption = Annotated[
    Literal["debug", "info", "warning", "error"] | None,
    typer.Option(
        "--log-level",
        callback=_print_log,
        help="Print log records from this level up on stderr.",
        show_default=False,
    ),
]


def overrides(
    set_: list[str] | None,
    *,
    seed: int | None = None,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
) -> list[str]:
    """Overrides for the keys that options imply, then for `--set`, then for the keys that options name; later ones win.

    The implied keys replace the cluster settings of the config file or of the resumed run. A `--set` that contradicts
    them stays in force, so that the checks of the config refuse the combination.
    """
    named = {"seed": seed, "compute.workers": workers, "compute.engine": engine, "compute.address": address}
    options = {key: value for key, value in named.items() if value is not None}
    return [*assignments(implied_by(engine, address)), *(set_ or []), *assignments(options)]


def place_of(text: str, option: str = "--cell") -> tuple[int, ...]:
    """Place of a cell, parsed from text such as 3,17."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} {text}: must be whole numbers separated by commas, such as 3,17") from None


RunsArgument = Annotated[
    list[Path],
    typer.Argument(parser=given_path, metavar="RUN...", help="Folders of runs or of sweeps.", show_default=False),
]
T = TypeVar("T")


def is_single(folders: Sequence[Path]) -> bool:
    """Whether the folders of a command are one run; if not, its output names each run."""
    return len(folders) == 1 and runs_of(folders[0]) == [folders[0]]


def of_each(folders: Sequence[Path], read: Callable[[Path], T]) -> Iterator[tuple[Path, T | ServiceError | None]]:
    """What is read of each run in some folders: (its folder, the result). The result is the error if a run cannot be
    read, and None if it is one that its sweep has not started."""
    return items_of_each(folders, lambda run: [read(run)])


def items_of_each(
    folders: Sequence[Path], read: Callable[[Path], Iterable[T]]
) -> Iterator[tuple[Path, T | ServiceError | None]]:
    """The same for several results of each run, each of which is passed on before the next is read."""
    for folder in folders:
        try:
            runs = runs_of(folder)
        except ServiceError as error:
            yield folder, error
            continue
        for run in runs:
            try:
                waits = run != folder and not holds_run(run)
                for result in [None] if waits else read(run):
                    yield run, result
            except ServiceError as error:
                yield run, error


def readable(
    each: Iterable[tuple[Path, T | ServiceError | None]], problems: list[dict[str, str]]
) -> Iterator[tuple[Path, T]]:
    """The results of the runs that can be read. The others are named on stderr at once.

    Args:
        each: what `of_each` or `items_of_each` returns.
        problems: gets what `--json` prints of each run that cannot be read.
    """
    for folder, result in each:
        if result is None:
            print_note(f"note: {folder} has not started")
        elif isinstance(result, ServiceError):
            message = error_message(result)
            print_error(message if str(folder) in message else f"{folder}: {message}")
            problems.append(problem_data(folder, result))
        else:
            yield folder, result


def problem_data(folder: Path, error: ServiceError) -> dict[str, str]:
    """What `--json` prints of a run that cannot be read."""
    return {"run": str(folder), "error": error.sentence}
