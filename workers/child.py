"""A child process that answers requests, one after another: the end that asks, and the loop of the one that answers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import weakref
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import Any

from es_service.protocol.parent import bound, guard_of, require_same_process, start_child
from es_service.protocol.raised import raised
from es_service.protocol.wire import framed, receive


class LostProcessError(RuntimeError):
    """A child process has ended; the message says how."""


class Child:
    """A process that runs `answer_parent`. It and those that it has started end with this one, when it is closed, or
    when nobody refers to it.

    The first request has the arguments of the `make` of `answer_parent`; its answer is None, or why there is no
    function. If the wait for an answer is interrupted, the process ends, since a later request would get that answer.
    """

    def __init__(self, module: str, environment: Mapping[str, str]) -> None:
        """Start a module with these environment variables."""
        with ExitStack() as unless_started:
            self._socket, theirs = map(unless_started.enter_context, socket.socketpair())
            process = start_child(
                lambda: subprocess.Popen(
                    bound(module, str(theirs.fileno())),
                    env=environment,
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    process_group=0,
                )
            )
            unless_started.callback(_end, os.getpid(), self._socket, process)
            theirs.close()
            guard = guard_of(process)
            unless_started.pop_all()
        self._process, self._maker = process, os.getpid()
        self._end = weakref.finalize(self, _end, os.getpid(), self._socket, process, guard)

    def ask(self, *request: Any) -> None:
        """Send the arguments of one call of the function. Raises ForkedError in a process that was forked."""
        require_same_process(self._maker, "the child process of a task", "make another task or environment in that one")
        with suppress(OSError):  # it has ended, which `answer` finds
            self._socket.sendall(framed(request))

    def answer(self, limit_s: float | None = None) -> Any:
        """What the function returned for the oldest request without an answer, or a RaisedError.

        Raises:
            TimeoutError: nothing came within `limit_s`.
            LostProcessError: the process has ended, "signal SIGKILL" or "exit code 3".
            After any error, this object is closed.
        """
        try:
            self._socket.settimeout(limit_s)
            return receive(self._socket)
        except BaseException as error:
            self.close()
            if isinstance(error, TimeoutError) or not isinstance(error, EOFError | OSError):
                raise
            code = self._process.returncode
            how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            raise LostProcessError(how) from None

    def close(self) -> None:
        """End the process, and those that it has started."""
        self._end()


def _end(parent: int, end: socket.socket, process: subprocess.Popen[bytes], *guard: subprocess.Popen[bytes]) -> None:
    end.close()
    if os.getpid() != parent:
        return  # in a process that was forked from it
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    for ended in (process, *guard):
        with ended:  # which waits, and closes what is open
            pass


def answer_parent(descriptor: int, make: Callable[..., Callable[..., Any]]) -> None:
    """Answer requests until the parent closes its end; what raises is answered with a RaisedError.

    Args:
        descriptor: of the socket, as the last argument of the module.
        make: gives the function that answers; called with the name of the user's code, and what else was given.
    """
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
                return
            try:
                answer = function(*request)
            except (Exception, SystemExit) as error:
                answer = raised(error, name)
            parent.sendall(framed(answer))
