"""Commands as messages show them."""

from __future__ import annotations

import shlex


def command(*words: object, program: str = "es-service") -> str:
    """A command that can be copied into a shell, whatever its words contain: a folder's name may have spaces."""
    return shlex.join([program, *map(str, words)])
