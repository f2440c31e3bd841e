"""SIGINT and SIGTERM as requests to stop: the first takes effect at the next wait, a later one exits at once."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from es_service.errors import Interrupted

REPEAT_S = 1.0
"""A second signal within this time is the same request: launchers forward a signal that the terminal also sent."""
SHOW_CURSOR = b"\x1b[?25h\n"
"""Shows the terminal's cursor, which a live table hides and an immediate exit would not restore."""


class StopRequest:
    """Holds the signal that asked to stop, if any. Calling it returns the number or None."""

    def __init__(self) -> None:
        self.number: int | None = None
        self._since_s = 0.0

    def __call__(self) -> int | None:
        return self.number

    def handle(self, number: int, frame: object) -> None:
        """Signal handler: remember the first request, so that a transaction is finished first; exit on a later one."""
        now = time.monotonic()
        if self.number is None:
            self.number, self._since_s = number, now
        elif now - self._since_s > REPEAT_S:  # a later request; committed generations are safe
            with suppress(OSError):
                if os.isatty(1):
                    os.write(1, SHOW_CURSOR)
            os._exit(128 + number)


EARLY = StopRequest()
"""Holds a signal that arrived before any work had begun."""


def interrupt(number: int, frame: object) -> None:
    """Signal handler before any work has begun: raise Interrupted. An import may catch and ignore the exception, so
    the signal is also kept for the next `stop_on_signals`."""
    EARLY.number = number
    raise Interrupted(number)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Catch SIGINT and SIGTERM inside the block. In other threads, Python cannot catch them, nor a signal whose handler
    is not Python's.

    Where a command has installed `interrupt`, the next block begins with the signal of one that has ended since.
    """
    request = StopRequest()
    request.number = EARLY.number
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in before.items() if handler is not None}
    for number in before:
        signal.signal(number, request.handle)
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if request.number is not None and before.get(signal.Signals(request.number)) is interrupt:
        EARLY.number = request.number
