"""SIGINT and SIGTERM as a request: the first is noticed at the next wait, a later one ends the process at once."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from es_service.errors import Interrupted

REPEAT_S = 1.0
"""A second signal within this time is the same request: launchers forward what the terminal has sent already."""
SHOW_CURSOR = b"\x1b[?25h\n"
"""A live table hides the cursor, and at once means without putting anything back."""


class StopRequest:
    """Holds the signal that asked to stop, if any. Calling it returns the number or None."""

    def __init__(self) -> None:
        self.number: int | None = None
        self._since_s = 0.0

    def __call__(self) -> int | None:
        return self.number

    def handle(self, number: int, frame: object) -> None:
        """Signal handler. Nothing is interrupted half-way: a transaction in hand is finished first."""
        now = time.monotonic()
        if self.number is None:
            self.number, self._since_s = number, now
        elif now - self._since_s > REPEAT_S:  # asked again; what is committed is safe
            with suppress(OSError):
                if os.isatty(1):
                    os.write(1, SHOW_CURSOR)
            os._exit(128 + number)


EARLY = StopRequest()
"""A signal that came when there was nothing to finish yet."""


def interrupt(number: int, frame: object) -> None:
    """Signal handler while there is nothing to finish: raises Interrupted. An import may catch and forget that, so the
    next `stop_on_signals` knows of it too."""
    EARLY.number = number
    raise Interrupted(number)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Catch SIGINT and SIGTERM inside the block; outside the main thread, where Python cannot, catch nothing."""
    request = StopRequest()
    request.number = EARLY.number
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = {number: signal.signal(number, request.handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
