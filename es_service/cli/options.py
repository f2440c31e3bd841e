"""Options that several commands share, the config keys that they set, and the printing of notes, findings, errors."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from es_service.cli.commands import assignments, error_message
from es_service.cli.console import console, errors, print_line
from es_service.config.given import Source
from es_service.config.model import RunConfig, implied_by
from es_service.config.tasks import ROLLOUTS, task_of
from es_service.config.text import show
from es_service.config.workload import config_warnings
from es_service.errors import ConfigError, ServiceError
from es_service.logs import FORMAT
from es_service.protocol.system import given_path

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
AddressOption = Annotated[
    str | None, typer.Option("--address", help="Ray cluster to join: HOST:PORT, or auto. Implies --engine ray.")
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


def print_note(message: str, style: str | None = None) -> None:
    """Print a line that is not a result to stderr. If stderr is closed, rich raises SystemExit, which is ignored."""
    with contextlib.suppress(SystemExit):
        print_line(errors, message, style)


def print_finding(level: str, text: str) -> None:
    """Print a finding of `doctor`, whose level is "ok", "note" or "FAIL", on stdout."""
    colour = {"ok": "green", "note": "yellow", "FAIL": "red"}[level]
    console.print(f"{level:>4}", style=colour, end="  ")
    print_line(console, text)


def print_error(error: ServiceError | str) -> None:
    """Print an error message and its ways out."""
    message = error_message(error) if isinstance(error, ServiceError) else error
    print_note(f"error: {message}", style="red")


def print_config_notes(source: Source, configs: Sequence[RunConfig]) -> None:
    """Print what a user should know before a run about configs made from `source` by overrides: ignored keys, values
    that stay although another method has other defaults, and settings that are probably not intended. What several
    configs have in common is printed once."""
    notes: dict[str, None] = {}
    for config in configs:
        left_out = config.made.left_out
        for why in dict.fromkeys(left_out.values()):
            keys = [key for key in left_out if left_out[key] == why]
            notes[f"ignored {', '.join(keys)} of {source}, since {why}"] = None
        stays: dict[str, list[str]] = {}
        for key, value in config.made.kept.items():
            words = f"{key} = {show(value.value)} (by default {show(value.default)})"
            stays.setdefault(value.why, []).append(words)
        for why, words in stays.items():
            notes[f"kept {', '.join(words)} of {source}, although {why}"] = None
        notes |= dict.fromkeys(config_warnings(config, task_of(config), ROLLOUTS))
    for note in notes:
        print_note(f"note: {note}")


def place_of(text: str, option: str = "--cell") -> tuple[int, ...]:
    """Place of a cell, parsed from text such as 3,17."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} {text}: must be whole numbers separated by commas, such as 3,17") from None
