"""The inline engine's real child processes, killed and stopped: no result changes and nothing is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from es_service.dispatch.events import Limits, StartWorker, Submit
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import EvaluationError
from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk, with_subject
from tests.helpers import SPEC, DirectEvaluator, centre, random_parameters, spec, stop

MAZE = spec(rollout="simd")
FIRST = centre(random_parameters(0))
CHUNKS = [TrainingChunk(3, chunk_id) for chunk_id in range(8)]


def footprint() -> tuple[int, int, int]:
    """What this process holds: open file descriptors, threads, child processes."""
    children = 0
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # a thread that was joined, which the kernel ends a little later than Python does
            children += len((task / "children").read_text().split())
    return len(os.listdir("/proc/self/fd")), threading.active_count(), children


def assert_same(results, others) -> None:
    np.testing.assert_equal([asdict(result) for result in results], [asdict(other) for other in others])


@pytest.mark.long
def test_killed_children_change_no_result_and_leave_nothing_behind():
    """Eight in a row, by turns between two calls and in the middle of one."""
    before = footprint()
    chunks = [EvaluationChunk(1, chunk_id) for chunk_id in range(8)]
    countdown, victim = 0, 0

    def kill_in_the_middle():
        nonlocal countdown
        countdown -= 1
        if countdown == 0:
            os.kill(victim, signal.SIGKILL)

    limits = Limits(workers=1, item_s=0.0, restart_backoff_s=0.01)
    with inline_engine(SPEC, limits, kill_in_the_middle) as engine:
        first = engine.evaluate(with_subject(FIRST, chunks))
        settled = footprint()
        for kill in range(1, 9):
            (victim,) = engine.transport.process_ids().values()
            if kill % 2:
                os.kill(victim, signal.SIGKILL)
            else:
                countdown = 3  # asked once before each message, so two of the eight have been answered
            assert_same(engine.evaluate(with_subject(FIRST, chunks)), first)
            assert engine.counts.lost_workers == kill
        assert footprint() == settled
    assert footprint() == before
    engine.close()  # again: nothing happens


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_a_child_stopped_in_mid_message_blocks_nobody():
    """Its socket holds a fraction of a 5 MB centre. The deadline passes, it is replaced, the result is right."""
    wide = spec(policy=PolicySpec((2, 1120, 1120, 2)), episode_steps=2)
    one, other = (centre(random_parameters(seed, wide.policy.parameters, 0.03)) for seed in (0, 1))
    assert one.parameters_D.nbytes > 5_000_000
    chunks = [EvaluationChunk(1, chunk_id) for chunk_id in range(3)]
    before = footprint()
    with inline_engine(wide, Limits(workers=1, chunk_timeout_s=0.5)) as engine:
        result = engine.evaluate(with_subject(one, chunks))
        with pytest.raises(AssertionError):
            assert_same(engine.evaluate(with_subject(other, chunks)), result)
        (victim,) = engine.transport.process_ids().values()
        stop(victim)
        assert_same(engine.evaluate(with_subject(one, chunks)), result)
        assert engine.counts.lost_workers == 1
        assert victim not in engine.transport.process_ids().values()
    assert footprint() == before


def test_children_that_cannot_be_started_are_lost_workers_and_leave_nothing_behind(monkeypatch):
    def no_more(*_, **__):
        raise OSError(24, "Too many open files")

    before = footprint()
    monkeypatch.setattr(subprocess, "Popen", no_more)
    with (
        inline_engine(SPEC, Limits(workers=1, restart_backoff_s=0.0)) as engine,
        pytest.raises(EvaluationError, match=r"(?s)3 consecutive attempts.*cannot be started.*Too many open files"),
    ):
        engine.evaluate(with_subject(FIRST, CHUNKS))
    assert footprint() == before


@pytest.mark.slow
def test_threads_that_are_lost_together_before_they_are_up_do_not_end_the_run():
    with inline_engine(MAZE, Limits(workers=6, restart_backoff_s=0.01), threads=True) as engine:
        (victim,) = set(engine.transport.process_ids().values())
        os.kill(victim, signal.SIGKILL)
        assert len(engine.evaluate(with_subject(FIRST, CHUNKS))) == len(CHUNKS)
        assert (engine.counts.lost_workers, engine.counts.retries) == (6, 0)


def test_an_engine_whose_log_cannot_be_written_leaves_no_child_behind():
    def full(entry):
        if isinstance(entry, StartWorker) and entry.worker == 1:
            raise OSError(28, "No space left on device")

    before = footprint()
    with pytest.raises(OSError, match="No space left"):
        inline_engine(SPEC, Limits(workers=2), log=full)
    assert footprint() == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_threads_are_lost_together_also_those_that_have_nothing_to_do(number):
    """One chunk and more threads than it may have attempts: it is sent to each of them when their child is gone, and
    blamed for the first."""
    before = footprint()
    long = spec(rollout="simd", episode_steps=200_000)
    limits = Limits(workers=6, chunk_timeout_s=3.0, restart_backoff_s=0.01)
    with inline_engine(long, limits, threads=True) as engine:
        expected = engine.evaluate(with_subject(FIRST, CHUNKS[:1]))
        engine.evaluate(with_subject(FIRST, CHUNKS[:1]))  # so that it is known how long it takes
        (victim,) = set(engine.transport.process_ids().values())
        timer = threading.Timer(0.02, os.kill, (victim, number))
        timer.start()
        for _ in range(3):
            assert_same(engine.evaluate(with_subject(FIRST, CHUNKS[:1])), expected)
        timer.join()
        assert_same(engine.evaluate(with_subject(FIRST, CHUNKS[:4]))[:1], expected)
        assert engine.counts.lost_workers == 6
        assert victim not in engine.transport.process_ids().values()
        assert len(set(engine.transport.process_ids().values())) == 1
    assert footprint() == before


@pytest.mark.slow
def test_an_error_says_in_which_of_the_chunks_that_travelled_together_it_was():
    broken = [*CHUNKS[:3], TrainingChunk(3, "four")]
    with inline_engine(MAZE, Limits(workers=1, item_s=60.0, restart_backoff_s=0.0)) as engine:
        engine.evaluate(with_subject(FIRST, CHUNKS))
        with pytest.raises(EvaluationError, match=r"(?s)in TrainingChunk four of.*item TrainingChunk 0 and 3 more of"):
            engine.evaluate(with_subject(FIRST, broken))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 3])
def test_two_hundred_centres_at_once_on_any_number_of_children(workers):
    """More than a child keeps; one by one, then in work items of several centres, then the oldest again."""
    short = spec(rollout="simd", episode_steps=5)
    points = [centre(random_parameters(number)) for number in range(200)]
    work = [(point, EvaluationChunk(1, 0, number % 3)) for number, point in enumerate(points)]
    expected = DirectEvaluator(short).evaluate(work)
    assert len({result.fitness.tobytes() for result in expected}) == 200
    items = []
    log = lambda entry: items.extend(entry.items) if isinstance(entry, Submit) else None  # noqa: E731
    with inline_engine(short, Limits(workers=workers, item_s=60.0), log=log) as engine:
        assert_same(engine.evaluate(work), expected)
        assert_same(engine.evaluate(work[::-1]), expected[::-1])
        assert_same(engine.evaluate(work[:70] * 2), expected[:70] * 2)
        assert engine.counts.lost_workers == engine.counts.retries == 0
    assert {item.size for item in items[:200]} == {1}
    assert max(item.size for item in items) == -(-200 // workers)
