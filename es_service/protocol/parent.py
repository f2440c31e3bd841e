"""Binds the life of a child process to that of its parent.

`python -m es_service.protocol.parent PARENT MODULE ARGUMENT...` runs a module in a process that is bound like this.
`answer_of` has a child process answer one question.
"""

from __future__ import annotations

import ctypes
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import SimpleQueue

from es_service.protocol.errors import ForkedError
from es_service.protocol.newest_output import NewestOutput
from es_service.protocol.process_environment import child_environment

PR_SET_PDEATHSIG = 1
"""Linux's `prctl` option that sets the signal sent to a process when its parent dies."""
_GUARD = ("/bin/sh", "-c", "read -r _; kill -9 0")
"""Ends its process group once nobody holds the other end of its input any more."""
LOOK_S = 0.2
"""Seconds between two looks for the parent, where the kernel does not tell of its death."""
END_S = 2.0
"""Longest time in seconds between the answer of a child process and its end."""
ERRORS_BYTES = 2**16
"""At most this many bytes are stored of what such a child prints as errors."""


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


@dataclass(frozen=True)
class Answer:
    """How a child process has answered."""

    content: bytes | None
    """What it has written to its file; None if it has ended, or its time was over, without an answer."""
    code: int | None
    """Its exit code; None if its time was over."""
    errors: str
    """The newest part of what it printed as errors."""


def answer_of(command: Sequence[str], seconds: float) -> Answer:
    """What a child process writes to the file that is the last argument of its command, see `write_answer`.

    It has the environment of a worker. Code of the user in it may start processes that hold its output open; its end
    alone is waited for, and then all that is still in its process group is killed.

    Args:
        command: the words before the name of the file.
        seconds: longest time; the child is killed then.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryFile() as errors,
        closing(NewestOutput(ERRORS_BYTES)) as output,
        ExitStack() as ends,
    ):
        file, code = Path(folder) / "answer", None
        output.add(errors.fileno())
        child = subprocess.Popen(
            [*command, str(file)],
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            process_group=0,
        )
        ends.callback(child.wait)
        ends.callback(child.kill)
        ends.callback(guard_of(child).communicate)  # the group has its number until the guard has ended
        with suppress(subprocess.TimeoutExpired):
            code = child.wait(seconds)
        ends.close()
        errors.seek(0)
        content = file.read_bytes() if file.exists() else None
        return Answer(content, code, errors.read().decode(errors="replace").strip())


def write_answer(file: str, content: bytes) -> None:
    """Answer `answer_of`. The file exists only with all of its content."""
    partial = Path(f"{file}.partial")
    partial.write_bytes(content)
    partial.rename(file)


def end_soon() -> None:
    """Have this process, whose main thread has nothing left to do, end within END_S seconds.

    Python waits for threads and calls functions of the user's code that need not end.
    """
    timer = threading.Timer(END_S, os._exit, (0,))
    timer.daemon = True
    timer.start()


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
