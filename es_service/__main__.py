"""Entry point of `es-service` and `python -m es_service`: signals first, everything else after.

Importing takes half a second; a Ctrl-C in it should not end in a traceback either.
"""

from __future__ import annotations

import signal
import sys

from es_service.errors import Interrupted
from es_service.signals import interrupt


def main() -> None:
    """Run the command line; SIGINT and SIGTERM at any moment end it with exit code 128 + n."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    try:
        from es_service.cli import main as run_command

        run_command()
    except Interrupted as stop:
        sys.exit(128 + stop.signal_number)


if __name__ == "__main__":
    main()
