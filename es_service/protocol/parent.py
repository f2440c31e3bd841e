"""Binds the life of a child process to that of its parent.

`python -m es_service.protocol.parent PARENT MODULE ARGUMENT...` runs a module in a process that is bound like this.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from queue import SimpleQueue

from es_service.protocol.errors import ForkedError

PR_SET_PDEATHSIG = 1
"""Linux's `prctl` option that sets the signal sent to a process when its parent dies."""
_GUARD = ("/bin/sh", "-c", "read -r _; kill -9 0")
"""Ends its process group once nobody holds the other end of its input any more."""
LOOK_S = 0.2
"""Seconds between two looks for the parent, where the kernel does not tell of its death."""


def end_with(parent: int) -> None:
    """Have this process killed when its parent ends, for whatever reason; end it if the parent has ended already.

    The kernel does it on Linux. Elsewhere a thread looks for the parent every LOOK_S seconds.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_look_for, args=(parent,), daemon=True, name="looks for the parent").start()
    if os.getppid() != parent:
        os._exit(1)


def _look_for(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os.kill(os.getpid(), signal.SIGKILL)


def start_child(start: Callable[[], subprocess.Popen[bytes]]) -> subprocess.Popen[bytes]:
    """Start a process whose `end_with` means this process.

    For Linux, the parent is the thread that starts a child, and a bound child is killed when that thread ends. So a
    thread other than the main one has another thread do it, which lasts as long as this process.
    """
    if threading.current_thread() is threading.main_thread():
        return start()
    started: Future[subprocess.Popen[bytes]] = Future()
    _starts(os.getpid()).put((start, started))
    return started.result()


def require_same_process(maker: int, what: str, instead: str) -> None:
    """Raise ForkedError in another process than the one that has made something: both have its sockets, so each would
    read answers that are meant for the other.

    Args:
        maker: id of the process that has made it.
        what: what it is, as the subject of a sentence.
        instead: what to do, in words.
    """
    if os.getpid() != maker:
        raise ForkedError(
            f"{what} belongs to process {maker} and cannot be used in process {os.getpid()}, which os.fork() or "
            f"multiprocessing has made of it; {instead}"
        )


def guard_of(child: subprocess.Popen[bytes]) -> subprocess.Popen[bytes]:
    """A process that ends a child, which must be the first of its process group, and all that it has started, when this
    process ends, for whatever reason. `end_with` ends the child alone."""
    return subprocess.Popen(_GUARD, stdin=subprocess.PIPE, process_group=child.pid)


@cache
def _starts(process: int) -> SimpleQueue:
    """Queue of what a thread of this process is to start; a forked process has no threads but the one that forked."""
    queue: SimpleQueue[tuple[Callable[[], subprocess.Popen[bytes]], Future[subprocess.Popen[bytes]]]] = SimpleQueue()

    def serve() -> None:
        while True:
            start, started = queue.get()
            try:
                started.set_result(start())
            except BaseException as error:
                started.set_exception(error)

    threading.Thread(target=serve, daemon=True, name="starts child processes").start()
    return queue


def bound(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in a child process bound to this process."""
    return [sys.executable, "-m", "es_service.protocol.parent", str(os.getpid()), module, *arguments]


if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    del sys.argv[:2]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
