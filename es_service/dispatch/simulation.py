"""How long a generation takes with any number of workers: the real scheduler, with measured costs in simulated time.

Simulated are the workers, the way of a message and the driver's time for each message. The time that the scheduler
takes is added as it is measured meanwhile.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from es_service.dispatch import events
from es_service.dispatch.engine import item_sizes
from es_service.dispatch.scheduler import step
from es_service.dispatch.scheduler_state import SchedulerState, initial_state, pending, usual_chunk_s

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
    """Time of the driver in a generation for everything else: the search and the store."""


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
    clock: Callable[[], float] = time.perf_counter,
) -> Prediction:
    """Simulate generations.

    Args:
        actors: number of actors, which are the workers of the scheduler.
        cores: cores of each.
        longest_part: number of chunks in a work item -> number of chunks that the busiest core of an actor runs.
        clock: measures the time of the scheduler.
    """
    limits = events.Limits(
        workers=actors, cores=cores, first_deadline_s=NEVER_S, min_deadline_s=NEVER_S, start_deadline_s=NEVER_S
    )
    state, _ = step(initial_state(limits), events.Tick(), 0.0)
    for worker in range(actors):
        state, _ = step(state, events.WorkerUp(worker), 0.0)
    now, taken = 0.0, {}
    for generation in range(ROUNDS):
        taken = {}
        for phase in phases:
            begun = now
            state, now = _play(state, phase, costs, now, generation, longest_part, clock)
            taken[phase.name] = now - begun
    return _judge(phases, costs, actors * cores, taken)


def _play(
    state: SchedulerState,
    phase: Phase,
    costs: Costs,
    now: float,
    generation: int,
    longest_part: Callable[[int], float],
    clock: Callable[[], float],
) -> tuple[SchedulerState, float]:
    """The state and the time after all chunks of a phase have been answered."""
    limits = state.limits
    sizes = item_sizes(phase.chunks, state.wanted, usual_chunk_s(state, phase.kind), limits.item_s, limits.cores)
    items = tuple(events.WorkItem((generation, phase.name, i), phase.kind, size) for i, size in enumerate(sizes))
    size_of = {item.id: item.size for item in items}
    free_s = dict.fromkeys(state.up, 0.0)
    answers: list[tuple[float, int, events.Result]] = []
    number, event = count(), events.Submit(items)
    while True:
        began = clock()
        state, commands = step(state, event, now)
        now += clock() - began
        for command in commands:
            if isinstance(command, events.Assign):
                now += costs.message_s[phase.kind] / 2
                chunks = size_of[command.item_id]
                takes_s = costs.chunk_s[phase.kind] * longest_part(chunks)
                end_s = free_s[command.worker] = max(free_s[command.worker], now + costs.way_s[phase.kind]) + takes_s
                result = events.Result(command.worker, command.item_id, command.attempt)
                heapq.heappush(answers, (end_s + costs.way_s[phase.kind], next(number), result))
        if not pending(state):
            return state, now
        arrives_s, _, event = heapq.heappop(answers)
        now = max(now, arrives_s) + costs.message_s[phase.kind] / 2


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
