"""Calls of a function in a process of its own, which is killed when a call takes too long, and which a call may end.

python -m workers.host.caller DESCRIPTOR     # run by `Caller`
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any

from es_service.protocol.messages import FloatArray
from es_service.protocol.options import OptionValue
from es_service.protocol.process_environment import same_imports
from es_service.protocol.raised import RaisedError
from workers.child import Child, LostProcessError, answer_parent
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
        self._child: Child | None = None

    def start(self) -> None:
        """Start the process if there is none. Raises CallFailedError if the function cannot be imported there."""
        if self._child is None:
            self._child = Child("workers.host.caller", os.environ | same_imports())
            self._child.ask(*self._given)
            try:
                self._answer(START_S, f"its process did not start within {START_S:g} s")
            except CallFailedError:
                self.close()
                raise

    def __call__(self, parameters_D: FloatArray, seed: int) -> tuple[float, Any]:
        """(fitness, descriptor [B]). Raises CallFailedError if the call raised, ended its process, or took too long."""
        self.start()
        assert self._child is not None, "it has been started"
        self._child.ask(parameters_D, seed)
        return self._answer(self._limit_s, f"no result within {self._limit_s:g} s (task.time_limit_s)")

    def close(self) -> None:
        """End the process, and those that it has started."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _answer(self, limit_s: float, late: str) -> Any:
        assert self._child is not None, "the process has been started"
        try:
            answer = self._child.answer(limit_s)
        except BaseException as error:
            self._child = None
            if isinstance(error, TimeoutError | LostProcessError):
                why = late if isinstance(error, TimeoutError) else f"the call ended its process with {error}"
                raise CallFailedError(why) from None
            raise
        if isinstance(answer, RaisedError):
            raise CallFailedError(answer.message)
        return answer


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), make_function_task)
