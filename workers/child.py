"""A child process that answers requests, one after another: the end that asks, and the loop of the one that answers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from es_service.protocol.parent import bound, start_child
from es_service.protocol.raised import raised
from es_service.protocol.wire import framed, receive


class LostProcessError(RuntimeError):
    """A child process has ended; the message says how."""


class Child:
    """A process that runs `answer_parent`. It ends with this one, when it is closed, or when nobody refers to it."""

    def __init__(self, module: str, environment: Mapping[str, str], name: str, *given: Any) -> None:
        """Start a module, and ask for its function; `answer` then gives None or why there is none.

        Args:
            environment: variables of the process.
            name, given: arguments of the `make` of `answer_parent`.
        """
        self._socket, theirs = socket.socketpair()
        try:
            with theirs:
                self._process = start_child(
                    lambda: subprocess.Popen(
                        bound(module, str(theirs.fileno())),
                        env=environment,
                        pass_fds=[theirs.fileno()],
                        stdin=subprocess.DEVNULL,
                        start_new_session=True,
                    )
                )
        except BaseException:
            self._socket.close()
            raise
        self._end = weakref.finalize(self, _end, self._process, self._socket)
        self.ask(name, *given)

    def ask(self, *request: Any) -> None:
        """Send the arguments of one call of the function."""
        with suppress(OSError):  # it has ended, which `answer` finds
            self._socket.sendall(framed(request))

    def answer(self, limit_s: float | None = None) -> Any:
        """What the function returned for the oldest request without an answer, or a RaisedError.

        Raises:
            TimeoutError: nothing came within `limit_s`.
            LostProcessError: the process has ended, "signal SIGKILL" or "exit code 3"; this object is closed.
        """
        self._socket.settimeout(limit_s)
        try:
            return receive(self._socket)
        except TimeoutError:
            raise
        except (EOFError, OSError):
            self.close()
            code = self._process.returncode
            how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            raise LostProcessError(how) from None

    def close(self) -> None:
        """End the process, and those that it has started."""
        self._end()


def _end(process: subprocess.Popen[bytes], end: socket.socket) -> None:
    end.close()
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # a process that was forked from this one may hold the socket open
    process.wait()


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
