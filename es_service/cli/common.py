"""Options that several commands share, and what commands print.

A command that takes several runs gets folders of runs or of sweeps, of which each run is read by itself, so that one
that is damaged hides no other.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import typer
from rich.console import Console

from es_service.config.given import Source
from es_service.config.model import RunConfig, implied_by
from es_service.config.tasks import ROLLOUTS, task_of
from es_service.config.text import in_line, show
from es_service.config.workload import config_warnings
from es_service.errors import ConfigError, ServiceError, WayOut
from es_service.logs import FORMAT
from es_service.protocol.machine import given_path
from es_service.runs.run_status import runs_of
from es_service.store.folder import holds_run

# What commands print: shell commands in messages, errors with their ways out, notes, findings and JSON.
#
# Names, values and errors of a user are printed as they are: nothing in them is taken for a style or an emoji.

PROGRAM = "es-service"


def text_console(*, stderr: bool = False, width: int | None = None) -> Console:
    """A console that prints text as it is; `width` is that of the terminal by default."""
    return Console(stderr=stderr, width=width, markup=False, emoji=False, highlight=False)


console = text_console()
errors = text_console(stderr=True)


def print_line(console: Console, text: str, style: str | None = None) -> None:
    """Print text without wrapping or cutting its lines, so that folders and commands can be copied."""
    console.print(text, style=style, soft_wrap=True)


def command(*words: object) -> str:
    """A command of this program, quoted so that it can be copied into a shell: a folder's name may contain spaces."""
    return shlex.join([*_program(), *map(str, words)])


def evaluation_of(folder: Path) -> Callable[[str], str]:
    """Function from the name of a policy of a run, "best" or a cell, to the command that evaluates it."""
    return lambda name: command("evaluate", folder, *(["--best"] if name == "best" else ["--cell", name]))


def assignments(values: Mapping[str, Any]) -> list[str]:
    """Overrides that set these keys, such as "search.sigma=0.05"."""
    return [f"{key}={in_line(value)}" for key, value in values.items()]


def settings(values: Mapping[str, Any]) -> list[str]:
    """Command-line options that set these keys."""
    engine, address = values.get("compute.engine"), values.get("compute.address")
    options, given = [], {}
    if address is not None:
        options, given = ["--address", address], {"compute.address": address} | implied_by(None, address)
    elif engine is not None:
        options, given = ["--engine", engine], {"compute.engine": engine} | implied_by(engine, None)
    # An option also sets the keys that it implies.
    values = {key: value for key, value in values.items() if key not in given or given[key] != value}
    return [*options, *(word for assignment in assignments(values) for word in ("--set", assignment))]


def way_command(way: WayOut) -> str:
    folder, out = way.run or "RUN", ["--out", way.out] if way.out else []
    match way.action:
        case "install":
            return way.call()
        case "ask_tell":
            return f"{way.call()} in the program that computes the episodes"
        case "watch":
            return command("status", folder, "--follow")
        case "report":
            return command("report", folder, "--out", way.out)
        case "certify":
            return command("evaluate", folder, "--certify")
        case "run":
            return command("run", way.config or "CONFIG", *out, *settings(way.settings))
    generation = [] if way.generation is None else ["--generation", way.generation]
    return command(way.action, folder, *generation, *out, *settings(way.settings))


def error_message(error: ServiceError) -> str:
    """The sentence of an error, and its ways out as shell commands, one per line."""
    ways = [f"  to {way.purpose}: {way_command(way)}" for way in error.ways_out]
    return "\n".join([error.sentence, *ways])


def _program() -> list[str]:
    """The words that start this program in a shell. Its name may be missing from PATH, as after `make run`."""
    if shutil.which(PROGRAM):
        return [PROGRAM]
    python = Path(sys.executable or "python")  # empty in a program that embeds Python
    script = python.with_name(PROGRAM)
    return [str(script)] if script.exists() else [str(python), "-m", "es_service"]


def print_note(message: str, style: str | None = None) -> None:
    """Print a line that is not a result to stderr. If stderr is closed, rich raises SystemExit, which is ignored."""
    with contextlib.suppress(SystemExit):
        print_line(errors, message, style)


def output_shown(wanted: bool) -> Callable[[str], None]:
    """What `--show-output` does with the lines that workers print."""
    return print_note if wanted else lambda line: None


def print_finding(level: str, text: str) -> None:
    """Print a finding of `doctor`, whose level is "ok", "note" or "FAIL", on stdout."""
    colour = {"ok": "green", "note": "yellow", "FAIL": "red"}[level]
    console.print(f"{level:>4}", style=colour, end="  ")
    print_line(console, text)


def print_error(error: ServiceError | str) -> None:
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


def print_json(value: object) -> None:
    print(json.dumps(_finite(value), indent=1, allow_nan=False))


def print_json_line(value: object) -> None:
    """Print a value as one line of JSON on stdout, where whoever reads it gets it at once. If stdout is closed,
    SystemExit is raised, as rich does it, and later lines go nowhere."""
    try:
        print(json.dumps(_finite(value), allow_nan=False), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python would say so again at its end
        raise SystemExit(1) from None


def _finite(value: Any) -> Any:
    """The value with null for each number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


ConfigArgument = Annotated[
    Path, typer.Argument(parser=given_path, help="YAML file, or the name of a shipped config.", show_default=False)
]
RunArgument = Annotated[
    Path, typer.Argument(parser=given_path, metavar="RUN", help="Folder of a run.", show_default=False)
]
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


BoundsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--bounds",
        metavar="TASK=LOW,HIGH",
        help="Compare runs of several tasks: fitness of a task that counts as 0 and as 1; for each of them.",
    ),
]
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


def bounds_of(words: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Bounds by task, from words such as "point_maze=-130,-25"."""
    found = {}
    for word in words:
        task, _, ends = word.rpartition("=")
        try:
            low, high = map(float, ends.split(","))
            if not task or not math.isfinite(low) or not math.isfinite(high):
                raise ValueError
            found[task] = low, high
        except ValueError:
            what = f"--bounds {word}: write TASK=LOW,HIGH, such as point_maze=-130,-25"
            raise ConfigError(what, field="bounds", value=word) from None
    return found
