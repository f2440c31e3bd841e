"""Commands as messages show them."""

from __future__ import annotations

import shlex


def command(*words: object, program: str = "es-service") -> str:
    """A command that can be copied into a shell, whatever its words contain: a folder's name may have spaces."""
    return shlex.join([program, *map(str, words)])


def install_command(extra: str) -> str:
    """How to get what an extra of this package names; no package index has es-service itself, so from a clone."""
    return (
        f"in a clone of es-service: {command('install', '-c', 'constraints.txt', '-e', f'.[{extra}]', program='pip')}"
    )
