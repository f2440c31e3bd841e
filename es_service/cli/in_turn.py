"""A process that runs commands of this program one after another, with workers that stay from one to the next.

python -m es_service.cli.in_turn DESCRIPTOR     # run by `es_service.runs.sweep`
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence

from es_service.__main__ import report_ignored
from es_service.cli.main import main
from es_service.dispatch.staying import workers
from es_service.errors import Interrupted
from es_service.protocol.child import answer_parent
from es_service.runs.signals import EARLY, interrupt


def commands(program: str) -> Callable[[Sequence[str], str], int]:
    """Function that runs a command, given as its words, and returns its exit code. What is printed is appended to a
    file from then on."""
    sys.unraisablehook = report_ignored
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)

    def run(words: Sequence[str], log: str) -> int:
        with open(log, "ab", buffering=0) as file:
            for stream in (sys.stdout, sys.stderr):
                os.dup2(file.fileno(), stream.fileno())
        sys.argv = [program, *words]
        EARLY.number = None  # a signal was for the command before
        try:
            main()
        except SystemExit as ended:
            return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
        except Interrupted as stop:
            return 128 + stop.signal_number
        except Exception:  # a bug
            traceback.print_exc()
            return 1
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
        return 0

    return run


if __name__ == "__main__":
    with workers():
        answer_parent(int(sys.argv[1]), commands)
