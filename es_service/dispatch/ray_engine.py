"""The Ray engine: workers are actors, on this machine or on a cluster.

Ray starts processes and moves messages. Retries, deadlines and replacements are the scheduler's: actors are never
restarted by Ray and calls are never repeated by it, so each fault is seen here once, as what it was.

Messages are pickled here, into one `bytes` each: Ray then has a single small object to move, and a centre that fits
into a call needs no shared memory. Both together halve what Ray adds to a generation of short chunks.
"""

from __future__ import annotations

import contextlib
import pickle
import re
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from es_service.dispatch.dispatch_log import Log, no_log
from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.events import Drain, Failure, Limits, Placed, SetWorkers, WorkerLost, WorkerUp
from es_service.dispatch.ray_cluster import ONE_CORE, Claim, Watch, connect, demand, disconnect, look
from es_service.errors import EvaluationError
from es_service.protocol.messages import Centre, Chunk, WorkerPlace, WorkerSpec

IN_CALL_BYTES = 64 * 2**10
"""A centre up to this size travels with every call; a larger one is stored once and fetched once per node."""


def ray_engine(
    spec: WorkerSpec,
    limits: Limits,
    should_stop: Callable[[], int | None] = lambda: None,
    *,
    actor: type,
    address: str | None = None,
    claim: Claim = ONE_CORE,
    elastic: bool = False,
    log: Log = no_log,
) -> Engine[Actors]:
    """An Evaluator whose workers are Ray actors, starting.

    Args:
        actor: the worker's class, with the methods of `workers.actor.WorkerActor`.
        address: a cluster's "HOST:PORT", or "auto" for the one on this machine; None starts a Ray of our own here,
            whatever other Ray or RAY_ADDRESS there may be, and ends it with the engine.
        claim: what one worker needs of a node.
        elastic: as many workers as there is room for, instead of `limits.workers`; in a cluster, also when it changes.

    Raises:
        EvaluationError: Ray is missing, does not start, has no room for a worker on this machine, or no cluster answers
            at the address. Interrupted: SIGTERM arrived meanwhile.
    """
    ray = connect(address, claim, limits.workers if elastic else limits.workers * claim.cpus)
    try:
        room = look(ray, claim).room
        if address is None and not room:  # nor will there ever be
            raise EvaluationError(f"this machine has no place for a worker. {demand(ray, claim)}")
        if elastic:
            limits = replace(limits, workers=max(1, room))
        watch = None if address is None else Watch(ray, claim)
        transport = Actors(ray, spec, actor, claim, watch, limits.workers if elastic else None, limits)
        return Engine(transport, limits, should_stop, log)
    except BaseException:
        disconnect(ray)
        raise


@dataclass(frozen=True)
class _Call:
    """What a result still to come is the answer to."""

    worker: int
    what: str
    """place, build or run."""
    item_id: Hashable = None
    attempt: int = 0


class Actors:
    """A Transport whose workers are Ray actors."""

    def __init__(
        self,
        ray: ModuleType,
        spec: WorkerSpec,
        actor: type,
        claim: Claim,
        watch: Watch | None,
        room: int | None,
        limits: Limits,
    ) -> None:
        """Start nobody yet.

        Args:
            watch: of the cluster that was joined; None in a Ray of our own, whose one node is this machine.
            room: workers to ask for as the cluster is now; from then on follow its room. None: never ask.
            limits: how long to wait for the first place.
        """
        self._ray = ray
        self._spec, self._claim, self._limits = pickle.dumps(spec, pickle.HIGHEST_PROTOCOL), claim, limits
        self._class = ray.remote(
            num_cpus=claim.cpus,
            num_gpus=claim.gpus,
            max_restarts=0,
            max_task_retries=0,
            scheduling_strategy="SPREAD",
        )(actor)
        self._watch, self._room = watch, room
        self._handles: dict[int, Any] = {}
        self._calls: dict[Any, _Call] = {}
        self._places: dict[int, WorkerPlace] = {}
        self._platforms: set[str] = set()
        self._drained: set[int] = set()
        self._has_lost = False
        self._nodes: frozenset[str] = frozenset()
        """All that were alive at some time."""
        self._to_ask: set[int] = set()
        """Workers to be asked for their place again before they are sent anything, since another was lost."""
        self._inbox: deque[Message] = deque()
        self._centre: tuple[Centre, Any] | None = None
        # Ray itself would wait for ever: a cluster may have to grow, or others there to end. The scheduler counts as
        # long from later on, so that it is said here, where it is known what is free.
        self._placed_by_s = time.monotonic() + limits.no_worker_timeout_s

    def places(self) -> dict[int, WorkerPlace]:
        """Worker id -> where it is, of those that have a place."""
        return dict(self._places)

    def start(self, worker: int) -> None:
        """Ask Ray for an actor; it is up once it has a place and has built its functions."""
        try:
            handle = self._class.remote(self._spec, worker, self._claim.gpus)
            self._handles[worker] = handle
            self._calls[handle.place.remote()] = _Call(worker, "place")
            self._calls[handle.build.remote()] = _Call(worker, "build")
        except self._ray.exceptions.RayError as error:
            self._lose(worker, f"cannot be started: {error}")

    def kill(self, worker: int) -> str:
        """Kill an actor's process and drop whatever it still owes. What it wrote is on its node, in Ray's logs."""
        self._has_lost = True
        for ref in [ref for ref, call in self._calls.items() if call.worker == worker]:
            del self._calls[ref]
        self._places.pop(worker, None)
        handle = self._handles.pop(worker, None)
        self._to_ask = set(self._handles)
        if handle is not None:
            with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.kill(handle, no_restart=True)
        return ""

    def send(self, worker: int, centre: Centre, item_id: Hashable, attempt: int, chunks: Sequence[Chunk]) -> None:
        """Call the actor. A centre is stored once, however many calls share it, and dropped with the next one.

        That an idle actor is gone shows only when it is called. So after a loss, which may have been that of a node,
        each other actor is asked for its place ahead of its next chunks: if it is gone too, it has not begun them, and
        they are not to blame; if it answers, they are, should it die of them.
        """
        if worker not in self._handles:
            return  # lost a moment ago, when it was sent other chunks; that is on its way to the scheduler
        try:
            if self._centre is None or self._centre[0] is not centre:
                pickled = pickle.dumps(centre, pickle.HIGHEST_PROTOCOL)
                self._centre = centre, pickled if len(pickled) <= IN_CALL_BYTES else self._ray.put(pickled)
            if worker in self._to_ask:
                self._to_ask.discard(worker)
                self._calls[self._handles[worker].place.remote()] = _Call(worker, "place")
            ref = self._handles[worker].run.remote(self._centre[1], pickle.dumps(chunks, pickle.HIGHEST_PROTOCOL))
        except self._ray.exceptions.RayError as error:
            self._lose(worker, _reason(error))
            return
        self._calls[ref] = _Call(worker, "run", item_id, attempt)

    def platforms(self) -> frozenset[str]:
        """What each kind of actor that has come up said of its packages and processor."""
        return frozenset(self._platforms)

    def silent(self) -> tuple[int, ...]:
        """Workers that have not answered where they are."""
        return tuple(worker for worker, what in self._owed_first().items() if what == "place")

    def receive(self, timeout_s: float) -> Message | None:
        """The next message.

        Raises:
            EvaluationError: no actor has said for too long where it is, or the cluster does not answer any more.
        """
        if self._watch is not None:
            self._follow(self._watch)
        if self._inbox:
            return self._inbox.popleft()
        if not self._calls:
            time.sleep(timeout_s)
            return None
        while self._calls:
            # Oldest first, so that the answers of one worker stay in order.
            ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=timeout_s)
            if not ready:
                break
            if (message := self._message(ready[0])) is not None:
                return message
            timeout_s = 0.0  # that was where a worker still is; None would say that no answer waits behind it
        if not self._places and time.monotonic() > self._placed_by_s:
            time_s = f"{self._limits.no_worker_timeout_s:g} s ({self._limits.name_of('no_worker_timeout_s')})"
            if self._watch is None:  # which has a place for each: their processes do not start, or very slowly
                raise EvaluationError(f"no worker's process answered in {time_s}. {demand(self._ray, self._claim)}")
            raise EvaluationError(
                f"no worker was given a place in {time_s}. {demand(self._ray, self._claim)}. Add nodes, or stop what "
                "else runs there."
            )
        return None

    def close(self) -> None:
        """Kill all actors and leave the cluster, where they end seconds later; a Ray of our own has then ended."""
        if self._watch is not None:
            self._watch.close()
        # Nobody reads the logs of a session of our own in which all went well: workers came up, and none was lost.
        forget = self._watch is None and bool(self._places) and not self._has_lost
        for worker in list(self._handles):
            self.kill(worker)
        self._calls.clear()
        self._centre = None
        disconnect(self._ray, forget=forget)

    def _message(self, ref: Any) -> Message | None:
        call, errors = self._calls[ref], self._ray.exceptions
        try:
            value = self._ray.get(ref)
        except errors.RayTaskError as error:  # it raised, and lives
            if call.what != "run":
                return self._lost(call.worker, _text(error))
            del self._calls[ref]
            return Failure(call.worker, call.item_id, call.attempt, _text(error))
        except errors.RayError as error:
            where = self._places.get(call.worker)
            return self._lost(call.worker, f"{where or 'before it had a place'}: {_reason(error)}")
        del self._calls[ref]
        if call.what == "run":
            return Answer(call.worker, call.item_id, call.attempt, pickle.loads(value))
        if call.what == "build":
            self._platforms.add(value)
            return WorkerUp(call.worker)
        is_known = call.worker in self._places  # it was asked again, whether it is still there
        self._places[call.worker] = WorkerPlace(*value)
        self._placed_by_s = float("inf")
        return None if is_known else Placed(call.worker)

    def _follow(self, watch: Watch) -> None:
        """Report what has changed in the cluster: drains and losses first, so that a smaller number sends nobody else
        away. Ray itself tells of an idle actor's end only when it is called."""
        now = watch.latest()
        for worker, place in self._places.items():
            if place.node in now.leaving and worker not in self._drained:
                self._drained.add(worker)
                self._inbox.append(Drain(worker))
        if now.alive:  # else the look has shown nothing, for somebody answered it
            gone = self._nodes - now.alive
            self._nodes |= now.alive
            for worker in [worker for worker, place in self._places.items() if place.node in gone]:
                self._lose(worker, f"{self._places[worker]}: its node died")
        if self._room is not None and now.room and now.room != self._room:
            self._room = now.room
            self._inbox.append(SetWorkers(now.room))

    def _owed_first(self) -> dict[int, str]:
        """Worker -> the first call that it has not answered: place, build or run."""
        first: dict[int, str] = {}
        for call in self._calls.values():
            first.setdefault(call.worker, call.what)
        return first

    def _lose(self, worker: int, reason: str) -> None:
        self._inbox.append(self._lost(worker, reason))

    def _lost(self, worker: int, reason: str) -> WorkerLost:
        has_begun = self._owed_first().get(worker) == "run"
        self.kill(worker)
        return WorkerLost(worker, reason, bystander=not has_begun)


def _reason(error: Exception) -> str:
    """What a fault of an actor means, on one line."""
    first = _text(error).strip().partition("\n")[0]
    known = {
        "OutOfMemoryError": "its node ran out of memory and Ray killed it",
        "ActorUnavailableError": "its node does not answer",
        "ActorDiedError": "its process or its node died",
    }
    kind = type(error).__name__
    return f"{known.get(kind, kind)}: {first}"


def _text(error: Exception) -> str:
    """What an error says, without the colours that Ray gives it whoever may read it."""
    return re.sub(r"\x1b\[[0-9;]*m", "", str(error))
