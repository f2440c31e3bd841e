"""`es-service` as a user types it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.system.processes import ROOT

PROGRAM = Path(sys.executable).with_name("es-service")


def command(*arguments: object, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `es-service ...` to its end, which is no traceback."""
    result = subprocess.run(
        [PROGRAM, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert "Traceback" not in result.stderr, result.stderr
    return result


def es(*arguments: object, cwd: Path = ROOT, **environment: str) -> tuple[int, str]:
    """The same: (exit code, all it printed)."""
    result = command(*arguments, cwd=cwd, **environment)
    return result.returncode, result.stdout + result.stderr


def digest(folder):
    code, printed = es("digest", folder)
    assert code == 0, printed
    return printed.strip()
