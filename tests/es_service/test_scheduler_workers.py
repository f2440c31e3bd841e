"""The scheduler by hand: workers that start, do not come up, hang, drain; how many there are."""

from __future__ import annotations

from dataclasses import replace

import pytest

from es_service.dispatch.events import (
    Assign,
    Deliver,
    Drain,
    Fail,
    Failure,
    Placed,
    Result,
    SetWorkers,
    StartWorker,
    StopWorker,
    Tick,
    WorkerLost,
    WorkerUp,
)
from es_service.dispatch.scheduler_state import initial_state, is_waiting, next_deadline
from tests.es_service.scheduler_play import LIMITS, items, play, ready, step

TOO_LATE = "did not come up within 50 s (half of compute.no_worker_timeout_s)"


def test_a_worker_that_keeps_raising_is_quarantined_without_blaming_its_next_task():
    state, _ = play(ready(), (1.0, items("abcdefg")), (2.0, Failure(0, "a", 1, "no")), (3.0, Failure(0, "c", 1, "bad")))
    assert sorted(state.up) == [1]
    assert list(state.queue) == ["c", "e", "a", "f", "g"]
    assert state.lost_workers == 1
    assert step(state, WorkerUp(2), 4.0)[1] == [Assign(2, "c", 2), Assign(2, "e", 1)]
    assert state.items["e"].faults == 0
    state, _ = play(
        ready(1), (1.0, items("abc")), (2.0, Failure(0, "a", 1, "no")), (3.0, Result(0, "b", 1)),
        (4.0, Failure(0, "a", 2, "no")),
    )  # fmt: skip
    assert sorted(state.up) == [0], "a success in between"


def test_replacements_back_off_until_a_success():
    state, commands = step(ready(1, max_attempts=99), items("a"), 0.0)
    now, waits = 0.0, []
    for worker in range(6):
        state, commands = step(state, WorkerLost(worker, "killed"), now)
        if not commands:
            waits.append(next_deadline(state) - now)
            now += waits[-1]
            state, commands = step(state, Tick(), now)
        assert commands == [StartWorker(worker + 1)]
        state, _ = step(state, WorkerUp(worker + 1), now)
    assert waits == [1.0, 2.0, 3.0, 3.0, 3.0]
    state, commands = play(state, (now, Result(6, "a", 7)), (now + 1.0, WorkerLost(6, "killed")))
    assert commands == [StartWorker(7)]


def test_losses_during_a_wait_share_it():
    state, _ = play(ready(9), *((0.0, WorkerLost(worker, "node died")) for worker in range(8)))
    assert (sorted(state.starting), next_deadline(state)) == ([9], 1.0)
    assert step(state, Tick(), 1.0)[1] == [StartWorker(worker) for worker in range(10, 17)]


def test_a_broken_environment_is_reported_soon():
    """Of two workers whose every start raises at once: after one wait of restart_backoff_s."""
    state, _ = play(initial_state(LIMITS), (0.0, Tick()), (0.1, WorkerLost(0, "no module")))
    state, _ = play(state, (0.2, WorkerLost(1, "no module")), (0.3, WorkerLost(2, "no module")))
    assert (state.failed, next_deadline(state)) == (None, 1.2)
    state, _ = step(state, Tick(), 1.2)
    state, commands = step(state, WorkerLost(3, "ImportError: brax"), 1.3)
    message = "no worker started in 3 consecutive attempts; last loss: worker 3: ImportError: brax"
    assert commands == [Fail(message), StopWorker(4, "the run failed")]
    assert (state.failed, state.lost_workers) == (message, 4)


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("workers", range(1, 10))
def test_workers_that_are_lost_together_before_they_come_up_are_one_try_however_many(workers, at_once):
    """At once, as those that are too slow are; or one after the other, as when their node or process dies."""
    state, _ = step(initial_state(replace(LIMITS, workers=workers)), Tick(), 0.0)
    now = 0.0
    for tries in range(LIMITS.max_start_failures):
        assert (state.failed, state.start_failures, len(state.starting)) == (None, tries, workers)
        now += 50.0
        if at_once:
            state, _ = step(state, Tick(), now)
        else:
            losses = [(now + 0.01 * number, WorkerLost(worker, "")) for number, worker in enumerate(state.starting)]
            state, _ = play(state, *losses)
        now += LIMITS.max_backoff_s  # less than start_timeout_s
        state, _ = step(state, Tick(), now)
    assert state.failed is not None
    assert state.failed.startswith("no worker started in 3 consecutive attempts")


def test_a_place_gives_a_worker_all_its_time_to_come_up():
    """A cluster has room for three just before they would be started anew."""
    state, _ = step(initial_state(replace(LIMITS, workers=3)), Tick(), 0.0)
    state, _ = play(state, *((49.0, Placed(worker)) for worker in range(3)))
    assert next_deadline(state) == 99.0
    state, commands = play(state, (98.0, WorkerUp(0)), (99.0, Tick()))
    assert commands[0] == StopWorker(1, TOO_LATE)
    for stranger in (0, 1, 7):
        assert step(state, Placed(stranger), 99.5) == (state, [])


def test_start_failures_are_forgiven_while_a_worker_is_up():
    state = ready(2)
    state, _ = play(state, (0.0, WorkerLost(0, "killed")), *((0.1 + w, WorkerLost(w, "no memory")) for w in (2, 3, 4)))
    state, _ = play(state, (50.0, Tick()), (50.0, WorkerLost(3, "no memory")), (99.0, Tick()))
    state, _ = play(state, (99.0, WorkerLost(4, "no memory")))
    assert state.failed is None
    # The last that is up is lost, and then it takes three again.
    state, _ = play(state, (200.0, WorkerLost(1, "killed")), (300.0, Tick()))
    assert sorted(state.starting) == [5, 6]
    state, _ = play(state, (301.0, WorkerLost(5, "no memory")), (310.0, Tick()), (311.0, WorkerLost(7, "no memory")))
    assert (state.failed, state.start_failures) == (None, 2)
    state, _ = play(state, (312.0, WorkerUp(6)))
    assert state.start_failures == 0


def test_a_worker_that_never_comes_up_is_killed_and_replaced():
    state, _ = play(initial_state(LIMITS), (0.0, Tick()), (1.0, WorkerUp(1)))
    assert next_deadline(state) == 50.0
    state, commands = step(state, Tick(), 50.0)
    assert commands == [StopWorker(0, TOO_LATE), StartWorker(2)]
    assert step(state, WorkerUp(0), 51.0) == (state, [])
    assert step(state, WorkerLost(0, "stopped"), 51.0) == (state, [])


def test_a_worker_without_a_place_is_started_anew_and_nobody_hears_of_it():
    """However often: then the last that is up is lost, and the run waits for others as long as it should."""
    patient = initial_state(replace(LIMITS, compile_timeout_s=1000.0))
    state, _ = play(patient, (0.0, Tick()), (1.0, WorkerUp(0)), (1.0, items("a")))
    for number in range(1, 6):
        state, commands = step(state, Tick(silent=(number,)), 50.0 * number)
        assert commands == [StopWorker(number, TOO_LATE), StartWorker(number + 1)]
    assert (state.lost_workers, state.last_lost, state.start_failures) == (0, None, 0)
    state, _ = play(state, (251.0, WorkerLost(0, "killed")), (252.0, WorkerLost(6, "no memory")))
    assert (state.failed, state.lost_workers) == (None, 2)


def test_what_a_silent_worker_does_not_answer_in_time_is_not_to_blame():
    state, _ = play(ready(1), (0.0, items("a")))
    state, commands = step(state, Tick(silent=(0,)), 100.0)
    assert commands == [
        StopWorker(0, "no answer to work item a within 100 s of computing (compute.first_chunk_timeout_s)"),
        StartWorker(1),
    ]
    assert state.lost_workers == 1
    assert step(state, WorkerUp(1), 101.0)[1] == [Assign(1, "a", 1)]


def test_no_worker_for_too_long_after_the_first_had_come_up_fails_the_run():
    state, _ = play(ready(), (5.0, WorkerLost(0, "killed")), (5.0, WorkerLost(1, "killed")), (40.0, Tick()))
    assert state.failed is None, "nothing waits"
    state, commands = play(state, (50.0, items("ab")), (55.0, Tick()), (79.9, Tick()))
    assert (state.failed, next_deadline(state)) == (None, 80.0)
    state, commands = step(state, Tick(), 80.0)
    assert commands[0] == Fail(
        "no worker was up for 30 s (compute.no_worker_timeout_s) while 2 work items waited; "
        "last loss: worker 2: " + TOO_LATE
    )


def test_a_run_waits_for_its_first_place_for_as_long_as_it_takes():
    """Its workers are started anew, which is no fault; what it waits for does not depend on whether it has work."""
    state, now = step(initial_state(LIMITS), Tick(), 0.0)[0], 0.0
    state, _ = step(state, items("a"), 1.0)
    for _ in range(100):
        now += 50.0
        assert next_deadline(state) == now
        state, commands = step(state, Tick(tuple(state.starting)), now)
        assert [type(command) for command in commands] == [StopWorker, StopWorker, StartWorker, StartWorker]
        assert is_waiting(state)
    assert (state.failed, state.lost_workers, state.start_failures) == (None, 0, 0)
    first = min(state.starting)
    placed, _ = step(state, Placed(first), now + 1.0)
    assert not is_waiting(placed)
    state, commands = step(placed, WorkerUp(first), now + 2.0)
    assert commands == [Assign(first, "a", 1)]
    gone, _ = step(placed, WorkerLost(first, "preempted"), now + 2.0)
    assert is_waiting(gone), "the only one with a place is gone"
    assert gone.down_since_s == now + 2.0


def test_a_first_place_can_have_a_time_limit():
    limits = replace(LIMITS, place_timeout_s=70.0)
    state, _ = play(initial_state(limits), (0.0, Tick()), (40.0, items("a")), (50.0, Tick((0, 1))))
    assert next_deadline(state) == 70.0
    assert step(state, Tick((2, 3)), 70.0)[1] == [
        Fail("no worker got a place for 70 s (compute.place_timeout_s); last loss: no worker was lost"),
        StopWorker(2, "the run failed"),
        StopWorker(3, "the run failed"),
    ]
    state, _ = step(state, Placed(3), 69.0)
    assert next_deadline(state) == 100.0, "then only its start has a limit"
    state, _ = play(state, (80.0, WorkerLost(3, "preempted")), (100.0, Tick((2,))))
    assert (state.failed, state.down_since_s) == (None, 80.0), "the wait begins anew"


def test_a_smaller_number_of_workers_stops_first_those_that_wait():
    """Even if they are older: a worker that waits for a place has nothing that could be lost."""
    state, _ = step(initial_state(replace(LIMITS, workers=4)), Tick(), 0.0)
    state, _ = play(state, (1.0, Placed(3)), (1.0, Placed(1)), (2.0, WorkerUp(3)))
    state, commands = step(state, SetWorkers(3), 3.0)
    assert commands == [StopWorker(2, "drained")]
    state, commands = step(state, SetWorkers(1), 4.0)
    assert commands == [StopWorker(1, "drained"), StopWorker(0, "drained")]
    assert sorted(state.up) == [3]


def test_a_drained_worker_finishes_what_it_has_and_is_replaced_without_blame():
    state, commands = play(ready(), (1.0, items("abcdef")), (2.0, Drain(0)))
    assert commands == [StartWorker(2)]
    assert step(state, Result(0, "a", 1), 3.0)[1] == [Deliver("a")]
    done, commands = play(state, (3.0, Result(0, "a", 1)), (4.0, Result(0, "c", 1)))
    assert commands == [Deliver("c"), StopWorker(0, "drained")]
    lost, commands = play(state, (3.0, WorkerLost(0, "preempted")), (4.0, WorkerUp(2)))
    assert commands == [Assign(2, "a", 1), Assign(2, "c", 1)]
    assert (done.lost_workers, lost.lost_workers) == (0, 0)
    assert step(ready(), Drain(0), 1.0)[1] == [StopWorker(0, "drained"), StartWorker(2)]
    assert play(initial_state(LIMITS), (0.0, Tick()), (1.0, Drain(0)))[1] == [StopWorker(0, "drained"), StartWorker(2)]
    # One that hangs while draining is killed all the same.
    state, commands = play(state, (3.0, WorkerUp(2)), (101.0, Tick()))
    assert (
        StopWorker(0, "no answer to work item a within 100 s of computing (compute.first_chunk_timeout_s)") in commands
    )


def test_the_number_of_workers_follows_the_wish():
    state, commands = play(ready(3, in_flight=1), (1.0, items("abc")), (2.0, SetWorkers(5)))
    assert commands == [StartWorker(3), StartWorker(4)]
    state, commands = step(state, SetWorkers(2), 3.0)
    assert commands == [StopWorker(3, "drained"), StopWorker(4, "drained")]
    assert (sorted(state.up), sorted(state.draining)) == ([0, 1], [2])
    assert step(state, Result(2, "c", 1), 4.0)[1] == [Deliver("c"), StopWorker(2, "drained")]
    with pytest.raises(ValueError, match=r"SetWorkers\(0\)"):
        step(state, SetWorkers(0), 4.0)
