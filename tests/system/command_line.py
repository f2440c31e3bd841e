"""`es-service` as a user types it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.system.session import ROOT

PROGRAM = Path(sys.executable).with_name("es-service")
COMMAND = [str(PROGRAM)]


def es(*arguments, cwd=ROOT, **environment):
    """Run `es-service ...` to its end: (exit code, all it printed, without line breaks inside paragraphs)."""
    result = subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert "Traceback" not in result.stderr, result.stderr
    return result.returncode, result.stdout + result.stderr


def digest(folder):
    code, printed = es("digest", folder)
    assert code == 0, printed
    return printed.strip()
