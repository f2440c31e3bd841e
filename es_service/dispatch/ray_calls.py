"""The calls of Ray actors: those that have not been answered yet, and the arguments of those that get chunks."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from es_service.protocol.messages import Subject, Work, forget_oldest

IN_CALL_BYTES = 64 * 2**10
"""Largest size in bytes of a subject sent with every call; a larger one is stored, and fetched once per node."""
MANY = 64
"""Number of calls above which all answers that are there are looked for at once, since Ray looks at every call."""


@dataclass(frozen=True)
class Call:
    """A call of an actor."""

    worker: int
    what: str
    """Method that was called: place, build, compile or run."""
    item_id: Hashable = None
    attempt: int = 0
    kind: str = ""
    """Kind of chunks for which it compiles."""


class Calls:
    """Reference to the answer -> call, oldest first."""

    def __init__(self, ray: ModuleType) -> None:
        self._ray = ray
        self._calls: dict[Any, Call] = {}
        self._owed: dict[int, dict[Any, Call]] = {}
        """Worker -> its calls, oldest first."""
        self._ready: deque[Any] = deque()
        """References whose answers are there. Those that are not among the calls any more do not count."""

    def __len__(self) -> int:
        return len(self._calls)

    def __getitem__(self, ref: Any) -> Call:
        return self._calls[ref]

    def __setitem__(self, ref: Any, call: Call) -> None:
        self._calls[ref] = call
        self._owed.setdefault(call.worker, {})[ref] = call

    def __delitem__(self, ref: Any) -> None:
        owed = self._owed[self._calls.pop(ref).worker]
        del owed[ref]

    def forget(self, worker: int) -> None:
        """Remove the calls of a worker."""
        for ref in self._owed.pop(worker, ()):
            del self._calls[ref]

    def answered(self, timeout_s: float) -> Any | None:
        """Reference to an answer that is there, which the caller removes; None if none comes within `timeout_s`.

        The answers of one worker come in the order of its calls. An actor computes them in this order, but each answer
        travels alone and may overtake an older one, whose reference is then the next: it is there within milliseconds.
        """
        if (ref := self._oldest_ready()) is not None or not self._calls:
            return ref
        refs = list(self._calls)
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready and len(refs) > MANY:
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0.0)
        self._ready.extend(ready)
        return self._oldest_ready()

    def owed_first(self) -> dict[int, str]:
        """Worker -> method of its first call."""
        return {worker: next(iter(owed.values())).what for worker, owed in self._owed.items() if owed}

    def _oldest_ready(self) -> Any | None:
        """The oldest call of the next worker with an answer."""
        while self._ready:
            if (call := self._calls.get(self._ready[0])) is not None:
                return next(iter(self._owed[call.worker]))
            self._ready.popleft()
        return None


class Arguments:
    """Arguments of calls that get chunks. A large subject is stored once for all calls that share it."""

    def __init__(self, ray: ModuleType) -> None:
        self._ray = ray
        self._subjects: dict[int, tuple[Subject, Any]] = {}
        """By `id`, which the subject in the entry keeps from being reused."""

    def of(self, work: Sequence[Work]) -> tuple[Any, ...]:
        """The chunks, and their subjects without repetitions, as `WorkerActor.run` takes them."""
        subjects: dict[int, Any] = {}
        for subject, _ in work:
            if id(subject) not in subjects:
                subjects[id(subject)] = self._packed(subject)
        index = {key: number for number, key in enumerate(subjects)}
        chunks = pickle.dumps([(index[id(subject)], chunk) for subject, chunk in work], pickle.HIGHEST_PROTOCOL)
        return chunks, *subjects.values()

    def forget(self) -> None:
        """Forget all subjects, so that Ray need not keep them."""
        self._subjects.clear()

    def _packed(self, subject: Subject) -> Any:
        """The subject, pickled, or the reference under which Ray has stored that."""
        if (known := self._subjects.get(id(subject))) is None:
            pickled = pickle.dumps(subject, pickle.HIGHEST_PROTOCOL)
            known = subject, pickled if len(pickled) <= IN_CALL_BYTES else self._ray.put(pickled)
            self._subjects[id(subject)] = known
            forget_oldest(self._subjects, lambda entry: entry[0].nbytes)
        return known[1]
