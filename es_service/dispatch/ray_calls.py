"""The calls of Ray actors: those that have not been answered yet, the arguments of those that get chunks, what messages
say about their faults, and the nodes that must not work for a run."""

from __future__ import annotations

import pickle
import re
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from types import ModuleType
from typing import Any

from es_service.dispatch.events import Progress
from es_service.dispatch.ray_nodes import Membership
from es_service.errors import EvaluationError
from es_service.protocol.content import Cache
from es_service.protocol.messages import Report, Work
from es_service.protocol.sent import SENDER_BYTES, Memory, parcel
from es_service.protocol.user_code import RaisedError

IN_CALL_BYTES = 64 * 2**10
"""Largest size in bytes of an array that is sent with a call; a larger one is stored, and fetched once per node."""
LOOKS = "looks"
"""Concurrency group of actors in which they answer how far they are."""
LOOK_S = 1.0
"""Seconds between two looks at which actors are asked so. A call that is answered between them costs no question."""
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
    work: Sequence[Work] = ()
    kind: str = ""
    """Kind of chunks for which it compiles."""


class Calls(dict[Any, Call]):
    """Reference to the answer -> call, oldest first."""

    def __init__(self, ray: ModuleType) -> None:
        super().__init__()
        self._ray = ray
        self._ready: deque[Any] = deque()
        """References whose answers are there. Those of a worker that was killed meanwhile do not count."""

    def forget(self, worker: int) -> None:
        """Remove the calls of a worker."""
        for ref in [ref for ref, call in self.items() if call.worker == worker]:
            del self[ref]

    def answered(self, timeout_s: float) -> Any | None:
        """Reference to an answer that is there, which the caller removes; None if none comes within `timeout_s`.

        The answers of one worker come in the order of its calls. An actor computes them in this order, but each answer
        travels alone and may overtake an older one, so only the oldest call of each worker is waited for.
        """
        while self._ready:
            if (ref := self._ready.popleft()) in self:
                return ref
        if not self:
            return None
        refs = list(self.oldest().values())
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready and len(refs) > MANY:
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0.0)
        self._ready.extend(ready)
        return self._ready.popleft() if ready else None

    def owed_first(self) -> dict[int, str]:
        """Worker -> method of its oldest call."""
        return {worker: self[ref].what for worker, ref in self.oldest().items()}

    def oldest(self) -> dict[int, Any]:
        """Worker -> reference to the answer of its oldest call."""
        oldest: dict[int, Any] = {}
        for ref, call in self.items():
            oldest.setdefault(call.worker, ref)
        return oldest


class Looks:
    """Questions to actors how far they are with their oldest calls, which they answer in a thread of its own."""

    def __init__(self, ray: ModuleType, on_report: Callable[[int, Report], None]) -> None:
        """Know no actors yet.

        Args:
            on_report: called with a worker and its report.
        """
        self._ray, self._on_report = ray, on_report
        self._oldest: Mapping[int, Any] = {}
        self._asked: dict[Any, tuple[int, Any]] = {}
        """Reference to an answer -> the worker, and its oldest call when it was asked."""
        self._shown: dict[int, tuple[Any, Any]] = {}
        """Worker -> that call, and what the last answer showed."""

    def look(self, oldest: Mapping[int, Any], handles: Mapping[int, Any]) -> list[Progress]:
        """Ask each actor with the same oldest call as at the last look; returns what has come of earlier questions: the
        reports of those that have done more than at the answer before.

        Args:
            oldest: worker -> reference to the answer of its oldest call.
            handles: worker -> actor.
        """
        asked = list(self._asked)
        ready, _ = self._ray.wait(asked, num_returns=len(asked), timeout=0.0) if asked else ([], [])
        found = [report for ref in ready if (report := self._report(ref, *self._asked.pop(ref), oldest)) is not None]
        owing = {worker for worker, _ in self._asked.values()}
        for worker, call in oldest.items():
            if self._oldest.get(worker) == call and worker not in owing:
                answer = handles[worker].progress.options(concurrency_group=LOOKS).remote()
                self._asked[answer] = worker, call
        self._oldest = oldest
        self._shown = {worker: shown for worker, shown in self._shown.items() if oldest.get(worker) == shown[0]}
        return found

    def _report(self, ref: Any, worker: int, call: Any, oldest: Mapping[int, Any]) -> Progress | None:
        """The report of an answer, if it shows more of a call than the one before."""
        try:
            (moves, *rest), report = self._ray.get(ref)
        except self._ray.exceptions.RayError:  # it is lost, which its call shows
            return None
        if report is not None:
            self._on_report(worker, report)
        before, self._shown[worker] = self._shown.get(worker), (call, moves)
        if oldest.get(worker) != call or before in (None, (call, moves)) or before[0] != call:
            return None
        return Progress(worker, *rest)


class Arguments:
    """Arguments of calls that get chunks. A large array is stored once for all calls that share it."""

    def __init__(self, ray: ModuleType) -> None:
        self._ray = ray
        self._stored: Cache[bytes, tuple[Any, int]] = Cache(itemgetter(1))
        """References and bytes of the newest arrays that are stored, by name."""

    def of(self, work: Sequence[Work], memory: Memory[int]) -> tuple[Any, ...]:
        """A work item as `WorkerActor.run` takes it: one message, and the large arrays that a worker lacks.

        Args:
            memory: see `parcel`.
        """
        arrays, origins, pickled = parcel(work, memory)
        large = {name: array for name, array in arrays.items() if array.nbytes > IN_CALL_BYTES}
        for name in large.keys() - self._stored.keys():
            reference = self._ray.put(_pickled({name: large[name]}))
            self._stored.add(name, (reference, large[name].nbytes))
        self._stored.use(large)
        self._stored.forget_oldest(SENDER_BYTES, spared=large)
        small = {name: array for name, array in arrays.items() if name not in large}
        return _pickled((small, origins, pickled)), *(self._stored[name][0] for name in large)

    def forget(self) -> None:
        """Forget all that is stored, so that Ray need not keep it."""
        self._stored.clear()


def fault_reason(error: Exception) -> str:
    """Cause of an actor's fault, on one line."""
    first = error_text(error).strip().partition("\n")[0]
    known = {
        "OutOfMemoryError": "its node ran out of memory and Ray killed it",
        "ActorUnavailableError": "its node does not answer",
        "ActorDiedError": "its process or its node died",
    }
    kind = type(error).__name__
    return f"{known.get(kind, kind)}: {first}"


def raised_in_actor(error: Exception) -> RaisedError:
    """The exception of an actor's call, which `workers.actor` has turned into texts."""
    cause = getattr(error, "cause", None)
    return cause if isinstance(cause, RaisedError) else RaisedError(error_text(error), "")


def error_text(error: Exception) -> str:
    """Text of an error without the colour codes that Ray adds."""
    return re.sub(r"\x1b\[[0-9;]*m", "", str(error))


class Refusals:
    """Nodes that refuse. They get no more workers, and the user is told of each host once."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._nodes: dict[str, str] = {}
        """Node id -> what its first worker said, which names the host and the files."""

    def __bool__(self) -> bool:
        return bool(self._nodes)

    def add(self, node: str, said: str) -> None:
        """Remember what a worker said on a node, and tell it if it is new."""
        if said not in self._nodes.values():
            self._tell(said)
        self._nodes.setdefault(node, said)

    def without(self, nodes: Membership) -> Membership:
        """The nodes of the cluster, of which those that refuse give no room."""
        rooms, free = (
            {node: 0 if node in self._nodes else room for node, room in of.items()} for of in (nodes.rooms, nodes.free)
        )
        return replace(nodes, rooms=rooms, free=free)

    def check(self, nodes: Membership | None) -> None:
        """Raise EvaluationError if no other node has room.

        Args:
            nodes: those of the cluster that was joined; None: a Ray of our own, with one node.
        """
        if nodes is None or not self.without(nodes).room:
            raise EvaluationError(str(self))

    def elsewhere(self) -> dict[str, Any]:
        """Options of an actor that Ray must not place on these nodes. If no other node has room, the actor waits."""
        selector = {"ray.io/node-id": f"!in({','.join(sorted(self._nodes))})"}
        return {"scheduling_strategy": "SPREAD", "label_selector": selector}

    def __str__(self) -> str:
        return "; ".join(dict.fromkeys(self._nodes.values()))


def _pickled(message: object) -> bytes:
    return pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
