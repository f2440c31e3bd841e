"""The scheduler by hand: limits, items named by letters, workers that are ready."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

from es_service.dispatch.events import Command, Compiled, Event, Limits, StartWorker, Submit, Tick, WorkerUp, WorkItem
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import IN_TIME, SchedulerState, initial_state, next_time

CONTAINERS = "starting", "up", "draining", "deadlines", "preparing", "free", "items", "places", "late", "durations_s"
LIMITS = Limits(
    workers=2,
    in_flight=2,
    max_attempts=3,
    start_timeout_s=50.0,
    compile_timeout_s=200.0,
    first_chunk_timeout_s=100.0,
    late_factor=math.inf,
    chunk_timeout_s=10.0,
    deadline_factor=5.0,
    max_failures_in_a_row=2,
    restart_backoff_s=1.0,
    max_backoff_s=3.0,
    max_start_failures=3,
    no_worker_timeout_s=30.0,
)


def copied(state: SchedulerState) -> SchedulerState:
    """An equal state that has nothing in common with it that can change."""
    return replace(state, **{name: copy(getattr(state, name)) for name in CONTAINERS})


def step(state: SchedulerState, event: Event, now: float) -> tuple[SchedulerState, list[Command]]:
    """`handle` for a copy of the state: (the state after the event, the commands)."""
    after = copied(state)
    return after, handle(after, event, now)


def play(state: SchedulerState, *events: tuple[float, Event]) -> tuple[SchedulerState, list[Command]]:
    """The state after all events, and the commands of the last."""
    commands: list[Command] = []
    for now, event in events:
        state, commands = step(state, event, now)
        check_consistency(state)
    return state, commands


def items(item_ids: str) -> Submit:
    """One item per letter; capitals are of another kind."""
    return Submit(tuple(WorkItem(item_id, "train" if item_id.islower() else "evaluate") for item_id in item_ids))


def cold(workers: int = 2, **changes: object) -> SchedulerState:
    """All workers up at time 0."""
    state, commands = step(initial_state(replace(LIMITS, workers=workers, **changes)), Tick(), 0.0)
    assert commands == [StartWorker(worker) for worker in range(workers)]
    return play(state, *((0.0, WorkerUp(worker)) for worker in range(workers)))[0]


def ready(workers: int = 2, **changes: object) -> SchedulerState:
    """All workers up at time 0, when they have compiled for both kinds."""
    kinds = [(worker, kind) for worker in range(workers) for kind in ("train", "evaluate")]
    return play(cold(workers, **changes), *((0.0, Compiled(*each, 0.0)) for each in kinds))[0]


def check_consistency(state: SchedulerState) -> None:
    """Assert that what a state has twice, so that nobody need look for it, is the same in both places."""
    deadlines = []
    for group in (state.starting, state.up, state.draining):
        records = [(worker, group[worker]) for worker in group]
        assert [record.rank for _, record in records] == sorted({record.rank for _, record in records})
        deadlines += [(at_s, worker) for worker, record in records if (at_s := next_time(record)) < math.inf]
    assert list(state.deadlines) == sorted(deadlines)
    groups = {**state.starting, **state.up, **state.draining}
    preparing = {worker: record.preparing for worker, record in groups.items() if record.preparing is not None}
    assert state.preparing == preparing
    loads = [
        (len(record.slots), record.pace, record.rank, worker) for worker, record in ((w, state.up[w]) for w in state.up)
    ]
    assert list(state.free) == sorted(entry for entry in loads if entry[0] < state.limits.in_flight)
    if state.failed is None:
        assert state.in_time == sum(record.pace == IN_TIME for record in state.up.values())
    waiting = [(item_id, state.items[item_id]) for item_id in state.items]
    assert all((record.place is None) != (record.holder is None) for _, record in waiting)
    assert all(record.second is None or record.second != record.holder is not None for _, record in waiting)
    if state.failed is None:
        assert set(state.late) == {(record.late, item_id) for item_id, record in waiting if record.late is not None}
        assert {item_id for _, item_id in state.late} == {
            item_id
            for item_id, record in waiting
            if record.holder is not None
            and record.second is record.last_holder is None
            and (state.up.get(record.holder) or state.draining[record.holder]).pace != IN_TIME
        }
        assert list(state.places) == sorted((r.place, item_id) for item_id, r in waiting if r.place is not None)
        assert state.queue == [item_id for _, item_id in state.places]
