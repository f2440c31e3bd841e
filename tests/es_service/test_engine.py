"""The engine on a scripted transport in memory."""

from __future__ import annotations

import math
import random
import re
import signal
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.dispatch import engine as engine_module
from es_service.dispatch.engine import POLL_S, Answer, Engine, item_sizes
from es_service.dispatch.events import Compiled, Failure, Limits, WorkerLost, WorkerUp
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol.messages import EvaluationChunk, TrainingChunk, with_subject
from tests.helpers import centre, random_parameters

FIRST, SECOND = centre(random_parameters(0)), centre(random_parameters(1))
CHUNKS = [TrainingChunk(3, chunk_id) for chunk_id in range(8)]


@dataclass(frozen=True)
class Sent:
    """Chunks sent to a worker, and what the worker might say about them."""

    worker: int
    item_id: Any
    attempt: int
    work: Any

    @property
    def chunks(self) -> list[Any]:
        return [chunk for _, chunk in self.work]

    def answer(self) -> Answer:
        return Answer(self.worker, self.item_id, self.attempt, [expected(*one) for one in self.work])

    def failure(self) -> Failure:
        return Failure(self.worker, self.item_id, self.attempt, "no")


def expected(point, chunk) -> Any:
    """Stands for a result: names what it is the result of."""
    return (id(point), chunk)


class Scripted:
    """A Transport in memory. Workers come up and compile at once; the hooks, which tests replace, say what comes."""

    def __init__(self) -> None:
        self.inbox: deque = deque()
        self.sent: list[Sent] = []
        self.killed: list[int] = []
        self.last_words: dict[int, str] = {}
        self.waits: list[float] = []
        self.compiled: set[tuple[int, str]] = set()
        self.closed, self.used_s = False, math.nan
        self.on_send: Callable[[Sent], Any] = lambda sent: self.inbox.append(sent.answer())
        self.on_wait: Callable[[], Any] = lambda: None

    def start(self, worker):
        self.inbox.append(WorkerUp(worker))

    def last_words(self, worker):
        return ""

    def kill(self, worker):
        self.killed.append(worker)
        return self.last_words.get(worker, "")

    def send(self, worker, item_id, attempt, work):
        self.sent.append(Sent(worker, item_id, attempt, work))
        if (worker, item_id.kind) not in self.compiled:
            self.compiled.add((worker, item_id.kind))
            self.inbox.append(Compiled(worker, item_id.kind, 0.0))
        self.on_send(self.sent[-1])

    def cpu_s(self) -> float:
        return self.used_s

    def shortage(self) -> str:
        return ""

    def silent(self):
        return ()

    def receive(self, timeout_s):
        """Nothing is there: `on_wait` may change that if the engine is willing to wait."""
        self.waits.append(timeout_s)
        if not self.inbox and timeout_s:
            self.on_wait()
        return self.inbox.popleft() if self.inbox else None

    def close(self):
        self.closed = True


def scripted_with_clock(monkeypatch, now: list[float]) -> Scripted:
    """A transport under a clock that shows `now[0]` and goes on only while the engine waits."""
    transport = Scripted()
    transport.on_wait = lambda: now.__setitem__(0, now[0] + transport.waits[-1])
    monkeypatch.setattr(engine_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return transport


def test_seconds_of_processors_before_an_engine_are_not_its_own():
    """Such as those that workers which stay have computed for other runs."""
    transport = Scripted()
    transport.used_s = 5.0
    with Engine(transport, Limits(workers=1)) as engine:
        transport.used_s = 7.5
        assert engine.counts.cpu_s == 2.5


@pytest.mark.parametrize("seed", range(20))
def test_results_come_in_chunk_order_whatever_the_order_of_the_answers(seed, monkeypatch):
    rng, held = random.Random(seed), []
    transport = scripted_with_clock(monkeypatch, [0.0])  # on a busy machine, late items would be sent twice

    def answer_some():
        rng.shuffle(held)
        for _ in range(rng.randint(1, len(held))):
            transport.inbox.append(held.pop().answer())

    transport.on_send, transport.on_wait = held.append, answer_some
    with Engine(transport, Limits(workers=3)) as engine:
        for point in (FIRST, SECOND, FIRST):
            chunks = rng.sample(CHUNKS, len(CHUNKS))
            assert engine.evaluate(with_subject(point, chunks)) == [expected(point, chunk) for chunk in chunks]
        assert (engine.counts.retries, engine.counts.lost_workers, engine.counts.workers) == (0, 0, 3)
    assert transport.closed


@pytest.mark.parametrize("item_s", [0.0, 60.0])
@pytest.mark.parametrize("seed", range(5))
def test_results_of_several_centres_come_in_the_order_of_the_work(seed, item_s, monkeypatch):
    """Also if chunks of different centres are equal, as in `es-service evaluate`; and if a work item has both."""
    rng, held = random.Random(seed), []
    transport = scripted_with_clock(monkeypatch, [0.0])  # on a busy machine, late items would be sent twice

    def answer_one():
        transport.inbox.append(held.pop(rng.randrange(len(held))).answer())

    transport.on_send, transport.on_wait = held.append, answer_one
    third = centre(random_parameters(2))
    with Engine(transport, Limits(workers=2, item_s=item_s)) as engine:
        for _ in range(3):
            work = [(point, chunk) for point in (FIRST, SECOND, third) for chunk in CHUNKS]
            assert engine.evaluate(work) == [expected(*one) for one in work]
        assert engine.evaluate([]) == []
    assert len({sent.item_id for sent in transport.sent}) == len(transport.sent)
    mixed = [sent for sent in transport.sent if len({id(point) for point, _ in sent.work}) > 1]
    assert bool(mixed) == (item_s > 0.0)


def test_chunks_of_several_kinds_run_side_by_side_and_no_work_item_has_two():
    """As populations and policies of a generation do; each kind is divided by its own durations."""
    transport, held = Scripted(), []
    transport.on_send, transport.on_wait = held.append, lambda: transport.inbox.append(held.pop().answer())
    with Engine(transport, Limits(workers=2, item_s=60.0)) as engine:
        for _ in range(3):
            work = with_subject(FIRST, [*CHUNKS, *(EvaluationChunk(1, chunk) for chunk in range(5)), *CHUNKS])
            assert engine.evaluate(work) == [expected(*one) for one in work]
    assert all(len({type(chunk) for _, chunk in sent.work}) == 1 for sent in transport.sent)
    assert {sent.item_id.kind for sent in transport.sent} == {"TrainingChunk", "EvaluationChunk"}
    assert max(len(sent.work) for sent in transport.sent) > 1


@given(st.integers(1, 500), st.integers(1, 70), st.integers(1, 64), st.none() | st.floats(1e-7, 10.0))
def test_every_core_of_a_worker_has_a_chunk_if_there_are_enough(chunks, workers, cores, chunk_s):
    """`chunk_s` is the time of the whole worker."""
    sizes = item_sizes(chunks, workers, chunk_s, 0.03, cores)
    assert sum(sizes) == chunks
    assert max(sizes) - min(sizes) <= 1
    if chunks >= workers * cores:
        assert 2 * min(sizes) + 1 >= cores
    assert len(sizes) >= min(chunks, workers)
    if chunk_s is None:
        assert max(sizes) <= cores


@given(st.integers(1, 500), st.integers(1, 70), st.floats(1e-7, 10.0))
def test_tasks_are_of_equal_size_as_many_for_each_worker_and_none_takes_too_long(chunks, workers, chunk_s):
    sizes = item_sizes(chunks, workers, chunk_s, 0.01)
    assert sum(sizes) == chunks
    assert max(sizes) - min(sizes) <= 1
    assert max(sizes) == 1 or max(sizes) * chunk_s < 0.01001
    assert len(sizes) % workers == 0 or len(sizes) == chunks
    with_a_round_less = len(sizes) - workers
    assert with_a_round_less <= 0 or -(-chunks // with_a_round_less) * chunk_s > 0.00999
    assert item_sizes(chunks, workers, None, 0.01) == [1] * chunks


def test_short_chunks_travel_together_once_their_duration_is_known(monkeypatch):
    """One by one while workers are cold; after that as many as make 10 ms, or as there are for each worker. A chunk
    takes 2 ms, since the clock does not go on for two workers at once."""
    now, transport = [0.0], Scripted()
    monkeypatch.setattr(engine_module, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def take_a_millisecond_each(sent: Sent):
        now[0] += 1e-3 * len(sent.chunks)
        transport.inbox.append(sent.answer())

    transport.on_send = take_a_millisecond_each
    with Engine(transport, Limits(workers=2, in_flight=1, item_s=0.01)) as engine:
        numbers = []
        for count in (8, 6, 200):
            transport.sent.clear()
            chunks = [TrainingChunk(3, chunk_id) for chunk_id in range(count)]
            assert engine.evaluate(with_subject(FIRST, chunks)) == [expected(FIRST, chunk) for chunk in chunks]
            assert [chunk for sent in transport.sent for chunk in sent.chunks] == chunks
            numbers.append([len(sent.chunks) for sent in transport.sent])
    assert numbers[:2] == [[1] * 8, [3, 3]]
    assert numbers[2] == [5] * 40


def test_chunks_are_sent_when_an_evaluation_begins_and_their_results_can_be_left_behind():
    transport = Scripted()
    with Engine(transport, Limits(workers=2)) as engine:
        engine.evaluate(with_subject(FIRST, CHUNKS))
        sent = len(transport.sent)
        wait = engine.begin(with_subject(SECOND, CHUNKS))
        assert len(transport.sent) > sent
        assert wait(math.inf) == [expected(SECOND, chunk) for chunk in CHUNKS]
        engine.begin(with_subject(SECOND, CHUNKS))
        assert engine.evaluate(with_subject(FIRST, CHUNKS)) == [expected(FIRST, chunk) for chunk in CHUNKS]
        assert engine._results == {}


@pytest.mark.parametrize("already_there", [True, False])
def test_a_late_answer_of_an_earlier_call_is_not_taken_for_one_of_this(already_there):
    """The same chunks around another centre: only the number of the call tells the two answers apart."""
    transport = Scripted()
    late = []

    def contradict(sent: Sent):
        """The first chunk is reported failed, runs elsewhere, and its first worker answers after all, much later."""
        if not late:
            late.append(sent.answer())
            transport.inbox.append(sent.failure())
        else:
            transport.inbox.append(sent.answer())

    transport.on_send = contradict
    with Engine(transport, Limits(workers=2)) as engine:
        assert engine.evaluate(with_subject(FIRST, CHUNKS)) == [expected(FIRST, chunk) for chunk in CHUNKS]
        if already_there:
            transport.inbox.append(late[0])
        transport.on_send = lambda sent: transport.inbox.extend([*late, sent.answer()])
        assert engine.evaluate(with_subject(SECOND, CHUNKS)) == [expected(SECOND, chunk) for chunk in CHUNKS]
        assert transport.killed == []


def test_a_worker_lost_between_two_calls_gets_no_chunk_and_no_chunk_is_blamed():
    transport = Scripted()
    with Engine(transport, Limits(workers=2)) as engine:
        engine.evaluate(with_subject(FIRST, CHUNKS))
        transport.inbox.append(WorkerLost(0, "gone"))
        transport.sent.clear()
        assert engine.evaluate(with_subject(SECOND, CHUNKS)) == [expected(SECOND, chunk) for chunk in CHUNKS]
        assert {sent.worker for sent in transport.sent} == {1, 2}
        assert {sent.attempt for sent in transport.sent} == {1}
        assert (engine.counts.retries, engine.counts.lost_workers) == (0, 1)


def test_the_chunk_of_a_worker_lost_in_mid_call_runs_elsewhere():
    transport = Scripted()

    def die_once(sent: Sent):
        transport.inbox.append(WorkerLost(0, "gone") if sent.worker == 0 else sent.answer())

    transport.on_send = die_once
    with Engine(transport, Limits(workers=2)) as engine:
        assert engine.evaluate(with_subject(FIRST, CHUNKS)) == [expected(FIRST, chunk) for chunk in CHUNKS]
        assert (engine.counts.retries, engine.counts.lost_workers) == (2, 1)


@pytest.mark.parametrize("before", [True, False])
def test_what_a_lost_worker_still_says_is_dropped(before):
    """Whether its chunks still wait or have been answered by another."""
    transport = Scripted()

    def contradict(sent: Sent):
        last_words = Answer(0, sent.item_id, sent.attempt, ["not to be trusted"])
        if sent.worker == 0:
            transport.inbox.extend([WorkerLost(0, "gone"), WorkerUp(0), sent.failure()])
        else:
            transport.inbox.extend([last_words, sent.answer()] if before else [sent.answer(), last_words])

    transport.on_send = contradict
    with Engine(transport, Limits(workers=2)) as engine:
        assert engine.evaluate(with_subject(FIRST, CHUNKS)) == [expected(FIRST, chunk) for chunk in CHUNKS]
        assert engine.counts.lost_workers == 1


def test_a_chunk_that_fails_everywhere_is_named_and_ends_the_engine():
    transport = Scripted()
    transport.on_send = lambda sent: transport.inbox.append(
        sent.failure() if CHUNKS[2] in sent.chunks else sent.answer()
    )
    with Engine(transport, Limits(workers=2, restart_backoff_s=0.0)) as engine:
        for _ in range(2):  # and again, rather than wait for ever, if it is asked again
            with pytest.raises(EvaluationError, match=r"TrainingChunk 2 of generation 3 failed in 4 attempts.*: no"):
                engine.evaluate(with_subject(FIRST, CHUNKS))
        assert sorted(transport.killed) == [0, 1]


@pytest.mark.parametrize("flood", [False, True])
def test_a_request_to_stop_is_noticed_at_the_next_message_or_poll(flood):
    """Workers that say nothing, and one that never stops talking."""
    transport, asked = Scripted(), []

    def should_stop():
        asked.append(len(transport.waits))
        return signal.SIGTERM if len(asked) == 4 else None

    transport.on_send = lambda sent: None
    if flood:
        transport.on_wait = lambda: transport.inbox.extend([WorkerUp(0)] * 1000)
    with Engine(transport, Limits(workers=2), should_stop) as engine:
        with pytest.raises(Interrupted) as caught:
            engine.evaluate(with_subject(FIRST, CHUNKS))
        assert caught.value.signal_number == signal.SIGTERM
    assert len(asked) == 4
    assert len(transport.waits) - asked[0] == 3
    assert max(transport.waits) == POLL_S == 0.1


@pytest.mark.parametrize("answered", [True, False])
def test_answers_that_wait_are_read_before_the_clock(monkeypatch, answered):
    """A driver busy elsewhere (the clock leaps while it sends) must not kill workers that answered in time."""
    now = [0.0]
    transport = scripted_with_clock(monkeypatch, now)

    def leap(sent: Sent):
        now[0] += 100.0
        if answered or sent.worker > 1:
            transport.inbox.append(sent.answer())

    transport.on_send = leap
    with Engine(transport, Limits(workers=2, first_chunk_timeout_s=1.0, chunk_timeout_s=1.0)) as engine:
        assert engine.evaluate(with_subject(FIRST, CHUNKS)) == [expected(FIRST, chunk) for chunk in CHUNKS]
        assert transport.killed == ([] if answered else [0, 1])
        assert engine.counts.lost_workers == (0 if answered else 2)


def test_the_next_deadline_bounds_the_wait(monkeypatch):
    """Late by no more than one message, not by a whole poll."""
    now = [0.0]
    transport = scripted_with_clock(monkeypatch, now)
    transport.on_send = lambda sent: transport.inbox.append(sent.answer()) if sent.worker else None
    with Engine(transport, Limits(workers=1, first_chunk_timeout_s=0.25, chunk_timeout_s=0.25)) as engine:
        engine.evaluate(with_subject(FIRST, CHUNKS))
    assert transport.killed == [0]
    assert now[0] == pytest.approx(0.25)


@pytest.mark.parametrize("is_last", [False, True])
def test_what_a_hung_worker_had_written_is_told_with_its_loss(monkeypatch, is_last):
    """Also by the error, if it is the loss that ends the run; what a healthy one wrote is nobody's business."""
    transport = scripted_with_clock(monkeypatch, [0.0])
    transport.last_words = {0: "no licence; retrying", 1: "all is well"}
    transport.on_send = lambda sent: transport.inbox.append(sent.answer()) if sent.worker else None
    limits = Limits(
        workers=2,
        first_chunk_timeout_s=1.0,
        chunk_timeout_s=1.0,
        max_attempts=1 if is_last else 2,
        late_factor=math.inf,
    )
    with Engine(transport, limits) as engine:
        if is_last:
            with pytest.raises(EvaluationError, match=r"failed in 1 attempts.*its process:\nno licence; retrying$"):
                engine.evaluate(with_subject(FIRST, CHUNKS))
        else:
            engine.evaluate(with_subject(FIRST, CHUNKS))
        assert re.search(r"^worker 0: no answer .* output of its process:\nno licence; retrying$", engine.last_loss())
