"""Commands as messages show them."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from es_service.config.yaml_text import show

PROGRAM = "es-service"


def command(*words: object) -> str:
    """A command of this program that can be copied into a shell, whatever its words contain: a folder's name may have
    spaces."""
    return shlex.join([*_program(), *map(str, words)])


def settings(values: Mapping[str, Any]) -> list[str]:
    """Options of a command that set these keys."""
    return [word for key, value in values.items() for word in ("--set", f"{key}={show(value)}")]


def install_command(extra: str) -> str:
    """How to get what an extra of this package names; no package index has es-service itself, so from a clone."""
    return f"in a clone of es-service: {shlex.join(['pip', 'install', '-c', 'constraints.txt', '-e', f'.[{extra}]'])}"


def _program() -> list[str]:
    """What the shell starts this program by: its name may not be in PATH, as after `make run`."""
    if shutil.which(PROGRAM):
        return [PROGRAM]
    python = Path(sys.executable or "python")  # a program that has Python inside may not know one
    script = python.with_name(PROGRAM)
    return [str(script)] if script.exists() else [str(python), "-m", "es_service"]
