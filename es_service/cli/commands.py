"""Shell commands as messages show them, and error messages with their ways out as shell commands."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from es_service.config.model import implied_by
from es_service.config.text import in_line
from es_service.errors import ServiceError, WayOut

PROGRAM = "es-service"


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
    """The shell command of a way out."""
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
