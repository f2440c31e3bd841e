"""What Ray changes in the process that uses it, and how it is undone: signal handlers and environment variables."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def signal_handlers_kept() -> Iterator[set[int]]:
    """Context manager that restores the signal handlers that Ray replaces; Ray can do so only in the main thread.

    It gives a set, which holds after the block the numbers of the signals that arrived in it. Ray's handler of SIGTERM
    raises SystemExit, which Python ignores in some places (a hook of os.fork, a finalizer), with a traceback on stderr
    that is left out here.
    """
    arrived: set[int] = set()
    if threading.current_thread() is not threading.main_thread():
        yield arrived
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    report = sys.unraisablehook
    noted, written = socket.socketpair()
    with noted, written:
        noted.setblocking(False)
        written.setblocking(False)
        fd_before = signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
        sys.unraisablehook = lambda ignored: None if ignored.exc_type is SystemExit else report(ignored)
        try:
            yield arrived
        finally:
            sys.unraisablehook = report
            for number, handler in before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(fd_before)
            with contextlib.suppress(BlockingIOError):
                arrived.update(noted.recv(4096))


@contextlib.contextmanager
def environment_kept(settings: dict[str, str]) -> Iterator[None]:
    """Context manager that sets environment variables for processes that Ray starts, and restores ours at its end."""
    before = dict(os.environ)
    os.environ.update(settings)
    try:
        yield
    finally:
        # Restore only the variables that differ, because threads of Ray may be reading the others.
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        for name, value in before.items():
            if os.environ.get(name) != value:
                os.environ[name] = value
