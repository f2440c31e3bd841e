"""Entry point of `es-service` and `python -m es_service`.

It installs signal handlers before it imports the rest, because the imports take half a second, in which Ctrl-C should
not cause a traceback.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import TYPE_CHECKING

from es_service.errors import Interrupted
from es_service.runs.signals import interrupt

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


def main() -> None:
    """Run the command line; SIGINT and SIGTERM at any moment end it with exit code 128 + n."""
    sys.unraisablehook = report_ignored
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    try:
        from es_service.cli.main import main as run_command

        run_command()
    except Interrupted as stop:
        # All is closed and reported. Python's own exit crashes if the signal arrived while Ray had its handlers set.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(128 + stop.signal_number)


def report_ignored(ignored: UnraisableHookArgs) -> None:
    """Hook for exceptions that Python ignores, as in a callback of its imports: an interruption is not reported,
    because `interrupt` has kept it and the program ends by it."""
    if not isinstance(ignored.exc_value, Interrupted):
        sys.__unraisablehook__(ignored)


if __name__ == "__main__":
    main()
