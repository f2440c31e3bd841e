"""Calls of a function in a process of its own, which is killed when a call takes too long, and which a call may end.

python -m workers.host.caller DESCRIPTOR     # run by `Caller`
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import Any

from es_service.protocol.messages import FloatArray
from es_service.protocol.options import OptionValue
from es_service.protocol.parent import bound, start_child
from es_service.protocol.process_environment import same_imports
from es_service.protocol.raised import raised
from es_service.protocol.wire import framed, receive
from workers.environments import make_function_task
from workers.environments.function_task import FunctionTask

START_S = 120.0
"""Longest time in which the process of a function must have imported it."""


class CallFailedError(Exception):
    """A call has no result; the message says why."""


class Caller:
    """A function whose calls run in a process of their own, one after another, each with a limit of time."""

    def __init__(self, name: str, options: Mapping[str, OptionValue], limit_s: float) -> None:
        """The process starts with the first call.

        Args:
            name, options: of the task, as for `make_function_task`.
        """
        self.task: FunctionTask = make_function_task(name, options)
        """The function as this process has it, for what is known without a call."""
        self._given, self._limit_s = (name, dict(options)), limit_s
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def __call__(self, parameters_D: FloatArray, seed: int) -> tuple[float, Any]:
        """(fitness, descriptor [B]). Raises CallFailedError if the call raised, ended its process, or took too long."""
        if self._socket is None:
            self._start()
        self._send((parameters_D, seed))
        answer = self._answer(self._limit_s, f"no result within {self._limit_s:g} s (task.time_limit_s)")
        if isinstance(answer, str):
            raise CallFailedError(answer)
        return answer

    def close(self) -> None:
        """End the process, and those that it has started."""
        if self._process is not None and self._socket is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # its session is its own, see `_start`
            self._process.wait()
            self._socket.close()
        self._process = self._socket = None

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs, ExitStack() as unless_started:
            unless_started.enter_context(ours)
            self._process = start_child(
                lambda: subprocess.Popen(
                    bound("workers.host.caller", str(theirs.fileno())),
                    env=os.environ | same_imports(),
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    start_new_session=True,
                )
            )
            unless_started.pop_all()
        self._socket = ours
        self._send(self._given)
        if (problem := self._answer(START_S, f"its process did not start within {START_S:g} s")) is not None:
            self.close()
            raise CallFailedError(problem)

    def _send(self, message: Any) -> None:
        assert self._socket is not None, "the process has been started"
        with suppress(OSError):  # it has ended, which `_answer` finds
            self._socket.sendall(framed(message))

    def _answer(self, limit_s: float, late: str) -> Any:
        assert self._socket is not None, "the process has been started"
        assert self._process is not None, "the process has been started"
        ready, _, _ = select.select([self._socket], [], [], limit_s)
        if not ready:
            self.close()
            raise CallFailedError(late)
        try:
            return receive(self._socket)
        except (EOFError, OSError):
            process = self._process
            self.close()
            code = process.returncode
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise CallFailedError(f"the call ended its process with {how}") from None


def main(descriptor: int) -> None:
    """Answer calls until the parent closes its end: None when the function is there, then a result or a text each."""
    with socket.socket(fileno=descriptor) as parent:
        name, options = receive(parent)
        try:
            task = make_function_task(name, options)
        except BaseException as error:  # also sys.exit in the user's module
            parent.sendall(framed(raised(error, name).message))
            return
        parent.sendall(framed(None))
        while True:
            try:
                given = receive(parent)
            except EOFError:
                return
            try:
                answer = task(*given)
            except (Exception, SystemExit) as error:
                answer = raised(error, name).message
            parent.sendall(framed(answer))


if __name__ == "__main__":
    main(int(sys.argv[1]))
