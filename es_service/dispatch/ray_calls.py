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
"""Number of workers above which all answers that are there are looked for at once, since Ray looks at every call."""


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

        The answers of one worker come in the order of its calls. An actor computes them in this order, but each answer
        travels alone and may overtake an older one, so only the oldest call of each worker is waited for.
        """
        while self._ready:
            if (ref := self._ready.popleft()) in self._calls:
                return ref
        if not self._calls:
            return None
        refs = list(self._oldest().values())
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready and len(refs) > MANY:
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0.0)
        self._ready.extend(ready)
        return self._ready.popleft() if ready else None

    def owed_first(self) -> dict[int, str]:
        """Worker -> method of its oldest call."""
        return {worker: self._calls[ref].what for worker, ref in self._oldest().items()}

    def _oldest(self) -> dict[int, Any]:
        """Worker -> reference to the answer of its oldest call."""
        oldest: dict[int, Any] = {}
        for ref, call in self._calls.items():
            oldest.setdefault(call.worker, ref)
        return oldest


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
