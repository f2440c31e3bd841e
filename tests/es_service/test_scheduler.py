"""The scheduler by hand: who gets which item, deadlines, blame, late and double answers."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest

from es_service.dispatch.events import (
    Assign,
    Compiled,
    Deliver,
    Drain,
    Fail,
    Failure,
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
from es_service.dispatch.scheduler_state import initial_state, next_deadline, pending, usual_chunk_s
from tests.es_service.scheduler_play import LIMITS, cold, items, play, ready, step


def test_tasks_go_out_in_order_to_idle_workers_first():
    state, commands = step(ready(), items("abcde"), 1.0)
    assert commands == [Assign(0, "a", 1), Assign(1, "b", 1), Assign(0, "c", 1), Assign(1, "d", 1)]
    state, commands = step(state, Result(1, "b", 1), 2.0)
    assert commands == [Deliver("b"), Assign(1, "e", 1)]
    assert pending(state) == 4


def test_tasks_submitted_before_any_worker_is_up_wait_for_it():
    state, commands = step(initial_state(LIMITS), items("ab"), 0.0)
    assert commands == [StartWorker(0), StartWorker(1)]
    assert step(state, WorkerUp(1), 1.0)[1] == [Assign(1, "a", 1), Assign(1, "b", 1)]


def test_a_lost_worker_is_replaced_and_only_its_running_task_is_charged():
    state, commands = play(ready(), (1.0, items("abcdef")), (2.0, WorkerLost(0, "killed")))
    assert commands == [StartWorker(2)]
    assert list(state.queue) == ["a", "c", "e", "f"]
    state, commands = step(state, WorkerUp(2), 3.0)
    assert commands == [Assign(2, "a", 2), Assign(2, "c", 1)]
    assert (state.lost_workers, state.retries) == (1, 2)


def test_what_a_bystander_was_computing_is_not_to_blame():
    """A worker lost only because another was: its item goes back, and no number of such losses makes it poison."""
    state = ready(1)
    state, _ = play(state, (1.0, items("a")))
    for worker in range(5):
        now = 100.0 * worker + 2.0
        lost = WorkerLost(worker, "its process was killed", charge_item=False)
        state, _ = play(state, (now, lost), (now + 20.0, Tick()))  # after its wait, the next is started
        state, commands = step(state, WorkerUp(worker + 1), now + 21.0)
        assert commands == [Assign(worker + 1, "a", 1)]
    assert state.failed is None
    assert state.lost_workers == 5


def test_where_items_overlap_the_one_that_loses_workers_is_named_and_not_the_one_before_it():
    """One worker, which begins `p` while it still computes `a`: `p` ends its process each time."""
    state, _ = play(ready(1, items_overlap=True, cores=2), (1.0, items("apz")), (2.0, WorkerLost(0, "killed")))
    state, commands = play(state, (3.0, WorkerUp(1)))
    assert commands == [Assign(1, "a", 2)], "`p` waits, or it would be the loss of `a` again"
    state, commands = step(state, Result(1, "a", 2), 4.0)
    assert commands == [Deliver("a"), Assign(1, "p", 1), Assign(1, "z", 1)]
    for worker, attempt in ((1, 2), (2, 3)):
        now = 10.0 * worker
        state, _ = play(state, (now, WorkerLost(worker, "killed")), (now + 5.0, Tick()))
        state, commands = play(state, (now + 6.0, WorkerUp(worker + 1)))
        assert commands == [Assign(worker + 1, "p", attempt)]
    state, _ = play(state, (30.0, WorkerLost(3, "killed")))
    assert "work item p failed in 3 attempts" in state.failed


def test_a_task_that_raised_waits_for_another_worker():
    state, commands = play(ready(in_flight=1), (1.0, items("abcd")), (2.0, Failure(0, "a", 1, "no")))
    assert commands == [Assign(0, "c", 1)]
    assert step(state, Result(1, "b", 1), 3.0)[1] == [Deliver("b"), Assign(1, "a", 2)]
    state, commands = play(ready(in_flight=1), (1.0, items("ab")), (2.0, Failure(0, "a", 1, "no")))
    assert commands == []
    # With nobody else left it may go back.
    assert Assign(0, "b", 2) in play(state, (3.0, WorkerLost(1, "killed")))[1]
    assert step(step(ready(1), items("a"), 1.0)[0], Failure(0, "a", 1, "no"), 2.0)[1] == [Assign(0, "a", 2)]


def test_a_poison_task_fails_the_run_with_its_name_and_nothing_happens_after():
    state, commands = play(
        ready(in_flight=1, max_failures_in_a_row=3),
        (1.0, items("ab")),
        (2.0, Failure(0, "a", 1, "no")),
        (3.0, Result(1, "b", 1)),
        (4.0, WorkerLost(1, "out of memory")),
        (5.0, Failure(0, "a", 3, "ValueError: never")),
    )
    message = "work item a failed in 3 attempts; the last time it raised an exception on worker 0: ValueError: never"
    assert commands == [Fail(message), StopWorker(0, "the run failed"), StopWorker(2, "the run failed")]
    assert state.failed == message
    for event in (WorkerUp(2), Result(0, "a", 3), items("z"), SetWorkers(5), Tick(), WorkerLost(0, "stopped")):
        assert step(state, event, 1e9) == (state, [])
    assert next_deadline(state) == math.inf


def test_a_task_that_kills_its_workers_is_poison_too():
    state = ready(1)
    state, _ = play(state, (1.0, items("abc")), (2.0, WorkerLost(0, "died")), (2.0, WorkerUp(1)))
    state, _ = play(state, (3.0, WorkerLost(1, "died")), (5.0, Tick()), (5.0, WorkerUp(2)))
    state, commands = step(state, WorkerLost(2, "signal 11"), 6.0)
    message = "work item a failed in 3 attempts; the last time worker 2 was lost while running it: signal 11"
    assert commands == [Fail(message)]


def test_deadlines_follow_the_median_of_their_kind():
    state, _ = play(ready(1, in_flight=1), (0.0, items("abcdeE")))
    assert next_deadline(state) == 100.0, "no duration is known yet"
    state, _ = step(state, Result(0, "a", 1), 4.0)
    assert next_deadline(state) == 4.0 + 5.0 * 4.0
    state, _ = step(state, Result(0, "b", 1), 6.0)
    assert next_deadline(state) == 6.0 + 5.0 * 3.0
    state, _ = step(state, Result(0, "c", 1), 7.0)
    assert next_deadline(state) == 7.0 + 5.0 * 2.0
    state, _ = step(state, Result(0, "d", 1), 8.0)
    assert next_deadline(state) == 8.0 + 10.0, "never below chunk_timeout_s"
    state, _ = step(state, Result(0, "e", 1), 9.0)
    assert next_deadline(state) == 9.0 + 100.0, "of another kind, no duration is known"
    assert state.durations_s == {"train": (4.0, 2.0, 1.0, 1.0, 1.0)}
    state, _ = play(ready(1), *((float(n), event) for n in range(40) for event in (items("a"), Result(0, "a", 1))))
    assert len(state.durations_s["train"]) == 31, "a bounded window"


def test_compiling_has_a_time_of_its_own_and_a_first_item_has_a_duration():
    """Each worker compiles once for each kind; how late the message about it is read makes no difference."""
    state, _ = play(cold(1), (1.0, items("abE")))
    assert next_deadline(state) == 1.0 + 200.0
    state, commands = step(state, Compiled(0, "train", 150.0), 155.0)
    assert (commands, next_deadline(state)) == ([], 151.0 + 100.0)
    state, _ = step(state, Result(0, "a", 1), 155.0)
    assert state.durations_s == {"train": (4.0,)}
    assert next_deadline(state) == 155.0 + 5.0 * 4.0, "it has compiled for this kind"
    state, _ = step(state, Result(0, "b", 1), 160.0)
    assert next_deadline(state) == 160.0 + 200.0, "of another kind"
    again, commands = step(state, Compiled(0, "train", 3.0), 165.0)
    assert (commands, again) == ([], state)
    assert step(state, Compiled(7, "evaluate", 3.0), 165.0) == (state, []), "of a worker that is not known"
    state, _ = step(state, Compiled(0, "evaluate", 100.0), 165.0)
    assert state.up[0].started_s == 165.0, "no item begins later than now"
    state, _ = play(
        state, (166.0, Result(0, "E", 1)), (166.0, SetWorkers(2)), (166.0, WorkerUp(1)), (167.0, items("cd"))
    )
    deadlines_s = {worker: state.up[worker].deadline_s for worker in (0, 1)}
    assert deadlines_s == {0: 167.0 + 5.0 * 4.5, 1: 167.0 + 200.0}, "a new worker compiles, whatever is known"
    drained, _ = play(state, (168.0, Drain(1)), (170.0, Compiled(1, "train", 2.5)))
    assert drained.draining[1].deadline_s == 169.5 + 5.0 * 4.5, "also one that drains"


def test_the_message_of_a_missed_deadline_says_what_the_worker_was_doing():
    """And names the limit. The item of one that hangs while it compiles is charged, like any other."""
    state, _ = play(cold(1, max_attempts=1), (0.0, items("a")))
    doing = "did not finish compiling for work item a within 200 s (compute.compile_timeout_s)"
    failed = f"work item a failed in 1 attempts; the last time worker 0 was lost while running it: {doing}"
    assert step(state, Tick(), 200.0)[1][:2] == [StopWorker(0, doing), Fail(failed)]
    state, _ = step(state, Compiled(0, "train", 50.0), 50.0)
    doing = "no answer to work item a within 100 s of computing (compute.first_chunk_timeout_s)"
    assert StopWorker(0, doing) in step(state, Tick(), 150.0)[1]
    state, _ = play(state, (60.0, Result(0, "a", 1)), (61.0, items("b")))
    doing = "no answer to work item b within 50 s of computing (at least compute.chunk_timeout_s)"
    assert StopWorker(0, doing) in step(state, Tick(), 111.0)[1]


def test_a_worker_that_reports_progress_has_its_time_again_from_each_report():
    """The first policy that survives: all chunks were done at once, and this one takes as long as it takes."""
    state, _ = play(ready(1, in_flight=1), (0.0, items("ab")), (0.5, Result(0, "a", 1)))
    for number in range(1, 20):
        state, commands = play(state, (0.5 + 9.0 * number, Tick()), (0.5 + 9.0 * number, Progress(0)))
        assert (commands, next_deadline(state)) == ([], 0.5 + 9.0 * number + 10.0)
    answered, commands = step(state, Result(0, "b", 1), 175.0)
    assert commands == [Deliver("b")]
    assert answered.durations_s["train"] == (0.5, 174.5)
    reason = "no progress with work item b for 10 s (at least compute.chunk_timeout_s)"
    assert step(state, Tick(), 181.5)[1][0] == StopWorker(0, reason), "one that hangs is noticed all the same"
    slow, _ = play(ready(1, in_flight=1), (0.0, items("ab")), (20.0, Result(0, "a", 1)), (21.0, Progress(0)))
    assert next_deadline(slow) == 20.0 + 5.0 * 20.0, "it has no less than without reports"


def test_making_environments_has_a_time_of_its_own_from_each_to_the_next():
    """Before the first item of a kind, and in an item; a step ends it."""
    state, _ = play(cold(1), (0.0, items("ab")), (150.0, Progress(0, "making", 1, 2)), (300.0, Tick()))
    assert (next_deadline(state), state.preparing[0].done) == (350.0, 1)
    reason = "no progress with work item a for 200 s (compute.compile_timeout_s) while making 2 environments: 1 of 2"
    assert step(state, Tick(), 350.0)[1][0] == StopWorker(0, reason)
    state, _ = play(state, (310.0, Compiled(0, "train", 310.0)), (310.0, Result(0, "a", 1)))
    assert (next_deadline(state), state.preparing) == (320.0, {})
    state, _ = play(state, (311.0, Progress(0, "resetting", 0, 16)), (500.0, Tick()))
    assert (state.lost_workers, next_deadline(state)) == (0, 511.0)
    assert next_deadline(play(state, (500.0, Progress(0)))[0]) == 510.0
    assert play(state, (500.0, WorkerLost(0, "killed")))[0].preparing == {}


def test_a_start_takes_as_long_as_it_reports_progress():
    state, _ = play(initial_state(replace(LIMITS, workers=1)), (0.0, Tick()), (40.0, Progress(0, "making", 0, 1)))
    assert next_deadline(state) == 240.0
    reason = "no progress for 200 s (compute.compile_timeout_s) while making 1 environment: 0 of 1"
    state, commands = step(state, Tick(), 240.0)
    assert commands == [StopWorker(0, reason), StartWorker(1)]
    for stranger in (0, 7):
        assert step(state, Progress(stranger), 241.0) == (state, [])


def test_each_attempt_may_take_twice_as_long_as_the_one_before():
    """Since not all work can report progress."""
    state, now, waited = ready(1, max_attempts=14), 0.0, []
    state, _ = play(state, (0.0, items("ab")), (0.0, Result(0, "a", 1)))
    for worker in range(13):
        waited.append(next_deadline(state) - now)
        now = next_deadline(state)
        state, commands = step(state, Tick(), now)
        assert isinstance(commands[0], StopWorker)
        now = max(now, state.start_at_s)
        state, _ = play(state, (now, Tick()), (now, WorkerUp(worker + 1)), (now, Compiled(worker + 1, "train", 0.0)))
    assert waited == [10.0 * 2 ** min(attempt, 10) for attempt in range(13)]
    assert commands[0].reason == (
        "no answer to work item b within 10240 s of computing (at least compute.chunk_timeout_s, 1024 times as long in "
        "attempt 13)"
    )


def test_a_time_limit_that_the_config_gives_holds_whatever_is_reported():
    state, _ = play(ready(1, time_limit_s=3.0), (0.0, items("a")), (2.5, Progress(0)))
    reason = "no answer to work item a within 3 s of computing (task.time_limit_s)"
    state, commands = step(state, Tick(), 3.0)
    assert commands == [StopWorker(0, reason), StartWorker(1)]
    state, _ = play(state, (4.0, WorkerUp(1)), (4.0, Compiled(1, "train", 0.0)))
    assert (state.up[1].slots[0].attempt, next_deadline(state)) == (2, 7.0)


def test_a_first_item_has_no_less_time_than_later_ones():
    state, _ = play(ready(1, first_chunk_timeout_s=10.0, chunk_timeout_s=60.0), (0.0, items("a")))
    assert next_deadline(state) == 60.0


def test_deadlines_and_durations_are_in_proportion_to_the_size_of_an_item():
    sized = Submit(tuple(WorkItem(name, "train", size) for name, size in (("a", 1), ("b", 4), ("c", 3), ("d", 1))))
    state, _ = play(ready(1, in_flight=1), (0.0, sized), (5.0, Result(0, "a", 1)), (17.0, Result(0, "b", 1)))
    assert usual_chunk_s(state, "train") == 4.0
    assert next_deadline(state) == 17.0 + 5.0 * 3 * 4.0
    state, _ = step(state, Result(0, "c", 1), 20.0)
    assert state.durations_s == {"train": (5.0, 3.0, 1.0)}
    assert next_deadline(state) == 20.0 + 5.0 * 1 * 3.0
    assert usual_chunk_s(state, "evaluate") is None


@pytest.mark.parametrize(
    ("limit_s", "said"), [(0.25, "0.25"), (12.5, "12.5"), (99.96, "100"), (3600.0, "3600"), (1_234_567.8, "1234568")]
)
def test_seconds_are_said_without_an_exponent(limit_s, said):
    state, _ = play(ready(1, first_chunk_timeout_s=limit_s, chunk_timeout_s=0.1), (0.0, items("a")))
    reason = f"no answer to work item a within {said} s of computing (compute.first_chunk_timeout_s)"
    assert step(state, Tick(), limit_s)[1][0] == StopWorker(0, reason)


def test_chunks_handed_out_again_are_counted_not_tasks():
    sized = Submit((WorkItem("a", "train", 5), WorkItem("b", "train", 3)))
    state, _ = play(ready(1), (0.0, sized), (1.0, WorkerLost(0, "killed")), (2.0, WorkerUp(1)))
    assert state.retries == 8


def test_the_clock_of_a_prefetched_task_starts_when_the_one_ahead_is_done():
    state, _ = play(ready(1), (0.0, items("abcd")), (10.0, Result(0, "a", 1)), (12.0, Result(0, "b", 1)))
    assert state.durations_s == {"train": (10.0, 2.0)}
    assert next_deadline(state) == 12.0 + 5.0 * 6.0
    state, _ = step(state, Result(0, "c", 1), 14.5)
    assert next_deadline(state) == 14.5 + 12.5
    assert step(state, Tick(), 26.9) == (state, [])
    state, commands = step(state, Tick(), 27.0)
    reason = "no answer to work item d within 12.5 s of computing (at least compute.chunk_timeout_s)"
    assert commands == [StopWorker(0, reason), StartWorker(1)]
    assert step(state, WorkerUp(1), 28.0)[1] == [Assign(1, "d", 2)]


def test_a_result_out_of_order_leaves_the_clock_of_the_running_task_alone():
    state, _ = play(ready(1, in_flight=3), (0.0, items("abc")), (9.0, Result(0, "b", 1)))
    assert next_deadline(state) == 100.0
    state, _ = play(state, (10.0, Result(0, "a", 1)), (12.0, items("de")), (15.0, Result(0, "d", 1)))
    assert state.durations_s == {"train": (10.0,)}, "how long an answer out of order took is not known"
    assert play(state, (16.0, Result(0, "c", 1)))[0].durations_s == {"train": (10.0, 6.0)}


def test_stale_answers_are_dropped_and_counted():
    state, _ = play(ready(1), (1.0, items("abc")), (2.0, Result(0, "a", 1)))
    for now, event in enumerate(
        (Result(0, "a", 1), Failure(0, "a", 1, "no"), Result(7, "b", 1), Failure(7, "b", 1, "no"))
    ):
        before = state
        state, commands = step(state, event, 3.0 + now)
        assert (commands, state) == ([], replace(before, duplicates=now + 1))


def test_a_late_result_of_a_superseded_attempt_is_accepted():
    base, _ = play(ready(in_flight=1), (1.0, items("ab")), (2.0, Failure(0, "a", 1, "lost contact")))
    queued, commands = step(base, Result(0, "a", 1), 3.0)
    assert commands == [Deliver("a")]
    assert not queued.queue
    held, commands = play(base, (3.0, Result(1, "b", 1)), (4.0, Result(0, "a", 1)))
    assert commands == [Deliver("a")]
    # Worker 1 is still busy with its copy, whatever becomes of it.
    state, commands = step(held, items("cd"), 5.0)
    assert commands == [Assign(0, "c", 1)]
    state, commands = step(state, Result(1, "a", 2), 6.0)
    assert (commands, state.duplicates) == ([Assign(1, "d", 1)], 1)
    assert step(held, WorkerLost(1, "killed"), 6.0)[1] == [StartWorker(2)]
    assert not step(held, WorkerLost(1, "killed"), 6.0)[0].items


def test_a_key_may_be_submitted_again_only_after_it_was_delivered():
    state, _ = play(ready(), (1.0, items("ab")))
    with pytest.raises(ValueError, match="submitted again"):
        step(state, items("b"), 2.0)
    assert pending(play(state, (2.0, Result(1, "b", 1)), (3.0, items("b")))[0]) == 2


def test_a_worker_busy_with_an_old_copy_does_not_answer_for_the_new_one():
    held, _ = play(ready(in_flight=1), (1.0, items("ab")), (2.0, Failure(0, "a", 1, "no")), (3.0, Result(1, "b", 1)))
    held, _ = play(held, (4.0, Result(0, "a", 1)), (5.0, items("a")))
    assert held.items["a"].holder == 0
    for event in (WorkerLost(1, "killed"), Failure(1, "a", 2, "no")):
        state, _ = step(held, event, 6.0)
        assert (list(state.queue), state.items["a"]) == ([], held.items["a"])
    assert step(held, Result(1, "a", 2), 6.0)[1] == [Deliver("a")]


def test_limits_without_workers_or_attempts_is_refused():
    for name in ("workers", "in_flight", "max_attempts", "max_failures_in_a_row", "max_start_failures"):
        with pytest.raises(ValueError, match=rf"{name} \(0\) must be at least 1"):
            replace(LIMITS, **{name: 0})


def seconds_per_event(workers: int, count: int) -> float:
    """CPU time of the scheduler for an answer, from when all items are submitted until all are delivered."""
    state = initial_state(replace(LIMITS, workers=workers))
    handle(state, Tick(), 0.0)
    for worker in range(workers):
        handle(state, WorkerUp(worker), 0.0)
    commands = handle(state, Submit(tuple(WorkItem(index, "train") for index in range(count))), 1.0)
    started, events = time.process_time(), 0
    while commands:
        assigned = [command for command in commands if isinstance(command, Assign)]
        commands = []
        for command in assigned:
            commands += handle(state, Result(command.worker, command.item_id, command.attempt), 2.0)
            events += 1
    assert pending(state) == 0
    return (time.process_time() - started) / events


def test_an_event_costs_little():
    """About 15 microseconds on one core; the bound leaves room for a slow and busy machine."""
    assert seconds_per_event(2, 640) < 500e-6


@pytest.mark.slow
def test_an_event_costs_hardly_more_with_many_workers_or_items():
    """About a tenth more for 10,000. Were all workers or items looked at, more than three times."""
    few_s = min(seconds_per_event(100, 640) for _ in range(3))
    for workers in (100, 10_000):
        assert min(seconds_per_event(workers, 10_000) for _ in range(2)) < 2.0 * few_s
