"""Commands that take several runs: folders of runs or of sweeps, of which each run is read by itself, so that one that
is damaged hides no other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from es_service.cli.commands import error_message
from es_service.cli.options import print_error, print_note
from es_service.errors import ServiceError
from es_service.protocol.system import given_path
from es_service.runs.folders import runs_of
from es_service.store.folder import holds_run

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
