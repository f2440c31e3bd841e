"""Assignment of work items to workers. `scheduler.handle` uses it.

Idle workers are served first, those that answered their last item in time before others, then workers that can take
another item behind the one they run. A work item that failed on a worker is not assigned to that worker again while
another worker is up: otherwise a broken worker that fails at once would use up the attempts of good items. If workers
begin an item before they have finished another, none is assigned behind another one from a loss until the next result:
the next loss, if it is the cause, would be charged to the other one again.
"""

from __future__ import annotations

from es_service.dispatch.deadlines import begin_first_slot
from es_service.dispatch.events import Assign, Command
from es_service.dispatch.scheduler_changes import put_worker, take_item
from es_service.dispatch.scheduler_state import SchedulerState, Slot, Waiting


def assign(s: SchedulerState, out: list[Command], now: float) -> None:
    """Assign queued items to workers that can take more, idle workers first."""
    for load in range(1 if s.limits.items_at_once > 1 and s.losses_in_a_row else s.limits.in_flight):
        passed = 0
        while s.places and passed < len(s.free):
            slots, _, _, worker = s.free[passed]
            if slots > load:
                break
            waiting = _next_for(s, worker) if slots == load else None
            if waiting is None:
                passed += 1
                continue
            take_item(s, waiting, worker)  # the worker leaves its place in `free`, and the next one moves up
            s.retries += waiting.item.size if waiting.last_holder is not None else 0
            slot, record = Slot(waiting.item, waiting.faults + 1), s.up[worker]
            record = record._replace(slots=(*record.slots, slot))
            put_worker(s, s.up, worker, begin_first_slot(s, record, now) if load == 0 else record)
            out.append(Assign(worker, waiting.item.id, slot.attempt))


def _next_for(s: SchedulerState, worker: int) -> Waiting | None:
    """The first item in the queue that may be assigned to a worker, or None."""
    for _, item_id in s.places:
        waiting = s.items[item_id]
        if waiting.last_holder != worker or len(s.up) == 1:
            return waiting
    return None
