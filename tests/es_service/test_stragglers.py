"""Second copies of late work items: when they are sent, and that nothing is counted twice."""

from __future__ import annotations

import math
import random
import time
from types import SimpleNamespace

import numpy as np
import pytest

from es_service.dispatch import engine as engine_module
from es_service.dispatch.engine import Answer, Engine
from es_service.dispatch.events import (
    Assign,
    Compiled,
    Deliver,
    Drain,
    Fail,
    Failure,
    Limits,
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
from es_service.dispatch.scheduler_state import IN_TIME, LATE, NEW, SchedulerState, next_deadline, pending
from es_service.protocol.gradient_tree import tree_sum, with_neighbours_added
from es_service.protocol.messages import GradientChunk, GradientResult, with_subject
from tests.es_service.scheduler_play import check_consistency, items, play, ready, step
from tests.es_service.test_engine import Scripted
from tests.helpers import centre, random_parameters

LIMITS = {"late_factor": 2.0, "late_by_s": 0.0}


def experienced(workers: int = 2, **changes: object) -> SchedulerState:
    """At time 10, idle workers that have compiled; an item takes one second."""
    state = ready(workers, **LIMITS | changes)
    for now in (0.0, 9.0):
        state, _ = step(state, Submit(tuple(WorkItem(number, "train") for number in range(workers))), now)
        for worker in range(workers):
            state, _ = step(state, Result(worker, worker, 1), now + 1.0)
    assert set(state.durations_s["train"]) == {1.0}
    return state


def test_a_late_item_is_sent_to_an_idle_worker_too_and_the_first_answer_counts():
    state, _ = play(experienced(), (10.0, items("ab")), (11.0, Result(1, "b", 1)))
    assert next_deadline(state) == 12.0
    assert step(state, Tick(), 11.9) == (state, [])
    state, commands = play(state, (12.0, Tick()))
    assert commands == [Assign(1, "a", 1, copy=True)]
    for first, other in ((0, 1), (1, 0)):
        done, commands = play(state, (12.5, Result(first, "a", 1)))
        assert (commands, pending(done)) == ([Deliver("a")], 0)
        done, commands = play(done, (12.7, Result(other, "a", 1)))
        assert (commands, done.duplicates) == ([], 1)
        assert (done.copies, done.retries, done.lost_workers) == (1, 0, 0)
        durations_s = {"train": (1.0, 1.0, 1.0, 1.0, 1.0, 2.5 if first == 0 else 0.5)}
        assert done.durations_s == durations_s, "when the other answer was given is not known"


def test_no_item_has_a_third_copy():
    state, _ = play(experienced(3), (10.0, items("abc")), (11.0, Result(1, "b", 1)), (11.0, Result(2, "c", 1)))
    state, commands = play(state, (12.0, Tick()))
    assert commands == [Assign(1, "a", 1, copy=True)]
    for now in range(13, 20):
        state, commands = play(state, (float(now), Tick()))
        assert commands == [], "also once the copy is late"


def test_items_in_the_queue_come_before_copies_and_late_is_late_by_much():
    state, _ = play(experienced(in_flight=1), (10.0, items("abc")), (12.0, Tick()))
    assert play(state, (12.5, Result(1, "b", 1)))[1] == [Deliver("b"), Assign(1, "c", 1)]
    state, _ = play(experienced(late_by_s=1.5), (10.0, items("ab")), (11.0, Result(1, "b", 1)))
    assert next_deadline(state) == 10.0 + 1.0 + 1.5
    sized = Submit((WorkItem("a", "train", 4), WorkItem("b", "train", 1)))
    state, _ = play(experienced(), (10.0, sized), (11.0, Result(1, "b", 1)))
    assert next_deadline(state) == 10.0 + 2.0 * 4


def test_what_waits_behind_a_late_item_is_copied_too():
    state, _ = play(experienced(), (10.0, items("abcd")), (11.0, Result(1, "b", 1)), (12.0, Tick()))
    state, _ = play(state, (12.0, Result(1, "d", 1)))
    state, commands = play(state, (12.0, Tick()))
    assert commands == [Assign(1, "a", 1, copy=True)]
    state, commands = play(state, (13.0, Result(1, "a", 1)), (13.0, Tick()))
    assert commands == [Assign(1, "c", 1, copy=True)]
    assert play(state, (14.0, Result(1, "c", 1)))[0].duplicates == 0
    assert (
        play(state, (14.0, Result(1, "c", 1)), (15.0, Result(0, "a", 1)), (17.0, Result(0, "c", 1)))[0].duplicates == 2
    )


def test_a_worker_is_slow_until_it_answers_in_time():
    """Its items are copied at once, it gets none while another is idle, and no copies."""
    state, _ = play(experienced(3), (10.0, items("abc")), (11.0, Result(1, "b", 1)), (11.0, Result(2, "c", 1)))
    state, _ = play(state, (12.0, Tick()), (13.0, Result(1, "a", 1)), (15.0, Result(0, "a", 1)))
    assert step(state, items("de"), 16.0)[1] == [Assign(1, "d", 1), Assign(2, "e", 1)]
    state, _ = play(state, (16.0, items("def")), (16.2, Result(1, "d", 1)))
    assert next_deadline(state) == -math.inf, "a tick is due at once"
    state, commands = play(state, (16.2, Tick()))
    assert commands == [Assign(1, "f", 1, copy=True)]
    # In time with an item, it has as much time as others for the next.
    state, _ = play(state, (16.9, Result(0, "f", 1)), (17.0, Result(1, "f", 1)), (17.0, Result(2, "e", 1)))
    state, commands = play(state, (18.0, items("ghi")), (18.5, Result(1, "g", 1)), (18.5, Result(2, "h", 1)))
    assert step(state, Tick(), 18.5) == (state, [])


def test_a_new_worker_gets_a_copy_of_what_a_hanging_one_has_if_no_other_could():
    state, _ = play(experienced(1), (10.0, items("ab")), (10.5, SetWorkers(2)), (11.0, WorkerUp(1)))
    assert step(state, Tick(), 11.9)[1] == []
    state, commands = play(state, (12.0, Tick()))
    assert commands == [Assign(1, "a", 1, copy=True)]
    state, commands = play(state, (13.0, Result(1, "a", 1)), (13.0, Tick()))
    assert commands == [Assign(1, "b", 1, copy=True)]


def test_new_workers_do_not_copy_each_other_s_items():
    state, _ = play(ready(2, **LIMITS), (10.0, items("a")))
    for now in (10.0, 20.0, 29.0):
        assert step(state, Tick(), now)[1] == []


def test_a_slow_worker_gets_a_copy_only_if_no_other_would():
    state, _ = play(experienced(3), (10.0, items("abc")), (11.0, Result(1, "b", 1)), (11.0, Result(2, "c", 1)))
    state, _ = play(state, (12.0, Tick()), (13.0, Result(1, "a", 1)), (15.0, Result(0, "a", 1)))
    sized = Submit((WorkItem("d", "train", 1), WorkItem("e", "train", 9)))
    state, commands = play(state, (16.0, sized), (18.0, Tick()))
    assert (commands, sorted(state.up[worker].pace for worker in state.up)) == ([], [IN_TIME, LATE, LATE])
    assert play(state, (19.0, Result(2, "e", 1)), (19.0, Tick()))[1] == [Assign(2, "d", 1, copy=True)]
    state, _ = play(experienced(), (10.0, items("ab")), (11.0, Result(1, "b", 1)), (12.0, Tick()))
    state, _ = play(state, (13.0, Result(1, "a", 1)), (15.0, Result(0, "a", 1)))
    state, commands = play(state, (16.0, items("c")), (18.0, Tick()))
    assert commands == [Assign(0, "c", 1, copy=True)], "now both are slow"


def test_compiling_makes_no_worker_late():
    """Its first item is timed from the end of compiling, and it is then in time or late like any other."""
    state, _ = play(experienced(1), (10.0, SetWorkers(2)), (10.0, WorkerUp(1)), (11.0, items("ab")))
    state, _ = play(state, (12.0, Result(0, "a", 1)), (40.0, Tick()))
    assert (state.up[1].pace, state.copies) == (NEW, 1), "worker 0 is idle, and worker 1 has answered nothing so far"
    state, _ = play(state, (41.0, Compiled(1, "train", 30.0)))
    assert state.up[1].late_s == 41.0 + 2.0
    assert play(state, (42.0, Result(1, "b", 1)))[0].up[1].pace == IN_TIME
    assert play(state, (43.0, Tick()))[0].up[1].pace == LATE


def test_a_worker_that_must_compile_does_not_hold_up_the_others():
    state, _ = play(experienced(2), (10.0, WorkerLost(0, "killed")), (10.0, WorkerUp(2)), (11.0, items("ab")))
    state, commands = play(state, (12.0, Result(1, "a", 1)), (12.0, Tick()))
    assert commands == [Assign(1, "b", 1, copy=True)]
    assert play(state, (13.0, Result(1, "b", 1)))[1] == [Deliver("b")]


def test_only_a_tick_notes_that_a_worker_is_late():
    """A driver that was busy reads the answers first."""
    state, _ = play(experienced(), (10.0, items("ab")))
    state, commands = play(state, (50.0, Result(0, "a", 1)), (50.0, Result(1, "b", 1)))
    assert commands == [Deliver("b")]
    assert state.in_time == 2


@pytest.mark.parametrize("loss", [WorkerLost(1, "killed"), Failure(1, "a", 1, "no")])
def test_a_copy_that_fails_is_an_attempt_and_not_sent_again(loss):
    state, _ = play(experienced(3), (10.0, items("abc")), (11.0, Result(1, "b", 1)), (11.0, Result(2, "c", 1)))
    state, _ = play(state, (12.0, Tick()), (12.5, loss))
    assert (state.items["a"].faults, state.queue, state.retries) == (1, [], 0)
    state, commands = play(state, (14.0, Tick()))
    assert not any(isinstance(command, Assign) for command in commands)
    lost, commands = play(state, (14.5, Failure(0, "a", 1, "no")))
    assert [(command.item_id, command.attempt) for command in commands] == [("a", 3)]
    assert lost.retries == 1
    assert play(state, (14.5, Result(0, "a", 1)))[1] == [Deliver("a")]


@pytest.mark.parametrize("loss", [WorkerLost(0, "killed"), Failure(0, "a", 1, "no")])
def test_a_copy_stands_in_for_the_item_of_a_worker_that_fails(loss):
    state, _ = play(experienced(), (10.0, items("ab")), (11.0, Result(1, "b", 1)), (12.0, Tick()), (12.5, loss))
    assert (state.items["a"].holder, state.items["a"].faults, state.queue) == (1, 1, [])
    assert play(state, (13.0, Result(1, "a", 1)))[1] == [Deliver("a")]
    state, _ = play(state, (13.0, Failure(1, "a", 1, "no")))
    assert state.items["a"].faults == 2


def test_an_item_that_kills_both_its_workers_is_poison():
    state, _ = play(experienced(max_attempts=2), (10.0, items("ab")), (11.0, Result(1, "b", 1)), (12.0, Tick()))
    state, commands = play(state, (12.5, WorkerLost(0, "died")), (12.6, WorkerLost(1, "signal 11")))
    assert commands[0] == Fail(
        "work item a failed in 2 attempts; the last time worker 1 was lost while running it: signal 11"
    )


def test_a_phase_ends_without_a_worker_that_hangs_and_the_worker_is_replaced_without_blame():
    state, _ = play(experienced(), (10.0, items("ab")), (11.0, Result(1, "b", 1)), (12.0, Tick()))
    state, commands = play(state, (13.0, Result(1, "a", 1)))
    assert (commands, pending(state), next_deadline(state)) == ([Deliver("a")], 0, 20.0)
    state, commands = play(state, (14.0, items("cd")), (20.0, Tick()))
    reason = "no answer to work item a within 10 s of computing (at least compute.chunk_timeout_s)"
    assert commands[:2] == [StopWorker(0, reason), StartWorker(2)]
    assert [state.items[item].faults for item in "cd"] == [0, 0]


def test_an_item_of_a_draining_worker_is_copied_too():
    state, _ = play(experienced(), (10.0, items("ab")), (10.5, Drain(0)), (11.0, Result(1, "b", 1)))
    state, commands = play(state, (12.0, Tick()))
    assert commands == [Assign(1, "a", 1, copy=True)]
    assert play(state, (12.5, Result(1, "a", 1)), (13.0, Result(0, "a", 1)))[1] == [StopWorker(0, "drained")]


def test_with_an_infinite_factor_no_item_is_sent_twice():
    state, _ = play(experienced(late_factor=math.inf), (10.0, items("ab")), (11.0, Result(1, "b", 1)))
    assert next_deadline(state) == 20.0
    state, _ = play(experienced(2, late_factor=math.inf), (10.0, WorkerLost(0, "killed")), (10.0, WorkerUp(2)))
    state, _ = play(state, (11.0, items("ab")), (12.0, Result(1, "a", 1)))
    assert next_deadline(state) > 12.0, "nor an item of a worker that compiles"


BLOCKS = 48
POINT = centre(random_parameters())


class Uneven(Scripted):
    """Workers that add gradient blocks, at different speeds; some hang, die or raise. The clock is `now[0]`."""

    def __init__(self, rng: random.Random, now: list[float]) -> None:
        super().__init__()
        self.rng, self.now, self.slowness = rng, now, {}
        self.due: list[tuple[float, int, object]] = []
        self.free_s: dict[int, float] = {}
        self.copies = 0
        self.on_send, self.on_wait = self.work_on, self.wait

    def work_on(self, sent):
        self.copies += any((other.item_id, other.attempt) == (sent.item_id, sent.attempt) for other in self.sent[:-1])
        slowness = self.slowness.setdefault(sent.worker, self.rng.choice((1.0, 1.0, 1.0, 5.0, 60.0)))
        took_s = slowness * len(sent.work) * self.rng.uniform(0.9, 1.1) * 1e-3
        end_s = self.free_s[sent.worker] = max(self.now[0], self.free_s.get(sent.worker, 0.0)) + took_s
        sums = with_neighbours_added(sent.work, [GradientResult(block_of(chunk)) for _, chunk in sent.work])
        fate = self.rng.random()
        if fate > 0.03:
            said = Answer(sent.worker, sent.item_id, sent.attempt, sums)
        else:
            said = WorkerLost(sent.worker, "died") if fate < 0.01 else sent.failure()
        self.due.append((end_s, len(self.sent), said))

    def wait(self):
        until = self.now[0] + self.waits[-1]
        self.due.sort(key=lambda entry: entry[:2])
        if self.due and self.due[0][0] <= until:
            until, _, said = self.due.pop(0)
            if said.worker not in self.killed:
                self.inbox.append(said)
        self.now[0] = max(self.now[0], until)


def block_of(chunk) -> np.ndarray:
    """Partial gradient of a block; sums in another order would have other bits."""
    random_numbers = np.random.default_rng([chunk.generation, chunk.chunk_id])
    return (random_numbers.normal(size=3) * 10.0 ** random_numbers.integers(-6, 7)).astype(np.float32)


@pytest.fixture(scope="module")
def copies_sent() -> list[int]:
    """Numbers of second copies in all simulations."""
    return []


@pytest.mark.parametrize("seed", range(40))
def test_sums_over_neighbouring_blocks_are_counted_once_whichever_copy_answers_first(seed, monkeypatch, copies_sent):
    rng, now = random.Random(seed), [0.0]
    transport = Uneven(rng, now)
    monkeypatch.setattr(engine_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    weights = np.zeros(1, np.float32)
    limits = Limits(
        rng.randint(2, 6), cores=rng.choice((1, 4)), item_s=0.004, late_by_s=0.002, max_attempts=20, chunk_timeout_s=2.0
    )
    with Engine(transport, limits) as engine:
        for generation in range(6):
            chunks = [GradientChunk(generation, block, weights) for block in range(BLOCKS)]
            found = engine.evaluate(with_subject(POINT, chunks))
            alone = with_neighbours_added(
                with_subject(POINT, chunks), [GradientResult(block_of(chunk)) for chunk in chunks]
            )
            assert tree_sum(found).tobytes() == tree_sum(alone).tobytes()
            now[0] += rng.choice((0.0, 0.01, 0.5))
        copies_sent.append(transport.copies)


def test_the_simulations_sent_copies(copies_sent):
    if len(copies_sent) < 40:
        pytest.skip("not all simulations ran")
    assert sum(copies_sent) > 200


@pytest.mark.slow
def test_copies_cost_hardly_more_with_many_slow_workers():
    """Half of the workers never answer; the others take their items one by one."""

    def seconds_per_event(workers: int) -> float:
        state = experienced(workers)
        commands = handle(state, Submit(tuple(WorkItem(-1 - item, "train") for item in range(workers))), 10.0)
        for worker in range(0, workers, 2):
            handle(state, Result(worker, -1 - worker, 1), 11.0)
        commands = handle(state, Tick(), 12.0)
        events, started = 0, time.process_time()
        while commands:
            assigned = [command for command in commands if isinstance(command, Assign)]
            commands = []
            for command in assigned:
                commands += handle(state, Result(command.worker, command.item_id, command.attempt), 13.0)
                events += 1
        check_consistency(state)
        assert pending(state) == 0
        return (time.process_time() - started) / events

    assert min(seconds_per_event(1000) for _ in range(2)) < 3.0 * min(seconds_per_event(100) for _ in range(3))
