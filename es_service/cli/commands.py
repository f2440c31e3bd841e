"""Commands as messages show them, and errors with their ways out as commands."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from es_service.config.compute import ENGINE_IMPLIES
from es_service.config.yaml_text import in_line
from es_service.errors import ServiceError, WayOut

PROGRAM = "es-service"


def command(*words: object) -> str:
    """A command of this program that can be copied into a shell, whatever its words contain: a folder's name may have
    spaces."""
    return shlex.join([*_program(), *map(str, words)])


def assignments(values: Mapping[str, Any]) -> list[str]:
    """Overrides that set these keys: "search.sigma=0.05"."""
    return [f"{key}={in_line(value)}" for key, value in values.items()]


def settings(values: Mapping[str, Any]) -> list[str]:
    """Options of a command that set these keys."""
    options, engine = [], values.get("compute.engine")
    if engine in ENGINE_IMPLIES:  # an option that says the rest as well
        options = ["--engine", engine]
        implied = {"compute.engine": engine} | ENGINE_IMPLIES[engine]
        values = {key: value for key, value in values.items() if key not in implied or implied[key] != value}
    return [*options, *(word for assignment in assignments(values) for word in ("--set", assignment))]


def way_command(way: WayOut) -> str:
    """The command that is a way out."""
    folder = way.run or "RUN"
    match way.action:
        case "install":
            return way.call()
        case "watch":
            return command("status", folder, "--follow")
        case "run":
            return command("run", "CONFIG", *(["--out", way.out] if way.out else []), *settings(way.settings))
    return command(way.action, folder, *settings(way.settings))


def error_message(error: ServiceError) -> str:
    """What an error says, and its ways out as commands, a line each."""
    ways = [f"  to {way.purpose}: {way_command(way)}" for way in error.ways_out]
    return "\n".join([error.sentence, *ways])


def _program() -> list[str]:
    """What the shell starts this program by: its name may not be in PATH, as after `make run`."""
    if shutil.which(PROGRAM):
        return [PROGRAM]
    python = Path(sys.executable or "python")  # a program that has Python inside may not know one
    script = python.with_name(PROGRAM)
    return [str(script)] if script.exists() else [str(python), "-m", "es_service"]
