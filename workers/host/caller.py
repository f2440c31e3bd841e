"""Calls of a function in a process of its own, which is killed when a call takes too long, and which a call may end.

python -m workers.host.caller DESCRIPTOR     # run by `Caller`
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any

from es_service.protocol.child import Child, NoAnswerError, answer_parent
from es_service.protocol.messages import FloatArray
from es_service.protocol.options import OptionValue
from es_service.protocol.process_environment import same_imports
from es_service.protocol.user_code import RaisedError
from workers.environments import make_function_task
from workers.environments.function_task import FunctionTask
from workers.reports import Tail

PRINTED_BYTES = 500
"""At most this many bytes of what a call has printed are told if it ends its process, or takes too long."""
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
        self._child: Child | None = None
        self._printed = Tail(2)

    def start(self) -> None:
        """Start the process if there is none. Raises CallFailedError if the function cannot be imported there."""
        if self._child is not None and not self._child.is_ended:
            return
        self._child = Child("workers.host.caller", os.environ | same_imports(), None)
        try:
            self._answer(self._given, START_S)
        except CallFailedError:
            self.close()
            raise

    def __call__(self, parameters_D: FloatArray, seed: int) -> tuple[float, Any, Any]:
        """(fitness, descriptor [B], metrics [M]). Raises CallFailedError if the call raised, ended its process, or took
        too long."""
        self.start()
        return self._answer((parameters_D, seed), self._limit_s, " (task.time_limit_s)")

    def close(self) -> None:
        """End the process, and those that it has started."""
        if self._child is not None:
            self._child.end()

    def _answer(self, request: tuple[Any, ...], limit_s: float, key: str = "") -> Any:
        assert self._child is not None, "the process has been started"
        self._printed.skip()
        try:
            return self._child.call(*request, limit_s=limit_s)
        except NoAnswerError as error:
            printed = self._printed.new(PRINTED_BYTES)
            said = f"; it has printed: {' / '.join(printed.splitlines())}" if printed else ""
            raise CallFailedError(f"its process {error}{key if error.is_late else ''}{said}") from None
        except RaisedError as error:
            raise CallFailedError(error.message) from None


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), make_function_task)
