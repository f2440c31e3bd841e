"""How long a generation takes with any number of workers: the real scheduler, with measured costs in simulated time.

Simulated are the workers, the way of a message and the driver's time for each message. The time that the scheduler
takes is added as it is measured meanwhile.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

from es_service.dispatch import events
from es_service.dispatch.engine import item_sizes
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import SchedulerState, initial_state, next_deadline, pending, usual_chunk_s

ROUNDS = 4
"""Simulated generations; the last one counts, when the scheduler knows the durations of all kinds of chunks."""
NEVER_S = 1e9
"""Time limit that is never reached."""
NOTHING = 0.95
"""Efficiency from which on nothing is named as the limit."""


@dataclass(frozen=True)
class Costs:
    """Measured times in seconds."""

    chunk_s: Mapping[str, float]
    """Kind of chunk -> time of one core for one chunk."""
    message_s: Mapping[str, float]
    """Kind of chunk -> time of the driver to send a work item and to receive the answer; half of it for each."""
    way_s: Mapping[str, float]
    """Kind of chunk -> time from the end of sending until the worker begins, and as much again from its end until the
    answer arrives."""
    driver_s: float
    """Time of the driver in a generation for the search, while no worker computes."""
    beside_s: float = 0.0
    """Time of the driver and the store for what they do while the first phase computes, such as a commit."""
    chunk_message_s: Mapping[str, float] = field(default_factory=dict)
    """Kind of chunk -> further time of the driver for each chunk of a work item but the first; 0 if it is not named."""

    def item_message_s(self, kind: str, chunks: int) -> float:
        """Time of the driver to send a work item and to receive the answer."""
        return self.message_s[kind] + (chunks - 1) * self.chunk_message_s.get(kind, 0.0)


@dataclass(frozen=True)
class Phase:
    """One of the three parts of a generation, whose chunks are all dispatched together."""

    name: str
    """rollout, gradient or evaluation."""
    kind: str
    chunks: int


@dataclass(frozen=True)
class Prediction:
    """A generation with some number of workers."""

    seconds: float
    efficiency: float
    """Share of the workers' time in which they compute chunks, from 0 to 1."""
    limit: str
    """What most of the other time is lost to; `nothing` if that is little."""


def predict(
    phases: Sequence[Phase],
    costs: Costs,
    actors: int,
    cores: int,
    longest_part: Callable[[int], float],
    clock: Callable[[], float] = time.thread_time,
    slowness: Callable[[int], float] = lambda actor: 1.0,
    late_factor: float = events.Limits.late_factor,
) -> Prediction:
    """Simulate generations.

    Args:
        actors: number of actors, which are the workers of the scheduler.
        cores: cores of each.
        longest_part: number of chunks in a work item -> number of chunks that the busiest core of an actor runs.
        clock: measures the time of the scheduler, of this thread alone, since others may compute beside it.
        slowness: number of an actor -> how many times as long as in `costs` it takes for a chunk.
        late_factor: as in `Limits`; infinity: no item is sent a second time.
    """
    limits = events.Limits(
        workers=actors,
        cores=cores,
        compile_timeout_s=NEVER_S,
        first_chunk_timeout_s=NEVER_S,
        chunk_timeout_s=NEVER_S,
        start_timeout_s=NEVER_S,
        late_factor=late_factor,
    )
    state = initial_state(limits)
    handle(state, events.Tick(), 0.0)
    for worker in range(actors):
        handle(state, events.WorkerUp(worker), 0.0)
        for phase in phases:
            handle(state, events.Compiled(worker, phase.kind, 0.0), 0.0)

    def seconds_of(worker: int, kind: str, chunks: int) -> float:
        return costs.chunk_s[kind] * longest_part(chunks) * slowness(worker)

    cluster = _Cluster(state, costs, seconds_of, clock)
    taken: dict[str, float] = {}
    for generation in range(ROUNDS):
        for number, phase in enumerate(phases):
            begun = cluster.now
            cluster.play(phase, generation)
            if number == 0:
                cluster.now = max(cluster.now, begun + costs.beside_s)
            taken[phase.name] = cluster.now - begun
        cluster.now += costs.driver_s
    return _judge(phases, costs, actors * cores, taken)


class _Cluster:
    """Simulated workers and the driver's time, with a real scheduler."""

    def __init__(
        self,
        state: SchedulerState,
        costs: Costs,
        seconds_of: Callable[[int, str, int], float],
        clock: Callable[[], float],
    ) -> None:
        self.now = 0.0
        self._state, self._costs, self._seconds_of, self._clock = state, costs, seconds_of, clock
        self._free_s = dict.fromkeys(state.up, 0.0)
        """Worker -> time at which it has finished what it was sent."""
        self._answers: list[tuple[float, int, float, events.Result]] = []
        """Heap of (time of arrival, number, time of the driver to receive it, answer)."""
        self._number = count()

    def play(self, phase: Phase, generation: int) -> None:
        """Pass the time until all chunks of a phase have been answered."""
        while self._answers and self._answers[0][0] <= self.now:
            self._read()  # second copies, whose phase has ended
        state, limits = self._state, self._state.limits
        sizes = item_sizes(phase.chunks, state.wanted, usual_chunk_s(state, phase.kind), limits.item_s, limits.cores)
        items = (events.WorkItem((generation, phase.name, i), phase.kind, size) for i, size in enumerate(sizes))
        self._step(events.Submit(tuple(items)))
        while pending(self._state):
            due_s = max(self.now, next_deadline(self._state))
            if self._answers and self._answers[0][0] <= due_s:
                self._read()
            else:
                self.now = due_s
                self._step(events.Tick())

    def _read(self) -> None:
        """Wait for the next answer and receive it."""
        arrives_s, _, message_s, answer = heapq.heappop(self._answers)
        self.now = max(self.now, arrives_s) + message_s
        self._step(answer)

    def _step(self, event: events.Event) -> None:
        """Pass an event to the scheduler and send the work items that it assigns."""
        began = self._clock()
        commands = handle(self._state, event, self.now)
        self.now += self._clock() - began
        for command in commands:
            if isinstance(command, events.Assign):
                worker, item = command.worker, self._state.items[command.item_id].item
                message_s = self._costs.item_message_s(item.kind, item.size) / 2
                self.now += message_s
                begins_s = max(self._free_s[worker], self.now + self._costs.way_s[item.kind])
                end_s = self._free_s[worker] = begins_s + self._seconds_of(worker, item.kind, item.size)
                answer = events.Result(worker, item.id, command.attempt)
                arrives_s = end_s + self._costs.way_s[item.kind]
                heapq.heappush(self._answers, (arrives_s, next(self._number), message_s, answer))


def _judge(phases: Sequence[Phase], costs: Costs, workers: int, taken: Mapping[str, float]) -> Prediction:
    """Efficiency, and the largest loss of the workers' time by its cause."""
    seconds = sum(taken.values()) + costs.driver_s
    lost = {"the driver": costs.driver_s * workers}
    computed = 0.0
    for phase in phases:
        chunk_s = costs.chunk_s[phase.kind]
        work = phase.chunks * chunk_s
        whole = -(-phase.chunks // workers) * chunk_s  # the shortest possible time, since chunks are not divided
        if phase.name == "evaluation":
            cause = "evaluation"
        else:
            cause = "too few items" if phase.chunks < 2 * workers else "the longest item"
        lost[cause] = lost.get(cause, 0.0) + max(0.0, whole * workers - work)
        lost["the driver"] += max(0.0, (taken[phase.name] - whole) * workers)
        computed += work
    efficiency = min(1.0, computed / (workers * seconds))
    return Prediction(seconds, efficiency, "nothing" if efficiency >= NOTHING else max(lost, key=lost.__getitem__))
