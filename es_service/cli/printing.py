"""What commands print: shell commands in messages, errors with their ways out, notes, findings and JSON.

Names, values and errors of a user are printed as they are: nothing in them is taken for a style or an emoji.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from es_service.config.given import Source
from es_service.config.model import RunConfig, implied_by
from es_service.config.tasks import ROLLOUTS, task_of
from es_service.config.text import in_line, show
from es_service.config.workload import config_warnings
from es_service.errors import ServiceError, WayOut

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
