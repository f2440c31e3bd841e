"""The calls of Ray actors that have not been answered yet."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

MANY = 64
"""Number of calls above which all answers that are there are looked for at once, since Ray looks at every call."""


@dataclass(frozen=True)
class Call:
    """A call of an actor."""

    worker: int
    what: str
    """Method that was called: place, build or run."""
    item_id: Hashable = None
    attempt: int = 0


class Calls:
    """Reference to the answer -> call, oldest first."""

    def __init__(self, ray: ModuleType) -> None:
        self._ray = ray
        self._calls: dict[Any, Call] = {}
        self._ready: deque[Any] = deque()
        """References whose answers are there. Those of a worker that was killed meanwhile do not count."""

    def __len__(self) -> int:
        return len(self._calls)

    def __getitem__(self, ref: Any) -> Call:
        return self._calls[ref]

    def __setitem__(self, ref: Any, call: Call) -> None:
        self._calls[ref] = call

    def __delitem__(self, ref: Any) -> None:
        del self._calls[ref]

    def forget(self, worker: int) -> None:
        """Remove the calls of a worker."""
        self._calls = {ref: call for ref, call in self._calls.items() if call.worker != worker}

    def answered(self, timeout_s: float) -> Any | None:
        """Reference to an answer that is there, which the caller removes; None if none comes within `timeout_s`.

        The answers of one worker come in the order of its calls.
        """
        while self._ready:
            if (ref := self._ready.popleft()) in self._calls:
                return ref
        if not self._calls:
            return None
        refs = list(self._calls)
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready and len(refs) > MANY:
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0.0)
        self._ready.extend(ready)
        return self._ready.popleft() if ready else None

    def owed_first(self) -> dict[int, str]:
        """Worker -> method of its first call: place, build or run."""
        first: dict[int, str] = {}
        for call in self._calls.values():
            first.setdefault(call.worker, call.what)
        return first
