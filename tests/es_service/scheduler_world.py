"""A world that breaks in every way we know, for the scheduler to live in."""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter, deque
from random import Random

from es_service.dispatch.events import (
    Assign,
    Compiled,
    Deliver,
    Drain,
    Event,
    Fail,
    Failure,
    Limits,
    Placed,
    Progress,
    Result,
    SetWorkers,
    StartWorker,
    StopWorker,
    Submit,
    Tick,
    WorkerLost,
    WorkerUp,
    WorkItem,
)
from es_service.dispatch.scheduler import handle
from es_service.dispatch.scheduler_state import initial_state, next_deadline, pending
from tests.es_service.scheduler_play import check_consistency, copied

START_FATES = ("start_dies", "start_hangs", "no_place")
COMPILE_FATES = ("compile_dies", "compile_hangs", "compile_slow", "compile_makes", "compile_raises")
ITEM_FATES = ("item_dies", "item_hangs", "item_slow", "item_long", "item_raises", "contradicts")
FAULTS = (
    *START_FATES,
    *COMPILE_FATES,
    *ITEM_FATES,
    "dies_idle",
    "duplicates",
    "reports_stopped",
    "speaks_after_stop",
    "drain",
    "resize",
)


class World:
    """Workers as an engine would see them, faults drawn from one seed, and its own books to check the scheduler by."""

    def __init__(self, seed: int) -> None:
        r = self.random = Random(seed)
        self.limits = Limits(
            workers=r.randint(1, 4),
            in_flight=r.randint(1, 2),
            max_attempts=r.randint(2, 5),
            start_timeout_s=3.0,
            compile_timeout_s=5.0,
            first_chunk_timeout_s=8.0,
            chunk_timeout_s=2.0,
            deadline_factor=4.0,
            late_factor=r.choice((1.2, 2.0, math.inf)),
            late_by_s=r.choice((0.0, 0.3)),
            max_failures_in_a_row=r.randint(1, 3),
            restart_backoff_s=0.5,
            max_backoff_s=r.choice((4.0, 20.0)),
            max_start_failures=r.randint(2, 5),
            place_timeout_s=r.choice((math.inf, 1.0, 4.0)),
            no_worker_timeout_s=r.choice((4.0, 12.0)),
        )
        harshness = r.choice((0.0, 0.05, 0.2, 0.5))
        self.faultless = harshness == 0.0
        self.rate = {fault: harshness * r.random() ** 2 for fault in FAULTS}
        if harshness and r.random() < 0.1:
            self.rate[r.choice(("start_dies", "start_hangs", "item_raises", "item_dies"))] = 1.0
        self.poison_rate = harshness * r.choice((0.0, 0.0, 0.1))
        self.handles_twice = seed % 31 == 0
        self.state, self.now = initial_state(self.limits), 0.0
        self.heap: list[tuple[float, int, object, tuple]] = []
        self.serial = itertools.count()
        self.seen: Counter[str] = Counter()
        # What the processes do.
        self.alive: set[int] = set()
        self.inbox: dict[int, deque[tuple[tuple, int]]] = {}
        self.busy: set[int] = set()
        self.compiled: set[tuple[int, str]] = set()
        self.told_compiled: set[tuple[int, str]] = set()
        self.unplaced: set[int] = set()
        self.waits: set[int] = set()
        self.last_word: dict[int, float] = {}
        self.heard: dict[int, float] = {}
        self.poison: dict[tuple, str] = {}
        # What a correct scheduler must know.
        self.wanted = self.limits.workers
        self.known: set[int] = set()
        self.up: set[int] = set()
        self.draining: set[int] = set()
        self.open: dict[int, list[tuple[tuple, int]]] = {}
        self.size: dict[tuple, int] = {}
        self.fresh: deque[tuple] = deque()
        self.waiting: set[tuple] = set()
        self.delivered: set[tuple] = set()
        self.faults: Counter[tuple] = Counter()
        self.assigned: set[tuple] = set()
        self.copied: dict[tuple, int] = {}
        self.last_holder: dict[tuple, int] = {}
        self.again = self.lost = self.dropped = self.start_failures = self.tried = self.newest = 0
        self.start_due: dict[int, float] = {}
        self.was_up = False
        self.down_since: float | None = None
        self.failed: str | None = None

    # The processes.

    def at(self, delay: float, function: object, *args: object) -> None:
        heapq.heappush(self.heap, (self.now + delay, next(self.serial), function, args))

    def happens(self, fault: str) -> bool:
        return self.random.random() < self.rate[fault]

    def say(self, worker: int, event: Event) -> None:
        """A message that arrives late, in order per worker only."""
        arrival = max(self.now, self.last_word.get(worker, 0.0)) + self.random.expovariate(20.0)
        self.last_word[worker] = arrival
        self.at(arrival - self.now, self.feed, event)

    def start_process(self, worker: int) -> None:
        self.alive.add(worker)
        self.inbox[worker], self.open[worker] = deque(), []
        self.start_due[worker] = self.now + self.limits.start_timeout_s
        self.unplaced.add(worker)
        if not self.happens("no_place"):
            self.give_place(worker)
        elif self.random.random() < 0.5:
            self.waits.add(worker)
            self.at(1.2 * self.limits.start_timeout_s * self.random.random(), self.give_place, worker)

    def give_place(self, worker: int) -> None:
        if worker in self.alive or self.happens("speaks_after_stop"):
            self.say(worker, Placed(worker))
            self.build(worker)

    def build(self, worker: int) -> None:
        if self.happens("start_dies"):
            self.at(self.random.random(), self.die, worker)
        elif not self.happens("start_hangs"):
            self.at(self.random.random(), self.come_up, worker)

    def come_up(self, worker: int) -> None:
        if worker in self.alive or self.happens("speaks_after_stop"):
            self.say(worker, WorkerUp(worker))
            if self.happens("dies_idle"):
                self.at(self.random.expovariate(0.5), self.die, worker)

    def die(self, worker: int) -> None:
        if worker in self.alive:
            self.alive.discard(worker)
            self.say(worker, WorkerLost(worker, "killed"))

    def begin(self, worker: int) -> None:
        if worker not in self.alive or worker in self.busy or not self.inbox[worker]:
            return
        self.busy.add(worker)
        item_id, attempt = self.inbox[worker].popleft()
        if (worker, item_id[0]) in self.compiled:
            self.compute(worker, item_id, attempt)
            return
        fate = next((fate for fate in COMPILE_FATES if self.happens(fate)), "ok")
        if fate == "compile_hangs":
            self.report(worker, item_id, self.random.randint(0, 2), 4.0, "making")
        else:
            seconds = self.random.random() + 10.0 * (fate in ("compile_slow", "compile_makes"))
            self.report(worker, item_id, 2 * (fate == "compile_makes"), 4.0, "making")
            self.at(seconds, self.end_compiling, worker, item_id, attempt, fate, seconds)

    def end_compiling(self, worker: int, item_id: tuple, attempt: int, fate: str, seconds: float) -> None:
        """It compiles again for the next item of this kind if it raised an exception."""
        if worker not in self.alive and not self.happens("speaks_after_stop"):
            return
        if fate == "compile_dies":
            self.die(worker)
        elif fate == "compile_raises":
            self.end(worker, item_id, attempt, "item_raises")
        else:
            self.compiled.add((worker, item_id[0]))
            self.seen["compiled"] += 1
            self.say(worker, Compiled(worker, item_id[0], seconds))
            self.compute(worker, item_id, attempt)

    def compute(self, worker: int, item_id: tuple, attempt: int) -> None:
        fate = self.poison.get(item_id) or next((fate for fate in ITEM_FATES if self.happens(fate)), "ok")
        if fate == "item_hangs":
            self.report(worker, item_id, self.random.randint(0, 3), 1.4)
        else:
            seconds = self.random.random() + 10.0 * (fate in ("item_slow", "item_long"))
            self.report(worker, item_id, 7 * (fate == "item_long"), 1.4)
            self.at(seconds, self.end, worker, item_id, attempt, fate)

    def report(self, worker: int, item_id: tuple, times: int, every_s: float, doing: str = "") -> None:
        """Reports of progress, the last of which may be long before the end."""
        for number in range(1, times + 1):
            self.at(number * every_s, self.say_progress, worker, item_id, Progress(worker, doing, number, times))

    def say_progress(self, worker: int, item_id: tuple, event: Progress) -> None:
        if worker in self.alive:
            self.say(worker, event)

    def end(self, worker: int, item_id: tuple, attempt: int, fate: str) -> None:
        if worker not in self.alive and not self.happens("speaks_after_stop"):
            return
        if fate == "item_dies":
            self.die(worker)
            return
        if fate in ("item_raises", "contradicts"):
            self.say(worker, Failure(worker, item_id, attempt, "ValueError: no"))
        if fate != "item_raises":
            self.say(worker, Result(worker, item_id, attempt))
        if self.happens("duplicates"):
            self.say(
                worker, Result(worker, item_id, attempt) if fate == "ok" else Failure(worker, item_id, attempt, "again")
            )
        self.seen["long"] += fate == "item_long"
        self.busy.discard(worker)
        self.begin(worker)

    # The books.

    def forget(self, worker: int, *, fault: bool, charge: bool) -> None:
        """The scheduler has stopped the worker or learned that it is gone."""
        self.known.discard(worker)
        if fault:
            self.lost += 1
            if worker not in self.up:
                if self.up:
                    self.start_failures = 0
                elif worker >= self.tried:  # else it had been started before another's loss that was counted
                    self.start_failures += 1
                    self.tried = self.newest
            running = self.open[worker][0][0] if self.open[worker] else None
            if charge and running in self.waiting:
                self.faults[running] += 1
                self.seen["copy charged"] += running in self.copied
        for item_id, _ in self.open[worker]:
            self.last_holder[item_id] = worker
        self.up.discard(worker)
        self.draining.discard(worker)
        self.open[worker] = []

    def note(self, event: Event) -> None:
        """What the event means, before the scheduler is asked."""
        match event:
            case Submit(items):
                self.fresh.extend(item.id for item in items)
                self.waiting.update(item.id for item in items)
                self.size.update((item.id, item.size) for item in items)
            case Placed(worker):
                self.unplaced.discard(worker)
                if worker in self.known:
                    self.seen["placed late"] += worker in self.waits
                    self.start_due[worker] = self.now + self.limits.start_timeout_s
            case WorkerUp(worker) if worker in self.known and worker not in self.up:
                self.up.add(worker)
                self.was_up = True
                self.start_failures = 0
            case WorkerLost(worker) if worker in self.known:
                expected = worker in self.draining
                self.seen["lost while draining"] += expected
                self.forget(worker, fault=not expected, charge=not expected)
            case Compiled(worker, kind) if worker in self.known:
                self.told_compiled.add((worker, kind))
            case Progress(worker) if worker in self.known:
                self.heard[worker] = self.now
            case Result(worker, item_id, attempt):
                if worker in self.known and (item_id, attempt) in self.open[worker]:
                    self.open[worker].remove((item_id, attempt))
                elif worker in self.known and item_id in self.waiting:
                    self.seen["superseded result"] += 1
            case Failure(worker, item_id, attempt):
                valid = worker in self.known and (item_id, attempt) in self.open[worker]
                if valid:
                    self.open[worker].remove((item_id, attempt))
                if valid and item_id in self.waiting:
                    self.faults[item_id] += 1
                    self.last_holder[item_id] = worker
                else:
                    self.dropped += 1
            case Drain(worker) if worker in self.known:
                self.draining.add(worker)
            case SetWorkers(wanted):
                self.wanted = wanted
                by_progress = sorted(
                    self.known - self.draining, key=lambda w: (w not in self.up, w in self.unplaced, w)
                )
                self.draining.update(by_progress[wanted:])

    def feed(self, event: Event) -> None:
        speaker_known = isinstance(event, Result) and event.worker in self.known
        if self.failed is None:
            self.note(event)
        again = copied(self.state) if self.handles_twice or self.failed is not None else None
        commands = handle(self.state, event, self.now)
        check_consistency(self.state)
        if self.failed is not None:
            assert self.state == again
            assert commands == []
            return
        if again is not None:
            assert handle(again, event, self.now) == commands
            assert again == self.state
        accepted = 0
        for command in commands:
            assert self.failed is None or isinstance(command, StopWorker)
            match command:
                case StartWorker(worker):
                    assert worker >= self.newest
                    self.newest = worker + 1
                    self.known.add(worker)
                    self.start_process(worker)
                case StopWorker(worker, reason):
                    self.stop(worker, reason, event)
                case Assign(worker, item_id, attempt, is_copy):
                    self.check_assign(worker, item_id, attempt, event if is_copy else None)
                case Deliver(item_id):
                    assert isinstance(event, Result)
                    assert event.item_id == item_id
                    assert speaker_known
                    assert item_id in self.waiting
                    self.waiting.remove(item_id)
                    self.delivered.add(item_id)
                    self.seen["copy was first"] += self.copied.get(item_id) == event.worker
                    accepted += 1
                case Fail(message):
                    self.failed = message
                    self.check_fail(message)
        if isinstance(event, Result) and not accepted:
            assert not (speaker_known and event.item_id in self.waiting)
            self.dropped += 1
        self.check_books()
        if isinstance(event, Tick):
            assert next_deadline(self.state) > self.now

    def stop(self, worker: int, reason: str, event: Event) -> None:
        assert worker in self.known, "stopped twice, or never started"
        if self.failed is None and reason == "drained":
            assert worker in self.draining
            assert not self.open[worker]
            self.forget(worker, fault=False, charge=False)
        elif self.failed is None:
            assert isinstance(event, Tick | Failure)
            has_no_place = isinstance(event, Tick) and worker in event.silent
            self.seen["no place" if has_no_place else "quarantine" if isinstance(event, Failure) else "deadline"] += 1
            assert worker in self.up or self.now >= self.start_due[worker], "it could still have come up in time"
            if isinstance(event, Tick) and worker in self.up:
                is_compiling = (worker, self.open[worker][0][0][0]) not in self.told_compiled
                assert is_compiling == ("compil" in reason)
                self.seen["compiled too long"] += is_compiling
                limit_s = self.limits.compile_timeout_s if is_compiling else self.limits.chunk_timeout_s
                silent_s = self.now - self.heard.get(worker, -math.inf)
                assert silent_s >= limit_s * 2 ** (self.open[worker][0][1] - 1) - 1e-9, "it has just reported progress"
                self.seen["hangs after progress"] += "no progress" in reason
            self.forget(worker, fault=not has_no_place, charge=isinstance(event, Tick))
        self.known.discard(worker)
        self.up.discard(worker)
        self.alive.discard(worker)
        if self.happens("reports_stopped"):
            self.say(worker, WorkerLost(worker, "stopped"))

    def check_assign(self, worker: int, item_id: tuple, attempt: int, copied_by: Event | None) -> None:
        assert worker in self.up - self.draining
        assert item_id in self.waiting
        assert attempt == self.faults[item_id] + 1 <= self.limits.max_attempts
        holders = [other for other, slots in self.open.items() for held, _ in slots if held == item_id]
        if copied_by is not None:
            self.check_copy(worker, item_id, holders, copied_by)
        else:
            assert not holders
            if item_id in self.assigned:
                self.again += self.size[item_id]
            else:
                assert item_id == self.fresh.popleft(), "out of submission order"
            assert self.last_holder.get(item_id) != worker or len(self.up - self.draining) == 1
        self.assigned.add(item_id)
        self.open[worker].append((item_id, attempt))
        assert len(self.open[worker]) <= self.limits.in_flight
        self.inbox[worker].append((item_id, attempt))
        self.at(0.0, self.begin, worker)

    def check_copy(self, worker: int, item_id: tuple, holders: list[int], event: Event) -> None:
        """Of an item that one other worker has, and has had alone since it was submitted; nothing else waits."""
        assert isinstance(event, Tick)
        assert self.limits.late_factor < math.inf
        assert not self.open[worker]
        assert len(holders) == 1
        assert item_id not in self.copied
        assert item_id not in self.last_holder, "it may be poison"
        assert not self.queued()
        self.copied[item_id] = worker
        self.seen["copy"] += 1

    def queued(self) -> set[tuple]:
        return self.waiting - {item_id for slots in self.open.values() for item_id, _ in slots}

    def check_fail(self, message: str) -> None:
        worn_out = [item_id for item_id in self.waiting if self.faults[item_id] >= self.limits.max_attempts]
        if message.startswith("work item"):
            self.seen["poison"] += 1
            assert any(str(item_id) in message for item_id in worn_out)
        elif "consecutive attempts" in message:
            self.seen["start failures"] += 1
            assert self.start_failures == self.limits.max_start_failures
            assert not self.up
        else:
            assert self.down_since is not None
            down_s = self.now - self.down_since + 1e-9
            assert not self.up
            if "got a place" in message:
                self.seen["no first place"] += 1
                assert not self.was_up
                assert down_s >= self.limits.place_timeout_s
            else:
                self.seen["no worker"] += 1
                assert self.was_up
                assert self.waiting
                assert down_s >= self.limits.no_worker_timeout_s

    def check_books(self) -> None:
        state = self.state
        assert (state.lost_workers, state.duplicates) == (self.lost, self.dropped)
        assert state.retries == self.again
        assert pending(state) == len(self.waiting)
        if self.failed is not None:
            assert state.failed == self.failed
            assert not self.known, "a worker was left running"
            return
        assert all(self.faults[item_id] < self.limits.max_attempts for item_id in self.waiting), "poison went unnoticed"
        assert self.start_failures < self.limits.max_start_failures, "a broken environment went unnoticed"
        if self.up or (not self.waiting if self.was_up else self.known - self.unplaced):
            self.down_since = None
        elif self.down_since is None:
            self.down_since = self.now
        for worker, record in [*state.up.items(), *state.draining.items()]:
            if record.slots and record.deadline_s > record.allowed_s:
                longest_s = self.limits.compile_timeout_s * 2 ** (record.slots[0].attempt - 1)
                assert record.deadline_s <= self.heard[worker] + longest_s, "a hang would be noticed late"
        usable = self.up - self.draining
        queued = self.queued()
        for worker in usable if queued else ():
            if len(self.open[worker]) < self.limits.in_flight:
                assert len(usable) > 1
                assert {self.last_holder.get(item_id) for item_id in queued} == {worker}, (
                    "work waits beside a free worker"
                )

    # The run.

    def tick(self) -> None:
        self.feed(Tick(tuple(sorted(self.unplaced))))

    def submit(self, generation: int) -> None:
        items = tuple(
            WorkItem((kind, generation, index), kind, self.random.randint(1, 3))
            for kind in ("TrainingChunk", "EvaluationChunk")
            for index in range(self.random.randint(0, 7))
        )
        for item in items:
            if self.random.random() < self.poison_rate:
                self.poison[item.id] = self.random.choice(("item_raises", "item_dies", "item_hangs"))
        self.feed(Submit(items))

    def operate(self) -> None:
        """An operator, or a cloud, at work."""
        if self.happens("drain") and self.newest:
            worker = self.random.randrange(self.newest)
            self.feed(Drain(worker))
            if self.random.random() < 0.5:
                self.at(self.random.random(), self.die, worker)
        if self.happens("resize"):
            self.feed(SetWorkers(self.random.randint(1, 5)))
        if self.random.random() < 0.3:
            self.tick()

    def run_until_quiet(self) -> None:
        for _ in range(20_000):
            due = next_deadline(self.state)
            if self.heap and self.heap[0][0] <= due:
                self.now, _, function, args = heapq.heappop(self.heap)
                function(*args)
            elif due < math.inf:
                self.now = max(self.now, due)
                before = copied(self.state)
                self.tick()
                assert self.state != before, "next_deadline announced nothing"
            else:
                return
        raise AssertionError("does not come to rest")


def simulate(seed: int) -> World:
    world = World(seed)
    world.tick()
    for generation in range(3):
        world.submit(generation)
        for _ in range(8):
            world.at(world.random.random() * 4.0, world.operate)
        if world.random.random() < 0.2:
            continue  # the next generation is submitted on top
        world.run_until_quiet()
        assert world.failed is not None or not world.waiting, "deadlock"
    # The storm is over: one more generation must go through without a scratch, on as many workers as are wanted.
    world.rate, world.poison_rate = dict.fromkeys(FAULTS, 0.0), 0.0
    world.run_until_quiet()
    if world.failed is not None:
        return world
    scratches, dropped, copied = (world.lost, world.state.retries), world.dropped, len(world.copied)
    world.submit(3)
    world.run_until_quiet()
    assert world.failed is None
    assert not world.waiting
    assert (world.lost, world.state.retries) == scratches
    assert world.dropped - dropped == len(world.copied) - copied, "of two copies, one answer is dropped"
    assert world.state.copies == sum(world.size[item_id] for item_id in world.copied)
    assert world.alive == world.known == world.up == set(world.state.up)
    assert len(world.alive) == world.wanted
    assert not world.draining
    if world.faultless:
        assert (scratches, dropped) == ((0, 0), copied)
    return world
