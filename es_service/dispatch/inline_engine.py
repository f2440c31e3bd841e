"""The inline engine: workers are child processes of this process, or threads of one child, connected by sockets.

Children are started by exec with fixed settings (one XLA thread; the CPU, or a GPU) and never forked, so the caller's
use of JAX has no effect on them. For the same reason, workers are never threads of this process. The engine itself has
no threads either, but one that cuts what children print: it polls the sockets, so a child that stops in the middle of a
message or does not read cannot block it.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.events import (
    Compiled,
    Drain,
    Failure,
    Limits,
    Log,
    Placed,
    Progress,
    WorkerLost,
    WorkerUp,
    no_log,
    with_last_words,
)
from es_service.dispatch.staying import staying, use_of
from es_service.protocol.child import Child, socket_pair
from es_service.protocol.content import Cache
from es_service.protocol.machine import places
from es_service.protocol.messages import FloatArray, Report, Work, WorkerSpec
from es_service.protocol.process_environment import child_environment
from es_service.protocol.sent import LACKS_AGAIN, SENDER_BYTES, Memory, parcel
from es_service.protocol.user_code import RaisedError, raised
from es_service.protocol.wire import Channel, framed

PIECE_S = 0.1
"""Longest wait in seconds for the next part of a message whose beginning has been received."""


def inline_engine(
    spec: WorkerSpec,
    limits: Limits,
    should_stop: Callable[[], int | None] = lambda: None,
    *,
    threads: bool = False,
    gpus: float = 0.0,
    alone: bool = False,
    log: Log = no_log,
    on_compile: Callable[[str, str], None] = lambda kind, text: None,
    on_report: Callable[[str, Report], None] = lambda worker, report: None,
) -> Engine[ChildProcesses]:
    """Engine with `limits.workers` workers on this machine, which are starting.

    Args:
        spec: constants of the run.
        limits: number of workers, deadlines and numbers of attempts.
        threads: whether workers are threads of one child, which takes less memory; if one is lost, all are lost.
        gpus: GPUs of each worker, or the share of one. There must be room for `limits.workers`, see `gpus.places`.
        alone: whether a process serves only runs with the same constants, whatever their seed, if it stays.
        should_stop, log, on_compile: as in `Engine`.
        on_report: called with a worker's name and its report.
    """
    transport = ChildProcesses(spec, threads=threads, gpus=gpus, alone=alone, on_report=on_report)
    return Engine(transport, limits, should_stop, log, on_compile=on_compile)


@dataclass(eq=False)
class _Worker:
    """A worker that is not known to be lost."""

    child: Child
    place: str
    """The GPUs that the child may use, as CUDA_VISIBLE_DEVICES names them."""
    use: Hashable
    """What the child can be used for, if it stays."""
    channel: Channel
    memory: Memory[int]
    """Sizes of the arrays that it has."""
    unanswered: dict[tuple[Hashable, int], Sequence[Work]] = field(default_factory=dict)
    """Work items that it was sent and has not answered, by id and attempt."""
    lacking: set[tuple[Hashable, int]] = field(default_factory=set)
    """Those of them for which it has lacked arrays once."""


class ChildProcesses:
    """Transport whose workers are child processes, or threads of one child process."""

    def __init__(
        self,
        spec: WorkerSpec,
        *,
        threads: bool = False,
        gpus: float = 0.0,
        alone: bool = False,
        on_report: Callable[[str, Report], None] = lambda worker, report: None,
    ) -> None:
        self._spec, self._threads = framed(spec), threads
        self._use = use_of(spec, alone=alone)
        self._gpus, self._places = gpus, places(os.environ, gpus) if gpus else ()
        self._on_report = on_report
        self._platforms: set[str] = set()
        self._parent_cache_bytes, self._output_bytes = spec.parent_cache_bytes, spec.output_bytes
        self._workers: dict[int, _Worker] = {}
        self._begun_s: dict[Child, float] = {}
        """Seconds of processors that a child had used when it began to work for this run."""
        self._ended_s = 0.0
        """Seconds of those that no longer do, for this run."""
        self._by_descriptor: dict[int, int] = {}
        self._poll = select.poll()
        self._ready: deque[Message] = deque()
        self._frames: Cache[bytes, bytes] = Cache(len)
        """Messages with the newest arrays, by name."""

    def process_ids(self) -> dict[int, int]:
        """Worker id -> process id, for the workers that are not known to be lost; for diagnosis and tests."""
        return {number: worker.child.pid for number, worker in self._workers.items()}

    def cpu_s(self) -> float:
        """Seconds of the processors of this process, and of all children for this run."""
        return time.process_time() + self._ended_s + sum(child.cpu_s - begun for child, begun in self._begun_s.items())

    def start(self, worker: int) -> None:
        """Start a child and send it the constants of the run; or have the existing child start another thread."""
        with ExitStack() as undo:
            try:
                ours, theirs = map(undo.enter_context, socket_pair())
                running = next(iter(self._workers.values()), None) if self._threads else None
                place = self._free_place() if running is None else running.place
                use, child = self._child_for(place) if running is None else (running.use, running.child)
                if running is None:
                    undo.callback(child.end)
                socket.send_fds(child.socket, [b"w"], [theirs.fileno()])
            except OSError as error:  # no more processes, file descriptors or disk space, or the child has just ended
                self._ready.append(WorkerLost(worker, f"worker {worker} cannot be started: {error}"))
                return
            undo.pop_all()
        theirs.close()
        self._add(worker, child, ours, place, use)
        self._ready.append(Placed(worker))

    def kill(self, worker: int) -> str:
        """Kill a worker's child, wait for its end and free its resources; other workers of this child are then lost.

        Returns the child's last output.
        """
        if worker not in self._workers:
            return ""
        child = self._forget(worker)
        return self._lose(child, f"worker {worker}, a thread of the same process, was killed", charge_items=False)

    def last_words(self, worker: int) -> str:
        """Empty, since a loss says it."""
        return ""

    def send(self, worker: int, item_id: Hashable, attempt: int, work: Sequence[Work]) -> None:
        """Send the chunks, after the arrays that the worker lacks."""
        to = self._workers.get(worker)
        if to is None:
            return  # lost with another thread of its child, which `receive` is going to report
        arrays, origins, pickled = parcel(work, to.memory)
        frames = [self._framed(*named) for named in arrays.items()]
        to.unanswered[item_id, attempt] = work
        to.channel.send(*frames, framed(("work", item_id, attempt, origins, pickled)))
        self._watch(to.channel)

    def platforms(self) -> frozenset[str]:
        """Empty, since children share this machine and its packages, unless they use GPUs, whose kind they name."""
        return frozenset(self._platforms)

    def silent(self) -> tuple[int, ...]:
        """Empty, since sockets show at once that a child is gone."""
        return ()

    def shortage(self) -> str:
        """Empty, since every child that can be started has a place."""
        return ""

    def receive(self, timeout_s: float) -> Message | None:
        """The next message of any worker. A child that closed a socket is killed before its loss is reported."""
        until = time.monotonic() + timeout_s
        while not self._ready:
            wait_s = max(0.0, until - time.monotonic())
            is_coming = False
            for descriptor, events in self._poll.poll(wait_s * 1000.0):
                if descriptor in self._by_descriptor:  # else it has just been lost together with another worker
                    is_coming |= self._serve(self._by_descriptor[descriptor], events)
            if is_coming:  # a large message arrives in parts; once the first is here, wait for the others
                until = max(until, time.monotonic() + PIECE_S)
            elif not wait_s and not self._ready:
                return None
        return self._ready.popleft()

    def close(self) -> None:
        """Kill all children and wait until they have ended; in a block of `workers`, those with nothing to do stay."""
        busy = {worker.child for worker in self._workers.values() if worker.unanswered or worker.channel.is_full}
        idle = {worker.child: worker.use for worker in self._workers.values() if worker.child not in busy}
        for child in busy:
            child.kill()  # kill all before waiting, since each takes some time to free its memory
        for number in list(self._workers):
            self._forget(number)
        for child in busy:
            child.end()
        for child in [*self._begun_s]:
            self._count(child)
        for child, use in idle.items():
            staying().give(use, child)

    def _free_place(self) -> str:
        """The place at the GPUs that has the fewest workers."""
        taken = [worker.place for worker in self._workers.values()]
        return min(self._places, key=lambda place: taken.count(place) / self._places.count(place), default="")

    def _child_for(self, place: str) -> tuple[Hashable, Child]:
        """A process that has been sent the constants of the run, one that has stayed or a new one; and its use."""
        environment = child_environment(self._gpus, place)
        use = self._use, os.getcwd(), *sorted(environment.items())
        if (child := staying().take(use)) is None:
            child, begun_s = Child("workers.process", environment, self._output_bytes), 0.0
        else:
            child.forget_output()
            begun_s = child.cpu_s
        try:
            child.socket.setblocking(True)
            child.socket.sendall(b"s" + self._spec)
            child.socket.setblocking(False)  # if it does not take its workers' sockets, they cannot be started
        except BaseException:
            child.end()
            raise
        self._begun_s[child] = begun_s
        return use, child

    def _count(self, child: Child) -> None:
        """Remember the processors' time of a child that no longer works for this run."""
        if (begun_s := self._begun_s.pop(child, None)) is not None:
            self._ended_s += child.cpu_s - begun_s

    def _framed(self, name: bytes, array: FloatArray) -> bytes:
        """The message with an array, which is made once for all workers."""
        if (frame := self._frames.get(name)) is None:
            frame = framed(("arrays", {name: array}))
            self._frames.add(name, frame)
            self._frames.forget_oldest(SENDER_BYTES)
        return frame

    def _add(self, number: int, child: Child, ours: socket.socket, place: str = "", use: Hashable = None) -> None:
        self._workers[number] = _Worker(child, place, use, Channel(ours), Memory(self._parent_cache_bytes, int))
        self._by_descriptor[ours.fileno()] = number
        self._poll.register(ours, select.POLLIN)

    def _watch(self, channel: Channel) -> None:
        self._poll.modify(channel, select.POLLIN | (select.POLLOUT if channel.is_full else 0))

    def _serve(self, number: int, events: int) -> bool:
        """Send bytes that wait for a worker and read its messages; returns whether a message is incomplete."""
        worker = self._workers[number]
        if events & select.POLLOUT:
            worker.channel.flush()
            self._watch(worker.channel)
        if not events & ~select.POLLOUT:
            return False
        if (wrong := self._hear(number)) is not None:
            self._lose(worker.child, wrong.message, wrong.traceback)
            return False
        return worker.channel.is_halfway

    def _hear(self, number: int) -> RaisedError | None:
        """Read a worker's messages. Returns None, or if the worker is lost, the reason, empty if it is not known."""
        try:
            worker = self._workers[number]
            messages, is_open = worker.channel.receive()
            for said in messages:
                match said:
                    case ("up", platform):
                        self._platforms |= {platform} - {""}
                        self._ready.append(WorkerUp(number))
                    case ("compiled", kind, seconds):
                        self._ready.append(Compiled(number, kind, seconds))
                    case ("progress", doing, done, total):
                        self._ready.append(Progress(number, doing, done, total))
                    case ("report", Report() as report):
                        self._on_report(f"worker {number}", report)
                        if report.spent:
                            self._ready.append(Drain(number))
                    case ("results", item_id, attempt, results):
                        worker.unanswered.pop((item_id, attempt), None)
                        worker.lacking.discard((item_id, attempt))
                        self._ready.append(Answer(number, item_id, attempt, results))
                    case ("failure", item_id, attempt, error):
                        worker.unanswered.pop((item_id, attempt), None)
                        self._ready.append(Failure(number, item_id, attempt, error.message, error.traceback))
                    case ("lacks", item_id, attempt) if (item_id, attempt) in worker.lacking:
                        worker.unanswered.pop((item_id, attempt), None)
                        self._ready.append(Failure(number, item_id, attempt, LACKS_AGAIN, ""))
                    case ("lacks", item_id, attempt):
                        worker.lacking.add((item_id, attempt))
                        worker.memory.clear()
                        self.send(number, item_id, attempt, worker.unanswered[item_id, attempt])
                    case ("broken", error):
                        return error
                    case _:
                        return RaisedError(f"it sent an unknown message: {said!r}", "")
        except Exception as error:  # a damaged message can raise any exception when it is unpickled
            return raised(error)
        return None if is_open else RaisedError("", "")

    def _forget(self, number: int) -> Child:
        worker = self._workers.pop(number)
        self._poll.unregister(worker.channel)
        del self._by_descriptor[worker.channel.fileno()]
        worker.channel.close()
        return worker.child

    def _lose(self, child: Child, reason: str = "", traceback: str = "", *, charge_items: bool = True) -> str:
        """Kill a child and report the loss of its remaining workers, after their messages; returns its last output.

        The item of a worker that had none is not charged with the loss: before the scheduler learns of the loss, it may
        send that worker an item of another worker of this child.
        """
        lost = {number: worker for number, worker in self._workers.items() if worker.child is child}
        for number in lost:
            self._hear(number)
            self._forget(number)
        end = child.end()
        self._count(child)
        if not reason:
            reason = f"worker {', '.join(map(str, lost))} (pid {child.pid}) ended with {end}"
        elif not charge_items:
            reason = with_last_words(reason, end.last_words)
        for number, worker in lost.items():
            self._ready.append(
                WorkerLost(number, reason, charge_item=bool(worker.unanswered) and charge_items, traceback=traceback)
            )
        return end.last_words
