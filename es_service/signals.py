"""SIGINT and SIGTERM as a request: the first is noticed at the next wait, the second ends the process at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class StopRequest:
    """Holds the signal that asked to stop, if any. Calling it returns the number or None."""

    def __init__(self) -> None:
        self.number: int | None = None

    def __call__(self) -> int | None:
        return self.number

    def handle(self, number: int, frame: object) -> None:
        """Signal handler. Nothing is interrupted half-way: a transaction in hand is finished first."""
        if self.number is not None:
            os._exit(128 + number)  # asked twice; what is committed is safe
        self.number = number


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Catch SIGINT and SIGTERM inside the block; outside the main thread, where Python cannot, catch nothing."""
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = {number: signal.signal(number, request.handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
