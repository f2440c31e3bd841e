"""Second copies of the last work items of a phase, so that it need not wait for a slow or hanging worker.

When nothing is in the queue, an idle worker is sent an item that another one is late with, or that waits behind such an
item. The first answer counts, and the other is dropped like any duplicate: an item is answered as a whole, so no part
of a gradient is added twice. It never has more than one copy, and none after a loss or a failure, since it may be the
cause. A copy is no retry; if it makes its worker fail, the item is charged as ever.

A worker is late if its item takes much longer than usual, not counting the time of compiling, and slow until it answers
an item in time. The items of a slow worker, or of a new one, which must compile, are copied as soon as another worker
is idle. While a worker is known
to be in time, slow and new workers get no copies, so that the workers of a slow node do not copy each other's items.
When there is none, slow workers get them, and new ones get copies of what a slow worker has.

Only a `Tick` does all this. The engine sends one when no answers wait to be read, so a driver that was busy neither
takes its workers for slow nor sends copies of items that are answered already.
"""

from __future__ import annotations

import math
from itertools import takewhile

from es_service.dispatch.deadlines import begin_first_slot
from es_service.dispatch.events import Assign, Command
from es_service.dispatch.scheduler_changes import copy_item, put_worker
from es_service.dispatch.scheduler_state import LATE, SchedulerState, Slot, has_idle_worker_for_copies


def note_late_workers(s: SchedulerState, now: float) -> None:
    """Mark the workers that have become late with their first slot."""
    for _, worker in list(takewhile(lambda entry: entry[0] <= now, s.deadlines)):
        group = s.up if worker in s.up else s.draining
        record = group.get(worker)
        if record is not None and record.late_s <= now:
            put_worker(s, group, worker, record._replace(late_s=-math.inf, pace=LATE))


def send_copies(s: SchedulerState, out: list[Command], now: float) -> None:
    """Send items of late workers to idle ones, as long as there are both."""
    while has_idle_worker_for_copies(s):
        waiting, worker = s.items[s.late[0][1]], s.free[0][-1]
        copy_item(s, waiting.item.id, worker)
        slot = Slot(waiting.item, waiting.faults + 1)
        put_worker(s, s.up, worker, begin_first_slot(s, s.up[worker]._replace(slots=(slot,)), now))
        out.append(Assign(worker, waiting.item.id, slot.attempt, copy=True))
        s.copies += waiting.item.size
