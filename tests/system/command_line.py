"""`es-service` as a user types it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from es_service.store.digest import checked_parts, digest_of
from tests.system import warm
from tests.system.processes import ROOT

PROGRAM = Path(sys.executable).with_name("es-service")
COMPILES = ("note: compiling ", "note: loading compiled code ")
"""Beginnings of notes that a run prints on a busy machine only."""


def command(*arguments: object, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `es-service ...` to its end, which is no traceback; in a process that is not warm if variables are given."""
    words = [str(PROGRAM), *map(str, arguments)]
    if environment:
        everything = {**os.environ, **environment}
        result = subprocess.run(
            words, cwd=cwd, env=everything, capture_output=True, text=True, timeout=600, check=False
        )
    else:
        result = warm.run(words, cwd, os.environ)
    assert "Traceback" not in result.stderr, result.stderr
    return result


def es(*arguments: object, cwd: Path = ROOT, **environment: str) -> tuple[int, str]:
    """The same: (exit code, all it printed)."""
    result = command(*arguments, cwd=cwd, **environment)
    return result.returncode, result.stdout + result.stderr


def digest(folder: Path) -> str:
    """What `es-service digest` prints, which `test_json.py` compares with it, without a process for it."""
    found, mixed = checked_parts(folder)
    return digest_of(found) + ("  mixed" if mixed else "")
