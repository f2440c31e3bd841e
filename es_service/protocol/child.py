"""Child processes: how one is started, asked, waited for and ended, and the sentence that says how it ended.

A child runs a module of ours and has the other end of a socket. It ends with this process, however this one ends, and
so does all that it has started.

`python -m es_service.protocol.child PARENT MODULE:FUNCTION DESCRIPTOR` answers requests by `answer_parent`, in a
process that is bound like this. With MODULE alone, it runs the module, with the arguments that follow.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from functools import cache
from math import inf
from queue import SimpleQueue
from typing import IO, Any, NamedTuple, Self

from es_service.protocol.errors import ForkedError
from es_service.protocol.machine import process_cpu_s
from es_service.protocol.process_environment import child_environment, newest_lines, newest_output
from es_service.protocol.user_code import RaisedError, raised
from es_service.protocol.wire import BUFFER_BYTES, framed, receive

PR_SET_PDEATHSIG = 1
"""Linux's `prctl` option that sets the signal sent to a process when its parent dies."""
_GUARD = ("/bin/sh", "-c", "read -r _; kill -9 0")
"""Ends its process group once nobody holds the other end of its input any more."""
LOOK_S = 0.2
"""Seconds between two looks for the parent, where the kernel does not tell of its death, or for a silent child."""
END_S = 2.0
"""Longest time in seconds in which a child whose answer has come may end by itself."""
OUTPUT_BYTES = 2**16
"""At most this many bytes are stored of what a child prints, unless it is said otherwise."""
LAST_WORDS_BYTES = 2000
"""At most this many bytes of what an ended child has printed are reported."""


class NoAnswerError(RuntimeError):
    """A child has ended, or has given no answer in time; the message is the end of a sentence about its process."""

    is_late = False
    """Whether it gave no answer in time."""


class End(NamedTuple):
    """How a child has ended."""

    how: str
    """Such as "signal SIGKILL" or "exit code 3"."""
    last_words: str
    """The last of what it printed; empty if it printed where this process does."""
    cpu_s: float = 0.0
    """Seconds of processors that it had used, see `process_cpu_s`."""

    def __str__(self) -> str:
        return f"{self.how}:\n{self.last_words}" if self.last_words else self.how


class Child:
    """A process that runs a program, bound to this process.

    `module:function` answers requests by `answer_parent` with the function, one after another: the first has the
    arguments of `make`, and its answer is None. A module alone is run as a script, whose last argument is the
    descriptor of the other end of `socket`.

    It and all that it has started end with this process, when it is ended, or when nobody refers to it. If the wait for
    an answer is interrupted, it is ended, since a later request would get that answer.
    """

    def __init__(self, program: str, environment: Mapping[str, str], output_bytes: int | None = OUTPUT_BYTES) -> None:
        """Start it.

        Args:
            environment: its environment variables.
            output_bytes: at most this many bytes of what it prints are stored; None: it prints where this process does.
        """
        log, watched = None, -1
        with ExitStack() as undo:
            self.socket, theirs = map(undo.enter_context, socket_pair())
            if output_bytes is not None:
                log = undo.enter_context(tempfile.TemporaryFile())
                watched = newest_output().add(log.fileno(), output_bytes)
                undo.callback(newest_output().forget, watched)
            process = start_child(
                lambda: subprocess.Popen(
                    bound(program, str(theirs.fileno())),
                    env=environment,
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    process_group=0,
                )
            )
            undo.callback(process.wait)
            undo.callback(process.kill)
            guard = subprocess.Popen(_GUARD, stdin=subprocess.PIPE, process_group=process.pid)
            undo.pop_all()
        theirs.close()
        self.pid, self._process, self._log, self._maker = process.pid, process, log, os.getpid()
        self._finalize = weakref.finalize(self, _end, self._maker, self.socket, process, guard, log, watched)
        self._end: End | None = None

    def ask(self, *request: Any) -> None:
        """Send the arguments of one call of the function. Raises ForkedError in a process that was forked."""
        require_same_process(self._maker, "the child process of a task", "make another task or environment in that one")
        with suppress(OSError):  # it has ended, which `answer` finds
            self.socket.sendall(framed(request))

    def answer(self, limit_s: float | None = None) -> Any:
        """What the function returned for the oldest request without an answer.

        Raises:
            RaisedError: the function raised.
            NoAnswerError: nothing came within `limit_s`, or the process has ended. After this error and after an
                interruption, it is ended.
        """
        try:
            return self._answer(inf if limit_s is None else time.monotonic() + limit_s)
        except RaisedError:
            raise
        except (EOFError, OSError) as error:
            end = self.end()
            why = f"ended with {end}"
            if is_late := isinstance(error, TimeoutError):
                why = f"gave no answer within {limit_s:g} s" + (f":\n{end.last_words}" if end.last_words else "")
            lost = NoAnswerError(why)
            lost.is_late = is_late
            raise lost from None
        except BaseException:
            self.end()
            raise

    def _answer(self, until_s: float) -> Any:
        """See `answer`. A process that the child has forked may hold its end of the socket open."""
        if self.is_ended:  # its socket is closed
            raise EOFError
        poll, is_over = select.poll(), False
        poll.register(self.socket, select.POLLIN)
        while not poll.poll(1000.0 * min(LOOK_S, max(0.0, until_s - time.monotonic()))):
            if is_over:
                raise EOFError
            if time.monotonic() >= until_s:
                raise TimeoutError
            is_over = self._process.poll() is not None
        self.socket.settimeout(None if until_s == inf else max(LOOK_S, until_s - time.monotonic()))
        answer = receive(self.socket)
        if isinstance(answer, RaisedError):
            raise answer
        return answer

    @property
    def is_answered(self) -> bool:
        """Whether `answer` would not wait."""
        if self.is_ended or self._process.poll() is not None:
            return True
        poll = select.poll()
        poll.register(self.socket, select.POLLIN)
        return bool(poll.poll(0))

    def call(self, *request: Any, limit_s: float | None = None) -> Any:
        """`ask`, and the `answer`."""
        self.ask(*request)
        return self.answer(limit_s)

    def terminate(self) -> None:
        """Ask it to end what it does, by SIGTERM."""
        self._process.terminate()

    def kill(self) -> None:
        """Kill it and all that it has started; `end` waits for that."""
        _kill(self._process)

    def end(self, grace_s: float = 0.0) -> End:
        """How it has ended: by itself, once its socket is closed, or killed after `grace_s` with all that is left of
        it. In a process that was forked, nothing happens."""
        if self._end is not None:
            return self._end
        if grace_s and os.getpid() == self._maker:
            with suppress(OSError):
                self.socket.shutdown(socket.SHUT_RDWR)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(grace_s)
        self._end = end = self._finalize() or End("", "")
        return end

    @property
    def is_ended(self) -> bool:
        """Whether `end` was called, by whomever."""
        return not self._finalize.alive

    @property
    def is_running(self) -> bool:
        """Whether its process runs."""
        return not self.is_ended and self._process.poll() is None

    @property
    def cpu_s(self) -> float:
        """Seconds of processors that it has used so far, see `process_cpu_s`."""
        return process_cpu_s(self.pid) if self._end is None else self._end.cpu_s

    def forget_output(self) -> None:
        """Begin anew with what it prints."""
        if self._log is not None:
            os.ftruncate(self._log.fileno(), 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


def answer_of(program: str, *given: Any, request: tuple[Any, ...] = (), limit_s: float) -> Any:
    """What a new child with the environment of a worker answers to one request.

    Args:
        given: arguments of `make`, see `answer_parent`.
        limit_s: longest time.

    Raises as `Child.answer`.
    """
    until_s = time.monotonic() + limit_s
    with Child(program, child_environment()) as child:
        child.call(*given, limit_s=limit_s)
        answer = child.call(*request, limit_s=max(0.0, until_s - time.monotonic()))
        child.end(END_S)
        return answer


def answer_parent(descriptor: int, make: Callable[..., Callable[..., Any]]) -> None:
    """Answer requests until the parent closes its end; what raises is answered with a RaisedError.

    Args:
        descriptor: of the socket, as the last argument of the program.
        make: gives the function that answers; called with the name of the user's code, and what else was given.
    """
    os.set_inheritable(descriptor, False)
    with socket.socket(fileno=descriptor) as parent:
        name, *given = receive(parent)
        try:
            function = make(name, *given)
        except BaseException as error:  # also sys.exit in the user's module
            parent.sendall(framed(raised(error, name)))
            return
        parent.sendall(framed(None))
        while True:
            try:
                request = receive(parent)
            except EOFError:
                break
            try:
                answer = function(*request)
            except (Exception, SystemExit) as error:
                answer = raised(error, name)
            parent.sendall(framed(answer))


def _end(
    maker: int,
    end: socket.socket,
    process: subprocess.Popen[bytes],
    guard: subprocess.Popen[bytes],
    log: IO[bytes] | None,
    watched: int,
) -> End | None:
    """See `Child.end`."""
    end.close()
    if os.getpid() != maker:
        return None  # in a process that was forked from it
    _kill(process)
    with suppress(ChildProcessError):  # it has been waited for already
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    cpu_s = process_cpu_s(process.pid)
    code = process.wait()
    guard.communicate()
    last_words = ""
    if log is not None:
        newest_output().forget(watched)
        with log:
            last_words = newest_lines(log.fileno(), LAST_WORDS_BYTES).decode(errors="replace").strip()
    return End(f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}", last_words, cpu_s)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a child and the processes that code of the user has started in it, which are in its process group. The group
    has its number until the guard, which is in it, has been waited for."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Pair of blocking sockets with large send buffers."""
    pair = socket.socketpair()
    for end in pair:
        end.setblocking(True)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    return pair


def bound(program: str, *arguments: str) -> list[str]:
    """The command that runs a module, or one of its functions, in a child process bound to this process."""
    return [sys.executable, "-m", "es_service.protocol.child", str(os.getpid()), program, *arguments]


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


if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    del sys.argv[:2]
    module, _, function = sys.argv[0].partition(":")
    if function:
        answer_parent(int(sys.argv[1]), getattr(importlib.import_module(module), function))
    else:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
