"""The Ray engine: workers are actors, on this machine or on a cluster.

Ray starts processes and moves messages. The scheduler decides on retries, deadlines and replacements: Ray never
restarts actors and never repeats calls, so each fault is reported here exactly once.

Each message is pickled here into one `bytes`, so that Ray moves a single small object, and a subject that fits into a
call needs no shared memory. Together this halves the time that Ray adds to a generation of short chunks.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from es_service.config.workload import ANY_NUMBER
from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.events import (
    Compiled,
    Drain,
    Failure,
    Limits,
    Log,
    Placed,
    SetWorkers,
    WorkerLost,
    WorkerUp,
    no_log,
)
from es_service.dispatch.ray_calls import (
    LOOK_S,
    LOOKS,
    Arguments,
    Call,
    Calls,
    Looks,
    Refusals,
    fault_reason,
    raised_in_actor,
)
from es_service.dispatch.ray_cluster import Connection, connected
from es_service.dispatch.ray_nodes import Claim, Growth, Membership, Watch, emptiest, layout, shortage, with_work
from es_service.dispatch.staying import use_of
from es_service.protocol.machine import cores
from es_service.protocol.messages import Report, Work, WorkerPlace, WorkerSpec
from es_service.protocol.sent import LACKS_AGAIN, Memory
from es_service.protocol.sources import OtherCodeError
from es_service.protocol.user_code import raised

MOST_GONE = 64
"""Lost workers of which the places are known."""
WORDS_S = 5.0
"""Longest wait for the last lines that a lost actor has printed."""
WORDS_BYTES = 6000
"""At most this many bytes of them are told. After what a simulator has said, Ray prints the frames of a crash."""


def ray_engine(
    spec: WorkerSpec,
    limits: Limits,
    should_stop: Callable[[], int | None] = lambda: None,
    *,
    actor: type,
    address: str | None = None,
    cpus: int | None = 1,
    gpus: float = 0.0,
    most: int = ANY_NUMBER,
    grows: bool = False,
    alone: bool = False,
    log: Log = no_log,
    on_wait: Callable[[str], None] = lambda shortage: None,
    on_compile: Callable[[str, str], None] = lambda kind, text: None,
    on_refusal: Callable[[str], None] = lambda refusal: None,
    on_report: Callable[[str, Report], None] = lambda worker, report: None,
) -> Engine[Actors]:
    """Engine whose workers are Ray actors, which are starting.

    Args:
        limits: with the number of cores of all workers together as the number of workers.
        actor: class of a worker, with the methods of `workers.actor.WorkerActor`.
        address: "HOST:PORT" of a cluster, or "auto" for the one on this machine. None starts a Ray of our own here,
            regardless of any other Ray and of RAY_ADDRESS, and ends it with the engine.
        cpus: cores of each worker, which must divide the number of cores in `limits`; None: in a cluster that is
            joined as many as each node has, see `actor_cores`, else 1.
        gpus: GPUs of each worker, or the share of one.
        most: number of cores that have work; no more start, except that an actor has all of its cores.
        grows: whether to use as many cores as there is room for, also when the room changes, and to ask for more if
            `cpus` is given, see `ASKED_AHEAD`; if not, use the number in `limits`.
        alone: whether an actor serves only runs with the same constants, whatever their seed, if it stays.
        on_wait: as in `Engine`; not called in a Ray of our own, which has room.
        on_compile: as in `Engine`.
        on_refusal, on_report: as in `Actors`.

    Raises:
        StartError: Ray is missing or does not start, there is no room for a worker, or the connection failed.
        Interrupted: SIGTERM arrived during the call.
    """
    each = cpus or 1
    ours = cores() if grows else with_work(limits.workers, each, most) * each
    if address is None:
        most = min(most, ours)  # if a Ray of our own has stayed, it may have more
    connection = connected(address, gpus=bool(gpus), cpus=ours)
    try:
        ray = connection.ray
        claim, limits, growth = layout(ray, limits, cpus, gpus, most, grows=grows, ours=address is None)
        watch = None if address is None else Watch(ray, claim)
        transport = Actors(
            connection,
            spec,
            actor,
            claim,
            watch,
            growth,
            limits.workers,
            on_refusal,
            on_report,
            items_at_once=limits.items_at_once,
            alone=alone,
        )
        on_wait = (lambda shortage: None) if watch is None else on_wait
        return Engine(transport, limits, should_stop, log, on_wait, on_compile)
    except BaseException:
        connection.keeps_logs = True
        connection.end()
        raise


class Actors:
    """Transport whose workers are Ray actors."""

    def __init__(
        self,
        connection: Connection,
        spec: WorkerSpec,
        actor: type,
        claim: Claim,
        watch: Watch | None,
        growth: Growth | None,
        workers: int,
        on_refusal: Callable[[str], None] = lambda refusal: None,
        on_report: Callable[[str, Report], None] = lambda worker, report: None,
        items_at_once: int = 1,
        *,
        alone: bool = False,
    ) -> None:
        """Make a transport without workers.

        Args:
            connection: a Ray, with actors that wait there; `close` gives it back, or ends it.
            watch: watch of the cluster that was joined; None in a Ray of our own, whose only node is this machine.
            growth: when the room for workers changes, `SetWorkers` follows it; None: no `SetWorkers`.
            workers: number of workers wanted at the start.
            on_refusal: called once for each host whose code is not the driver's, with what its worker said.
            on_report: called with a worker's name and its report.
            items_at_once: number of calls that an actor answers side by side, each in a thread.
            alone: as in `ray_engine`.
        """
        self._connection, self._ray = connection, (ray := connection.ray)
        self._spec, self._claim = pickle.dumps(spec, pickle.HIGHEST_PROTOCOL), claim
        options = {"num_cpus": claim.cpus, "num_gpus": claim.gpus, "max_restarts": 0, "max_task_retries": 0}
        options |= {"max_concurrency": items_at_once, "concurrency_groups": {LOOKS: 1}}
        self._class = connection.remote(actor, lambda: ray.remote(**options)(actor), claim, items_at_once)
        reads = {"num_cpus": 0, "max_retries": 0}
        self._read = connection.remote(ends_of_files, lambda: ray.remote(**reads)(ends_of_files))
        self._use: Hashable = (use_of(spec, alone=alone), actor, claim, items_at_once)
        self._waiting = connection.take(self._use)
        """Actors that have served other runs."""
        self._watch, self._growth, self._wanted = watch, growth, workers
        self._handles: dict[int, Any] = {}
        self._calls, self._arguments = Calls(ray), Arguments(ray)
        self._looks, self._look_s = Looks(ray, self._reported), time.monotonic() + LOOK_S
        self._places: dict[int, WorkerPlace] = {}
        self._planned: dict[int, str] = {}
        """Worker id -> node, for workers that have no place yet and are to be placed on a certain node."""
        self._platforms: set[str] = set()
        self._up, self._drained = set[int](), set[int]()
        self._has_lost = False
        self._followed: Membership | None = None
        """The state of the cluster that all workers are known to be in accord with."""
        self._nodes: frozenset[str] = frozenset()
        """Nodes that have been alive at some time."""
        self._to_ask: set[int] = set()
        """Workers that must be asked for their place again before the next chunks, because another worker was lost."""
        self._inbox: deque[Message] = deque()
        self._compiled: dict[int, set[str]] = {}
        """Worker id -> kinds of chunks for which it was told to compile."""
        self._parent_cache_bytes = spec.parent_cache_bytes
        self._memories: dict[int, Memory[int]] = {}
        """Worker id -> sizes of the arrays that it has."""
        self._lacking: set[tuple[int, Hashable, int]] = set()
        """Worker, work item and attempt for which the worker has lacked arrays once."""
        self._refusals = Refusals(on_refusal)
        self._on_report = on_report
        self._cpu_s: dict[int, float] = {}
        """Worker id -> seconds of processors that it has used by its newest answer, also of those that were lost."""
        self._gone: dict[int, WorkerPlace] = {}
        """Places of the workers that were lost last."""

    def places(self) -> dict[int, WorkerPlace]:
        """Worker id -> place, for the workers that have one."""
        return dict(self._places)

    def start(self, worker: int) -> None:
        """Ask Ray for an actor, or take one that waits. It is up when it has a place and has built its functions."""
        try:
            if self._waiting:
                handle, given = self._waiting.pop(0), (self._spec,)
            else:
                at, cores = self._class.options(**self._where(worker)), 1 if self._claim.gpus else self._claim.cpus
                handle, given = at.remote(self._spec, worker, self._claim.gpus, cores), ()
            self._handles[worker], self._compiled[worker] = handle, set()
            self._memories[worker] = Memory(self._parent_cache_bytes, int)
            self._calls[handle.place.remote()] = Call(worker, "place")
            self._calls[handle.build.remote(*given)] = Call(worker, "build")
        except self._ray.exceptions.RayError as error:
            self._lose(worker, f"cannot be started: {error}")

    def kill(self, worker: int) -> str:
        """Kill an actor and ignore its unanswered calls. Returns "", since its output is in Ray's logs on its node."""
        self._has_lost = True
        self._calls.forget(worker)
        self._up.discard(worker)
        if worker in self._places:
            self._gone = dict([*self._gone.items(), (worker, self._places[worker])][-MOST_GONE:])
        for known in (self._places, self._planned, self._compiled, self._memories):
            known.pop(worker, None)
        if (handle := self._handles.pop(worker, None)) is not None:
            with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.kill(handle, no_restart=True)
        self._to_ask = set(self._handles)
        return ""

    def last_words(self, worker: int) -> str:
        """The last lines that a lost actor has printed; in a cluster that was joined, if its node still answers within
        WORDS_S. The files of a Ray of our own are on this machine."""
        place = self._gone.pop(worker, None)
        if place is None or not place.logs:
            return ""
        if self._watch is None:
            return ends_of_files(place.logs, WORDS_BYTES)
        if (nodes := self._watch.latest().alive) and place.node not in nodes:
            return ""
        affinity = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(place.node, soft=False)
        read = self._read.options(scheduling_strategy=affinity)
        try:
            return self._ray.get(read.remote(place.logs, WORDS_BYTES), timeout=WORDS_S)
        except self._ray.exceptions.RayError:  # also if it takes too long
            return ""

    def send(self, worker: int, item_id: Hashable, attempt: int, work: Sequence[Work]) -> None:
        """Call the actor, first to compile if it has no chunks of this kind so far.

        The loss of an idle actor shows only when it is called. So after a loss, perhaps of a node, each other actor is
        asked for its place before its next chunks, which are charged with its loss only if it has answered that call.
        """
        if worker not in self._handles:
            return  # it has just been lost when it was sent other chunks, which `receive` is going to report
        try:
            arguments, kind = self._arguments.of(work, self._memories[worker]), type(work[0][1]).__name__
            if worker in self._to_ask:
                self._to_ask.discard(worker)
                self._calls[self._handles[worker].place.remote()] = Call(worker, "place")
            if kind not in self._compiled[worker]:
                self._compiled[worker].add(kind)
                self._calls[self._handles[worker].compile.remote(*arguments)] = Call(worker, "compile", kind=kind)
            ref = self._handles[worker].run.remote(*arguments)
        except self._ray.exceptions.RayError as error:
            self._lose(worker, fault_reason(error))
            return
        self._calls[ref] = Call(worker, "run", item_id, attempt, work)

    def cpu_s(self) -> float:
        """Seconds of the processors of this process, and of each actor for this run by its newest answer; without those
        of Ray's own processes."""
        return time.process_time() + sum(self._cpu_s.values())

    def platforms(self) -> frozenset[str]:
        """`machine.platform_text` of each kind of actor that has come up."""
        return frozenset(self._platforms)

    def silent(self) -> tuple[int, ...]:
        """Workers that have not answered the call for their place."""
        return tuple(worker for worker, what in self._calls.owed_first().items() if what == "place")

    def shortage(self) -> str:
        """What a worker needs and the cluster has, and which hosts refuse; this waits for the head node."""
        nodes = None if self._watch is None else self._refusals.without(self._watch.latest())
        return shortage(self._ray, self._claim, nodes) + (f". {self._refusals}" if self._refusals else "")

    def receive(self, timeout_s: float) -> Message | None:
        """The next message.

        Raises:
            EvaluationError: the cluster does not answer any more; or no worker is up, and all nodes with room refuse.
        """
        if self._watch is not None:
            self._follow(self._watch)
        if self._refusals and not self._up:
            self._refusals.check(None if self._watch is None else self._watch.latest())
        if (now := time.monotonic()) >= self._look_s:
            self._look_s = now + LOOK_S
            self._inbox += self._looks.look(self._calls.oldest(), self._handles)
        if self._inbox:
            return self._inbox.popleft()
        if not self._calls:
            time.sleep(timeout_s)
        while self._calls:
            if (ref := self._calls.answered(timeout_s)) is None:
                break
            if (message := self._message(ref)) is not None:
                return message
            timeout_s = 0.0  # a worker confirmed its place; another answer may be waiting, so do not return None
        return None

    def close(self) -> None:
        """Kill all actors, which end within seconds in a cluster that was joined; a Ray of our own has then ended. In a
        block of `workers`, those with nothing to do stay, and the connection with them."""
        if self._watch is not None:
            self._watch.close()
        # The logs of a Ray of our own are not needed if workers got places and none was lost.
        self._connection.keeps_logs |= self._has_lost or not self._places
        if not self._connection.answers():
            # For an actor of which the head does not know yet, Ray would wait for the head, and after a minute end this
            # process before the reason is told.
            self._handles.clear()
            self._waiting = []
        busy = set(self._calls.oldest()) | self._drained
        idle = [self._handles.pop(worker) for worker in sorted(self._up - busy) if worker in self._handles]
        for worker in list(self._handles):
            self.kill(worker)
        self._arguments.forget()
        self._connection.rest(self._use, [*idle, *self._waiting])

    def _message(self, ref: Any) -> Message | None:
        call, errors = self._calls[ref], self._ray.exceptions
        try:
            value = _read(call.what, self._ray.get(ref))
        except errors.RayTaskError as error:  # the call raised an exception, and the actor is alive
            if isinstance(error, OtherCodeError):
                return self._refused(call.worker, str(getattr(error, "cause", error)))
            said = raised_in_actor(error)
            if call.what not in ("compile", "run"):
                return self._lost(call.worker, said.message, traceback=said.traceback)
            del self._calls[ref]
            if call.what == "compile":  # the call of `run` behind it raises the same
                self._compiled[call.worker].discard(call.kind)
                return None
            return Failure(call.worker, call.item_id, call.attempt, said.message, said.traceback)
        except errors.RayError as error:
            return self._lost(call.worker, f"{self._place(call.worker)}: {fault_reason(error)}")
        except Exception as error:  # a damaged message can raise any exception when it is read
            said = raised(error)
            reason = f"{self._place(call.worker)}: its message cannot be read: {said.message}"
            return self._lost(call.worker, reason, traceback=said.traceback)
        del self._calls[ref]
        if call.what == "run":
            item = call.worker, call.item_id, call.attempt
            if value is None:  # it lacks arrays
                if item in self._lacking:
                    return Failure(*item, LACKS_AGAIN, "")
                self._lacking.add(item)
                self._memories[call.worker].clear()
                self.send(*item, call.work)
                return None
            self._lacking.discard(item)
            results, report, self._cpu_s[call.worker] = value
            if report is not None:
                self._reported(call.worker, report)
            return Answer(call.worker, call.item_id, call.attempt, results)
        if call.what == "compile":
            return Compiled(call.worker, call.kind, value)
        if call.what == "build":
            self._platforms.add(value)
            self._up.add(call.worker)
            return WorkerUp(call.worker)
        is_known = call.worker in self._places  # then it was asked again, to find out whether it is alive
        self._places[call.worker] = value
        self._planned.pop(call.worker, None)
        self._followed = None
        return None if is_known else Placed(call.worker)

    def _reported(self, worker: int, report: Report) -> None:
        """Pass on a worker's report; it is drained if it should be replaced."""
        self._on_report(f"worker {worker} on {self._place(worker)}", report)
        if report.spent and worker not in self._drained:
            self._drained.add(worker)
            self._inbox.append(Drain(worker))

    def _place(self, worker: int) -> str:
        """Where a worker is, in words."""
        return str(self._places.get(worker) or "before it had a place")

    def _follow(self, watch: Watch) -> None:
        """Report changes of the cluster. Drained and lost workers come before a smaller number of workers, which would
        otherwise drain others. Ray itself reports the end of an idle actor only when it is called."""
        now = watch.latest()
        if now is self._followed:
            return
        self._followed = now
        for worker, place in self._places.items():
            if place.node in now.leaving and worker not in self._drained:
                self._drained.add(worker)
                self._inbox.append(Drain(worker))
        if now.alive:  # an empty answer is no information, since the head node that gave it is alive
            gone = self._nodes - now.alive
            self._nodes |= now.alive
            for worker in [worker for worker, place in self._places.items() if place.node in gone]:
                self._lose(worker, f"{self._places[worker]}: its node died")
        room = self._refusals.without(now)
        if self._growth is not None and (wanted := self._growth.wanted(room, self._wanted)) != self._wanted:
            self._wanted = wanted
            self._inbox.append(SetWorkers(wanted))

    def _where(self, worker: int) -> dict[str, Any]:
        """Where Ray should place a worker, as options: with several cores, on the node that is most free. If none is,
        the worker waits for any node, and an autoscaler sees it; it does not see workers that wait for a certain node.
        """
        if self._refusals:
            return self._refusals.elsewhere()
        free = {} if self._watch is None or self._claim.cpus == 1 else self._watch.latest().free
        if (node := emptiest(free, self._planned.values())) is None:
            return {"scheduling_strategy": "SPREAD"}
        self._planned[worker] = node
        affinity = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
        return {"scheduling_strategy": affinity(node, soft=True, _spill_on_unavailable=True)}

    def _refused(self, worker: int, said: str) -> WorkerLost:
        """Give the node of a worker no others, except those that wait for a place already."""
        self._refusals.add(self._places[worker].node, said)
        self._followed = None
        return self._lost(worker, said, refused=True)

    def _lose(self, worker: int, reason: str) -> None:
        self._inbox.append(self._lost(worker, reason))

    def _lost(self, worker: int, reason: str, *, refused: bool = False, traceback: str = "") -> WorkerLost:
        has_begun = self._calls.owed_first().get(worker) in ("compile", "run")
        self.kill(worker)
        return WorkerLost(worker, reason, charge_item=has_begun, refused=refused, traceback=traceback)


def ends_of_files(files: Sequence[str], most_bytes: int) -> str:
    """The last lines of files of this host, together at most `most_bytes`; of those that can be read."""
    texts = []
    for name in files:
        with contextlib.suppress(OSError), open(name, "rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - most_bytes // len(files)))
            texts.append(file.read().decode(errors="replace").strip())
    return "\n".join(filter(None, texts))


def _read(what: str, value: Any) -> Any:
    """What a worker has answered to a call, where None of `run` says that it lacks arrays. Raises any
    exception for a message that no worker of ours sends."""
    match what:
        case "run":
            answer = pickle.loads(value)
            return None if answer is None else (list(answer[0]), answer[1], float(answer[2]))
        case "place":
            return WorkerPlace(*value)
        case "compile":
            return float(value)
    return str(value)
