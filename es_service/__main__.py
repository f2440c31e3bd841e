"""Entry point of `es-service` and `python -m es_service`: signals first, everything else after.

Importing takes half a second; a Ctrl-C in it should not end in a traceback either.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys

from es_service.errors import Interrupted
from es_service.runs.signals import interrupt


def main() -> None:
    """Run the command line; SIGINT and SIGTERM at any moment end it with exit code 128 + n."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    try:
        from es_service.cli.main import main as run_command

        run_command()
    except Interrupted as stop:
        # All is closed and told. Python's own end crashes where the signal met Ray while Ray's handlers were in force.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(128 + stop.signal_number)


if __name__ == "__main__":
    main()
