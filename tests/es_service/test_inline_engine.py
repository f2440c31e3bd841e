"""What the inline engine's children may say and do: broken, cut short, out of turn, or all at once."""

from __future__ import annotations

import random
import re
import signal
import socket
import threading
import time
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from es_service.dispatch import inline_engine as inline_module
from es_service.dispatch.engine import Answer
from es_service.dispatch.events import Limits, Placed, Progress, WorkerLost, WorkerUp
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol.child import Child, socket_pair
from es_service.protocol.messages import TrainingChunk, Work, with_subject
from es_service.protocol.policies import Recipes
from es_service.protocol.process_environment import child_environment
from es_service.protocol.sent import LEAST_BYTES, Received
from es_service.protocol.user_code import RaisedError
from es_service.protocol.wire import framed, receive
from tests.helpers import SPEC, centre, random_parameters, spec

SHELL = "tests.es_service.shell_child:shell"
FIRST = centre(random_parameters(0))
CHUNKS = [TrainingChunk(3, chunk_id) for chunk_id in range(2)]


@pytest.fixture
def transport():
    """Two workers, threads of one child that does nothing, and the ends that should be theirs: in the test's hands."""
    with ExitStack() as stack:
        child = Child(SHELL, child_environment())
        transport = inline_module.ChildProcesses(SPEC, threads=True)
        ends = []
        for worker in range(2):
            ours, theirs = socket_pair()
            ends.append(stack.enter_context(theirs))
            transport._add(worker, child, ours)
        yield transport, ends
        transport.close()
        assert child.end().how == "signal SIGKILL"


class Receiver:
    """A worker's side of a socket, as in workers/process.py: the centres that it has, and how many it was sent."""

    def __init__(self, end: socket.socket, most_bytes: int = 2**40) -> None:
        self.end, self.received, self.sent = end, Received(most_bytes, Recipes.made), 0

    def item(self) -> list[tuple[float, int]]:
        """(first parameter of the centre, id) of each chunk of the next work item."""
        while (said := receive(self.end))[0] == "arrays":
            self.received.add(said[1])
            self.sent += len(said[1])
        return [(float(centre.parameters_D[0]), chunk.chunk_id) for centre, chunk in self.received.work(*said[3:])]


POINTS = [centre(np.full(LEAST_BYTES // 4, number, np.float32)) for number in range(200)]


def work_of(*numbers: int) -> list[Work]:
    return [(POINTS[number], TrainingChunk(3, position)) for position, number in enumerate(numbers)]


def test_a_centre_is_sent_once_for_items_one_after_another_and_a_worker_has_no_older_ones(transport):
    transport, (end, other) = transport
    worker, second = Receiver(end), Receiver(other)
    for numbers, sent in (
        ([0], 1),
        ([0], 1),
        ([0, 1, 0], 2),
        ([2, 1], 3),
        ([0], 4),  # it was forgotten with the item before, and now the others are
        ([1], 5),
        (range(100), 104),
        ([7], 104),
    ):
        transport.send(0, "key", 1, work_of(*numbers))
        assert worker.item() == [(number, position) for position, number in enumerate(numbers)]
        assert worker.sent == sent
        assert len(worker.received.memory) == len({*numbers})
    transport.send(1, "key", 1, work_of(99, 98))  # what one worker has, another may not have
    assert second.item() == [(99, 0), (98, 1)]
    assert second.sent == 2


def test_a_small_centre_travels_with_its_item(transport):
    transport, (end, _) = transport
    worker = Receiver(end)
    for _ in range(2):
        transport.send(0, "key", 1, with_subject(centre(np.full(LEAST_BYTES // 4 - 1, 5.0, np.float32)), CHUNKS))
        assert worker.item() == [(5.0, 0), (5.0, 1)]
    assert (worker.sent, len(worker.received.memory)) == (0, 0)


def test_a_message_with_an_array_is_made_once_while_it_is_new(transport, monkeypatch):
    monkeypatch.setattr(inline_module, "SENDER_BYTES", 3 * LEAST_BYTES)
    made = []
    monkeypatch.setattr(inline_module, "framed", lambda message: made.append(message[0]) or framed(message))
    transport, ends = transport
    workers = [Receiver(end) for end in ends]
    for numbers, count in (([0, 1], 2), ([0], 2), ([2], 3), ([0], 4)):
        for at, worker in enumerate(workers):
            transport.send(at, "key", 1, work_of(*numbers))
            assert worker.item() == [(number, position) for position, number in enumerate(numbers)]
        assert made.count("arrays") == count


@pytest.mark.parametrize("seed", range(5))
def test_a_worker_always_has_the_centres_of_its_chunks(transport, seed):
    """Items of any number of centres, some of which were forgotten, more than one waiting at a time."""
    transport, ends = transport
    rng, workers = random.Random(seed), [Receiver(end) for end in ends]
    waiting = [[], []]
    for _ in range(150):
        low, size = rng.randrange(200), rng.choice([1, 2, 5])
        numbers = [(low + rng.randrange(90)) % 200 for _ in range(size)]
        at = rng.randrange(2)
        transport.send(at, "key", 1, work_of(*numbers))
        waiting[at].append([(number, position) for position, number in enumerate(numbers)])
        for worker, items in zip(workers, waiting, strict=True):
            while len(items) > rng.randrange(3):
                assert worker.item() == items.pop(0)
    assert min(worker.sent for worker in workers) > 100, "most of them more than once"


LARGE = np.arange(1_000_000)


def test_an_answer_that_has_begun_to_come_is_there(transport):
    """Or a driver that was away would look at the clock, and kill a worker in the middle of its answer."""
    transport, (end, _) = transport
    frame = framed(("results", "key", 1, [LARGE]))
    sender = threading.Thread(target=end.sendall, args=(frame,))
    sender.start()
    time.sleep(0.05)
    message = transport.receive(0.0)
    sender.join()
    assert isinstance(message, Answer)
    np.testing.assert_array_equal(message.results, [LARGE])


def test_what_a_worker_says_of_its_progress_is_passed_on(transport):
    transport, (end, _) = transport
    end.sendall(framed(("progress", "making", 4, 16)))
    assert transport.receive(1.0) == Progress(0, "making", 4, 16)


def test_a_child_has_its_place_before_it_comes_up():
    """So a run with children never waits for a place."""
    transport = inline_module.ChildProcesses(spec())
    transport.start(0)
    assert [transport.receive(0.0), transport.receive(60.0)] == [Placed(0), WorkerUp(0)]
    transport.close()


def test_a_message_that_stops_half_way_keeps_nobody_waiting(transport):
    transport, (end, other) = transport
    end.sendall(framed(("up", ""))[:-2])
    started = time.monotonic()
    assert transport.receive(0.0) is None
    assert time.monotonic() - started < 5.0
    other.sendall(framed(("up", "")))
    assert transport.receive(1.0) == WorkerUp(1)


def test_what_threads_have_said_is_heard_before_they_are_lost_with_another(transport):
    transport, ends = transport
    ends[1].sendall(framed(("results", "key", 1, ["theirs"])))
    ends[0].close()
    heard = [transport.receive(1.0) for _ in range(3)]
    assert heard[0] == Answer(1, "key", 1, ["theirs"])
    assert [message.worker for message in heard[1:] if isinstance(message, WorkerLost)] == [0, 1]
    assert transport.receive(0.0) is None


def test_a_thread_that_has_answered_everything_is_a_bystander_of_its_child_s_end(transport):
    transport, ends = transport
    for worker in range(2):
        transport.send(worker, worker, 1, with_subject(FIRST, CHUNKS[:1]))
    ends[0].sendall(framed(("results", 0, 1, ["its own"])))
    ends[1].close()
    heard = [transport.receive(1.0) for _ in range(3)]
    assert heard[0] == Answer(0, 0, 1, ["its own"])
    assert {message.worker: message.charge_item for message in heard[1:]} == {0: False, 1: True}


class Unreadable:
    """Says how it is to be made again, in vain."""

    def __reduce__(self) -> Any:
        return int, ("no number",)


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (("broken", RaisedError("no jax here", "")), "^no jax here$"),
        (("results", "key", 1, Unreadable()), r"(?s)Traceback.*invalid literal for int"),
        (("something", "else"), "it sent an unknown message"),
    ],
)
def test_a_worker_that_says_what_nobody_can_use_is_lost(transport, said, reason):
    transport, ends = transport
    ends[1].sendall(framed(said))
    first, second = transport.receive(1.0), transport.receive(1.0)
    assert isinstance(first, WorkerLost)
    assert isinstance(second, WorkerLost)
    assert re.search(reason, first.reason)
    assert transport.process_ids() == {}


def test_what_a_process_wrote_before_it_was_killed_is_told_of_all_its_workers(transport):
    transport, _ = transport
    log = transport._workers[0].child._log
    log.write(b"waiting for a licence\n")
    log.flush()
    assert transport.kill(0) == "waiting for a licence"
    lost = transport.receive(0.0)
    assert isinstance(lost, WorkerLost)
    assert lost.reason == (
        "worker 0, a thread of the same process, was killed; the last output of its process:\nwaiting for a licence"
    )
    assert transport.kill(0) == ""


def test_a_signal_while_a_worker_is_heard_is_no_fault_of_the_worker(transport, monkeypatch):
    def interrupt(_):
        raise Interrupted(signal.SIGINT)

    transport, ends = transport
    ends[1].sendall(framed(("up", "")))
    monkeypatch.setattr(inline_module.Channel, "receive", interrupt)
    with pytest.raises(Interrupted):
        transport.receive(1.0)
    monkeypatch.undo()
    assert transport.receive(1.0) == WorkerUp(1)


def test_a_worker_that_has_said_its_last_is_lost_while_messages_still_wait_for_it(transport):
    transport, ends = transport
    for key in range(40):
        transport.send(0, key, 1, with_subject(centre(np.full(100_000, key, np.float32)), CHUNKS[:1]))
    assert transport._workers[0].channel.is_full
    ends[0].shutdown(socket.SHUT_WR)
    assert isinstance(transport.receive(1.0), WorkerLost)


def test_a_default_timeout_of_sockets_is_not_the_workers():
    socket.setdefaulttimeout(0.001)
    try:
        with inline_engine(SPEC, Limits(workers=1)) as engine:
            engine.evaluate(with_subject(FIRST, CHUNKS[:2]))
            assert engine.counts.lost_workers == 0
    finally:
        socket.setdefaulttimeout(None)


@pytest.mark.slow
def test_an_environment_that_exits_is_a_failure_with_its_traceback():
    exits = spec(environment="tests.examples.exits:Exits")
    with (
        inline_engine(exits, Limits(workers=1, max_failures_in_a_row=1, max_attempts=2)) as engine,
        pytest.raises(EvaluationError, match=r"(?s)SystemExit.*out of here"),
    ):
        engine.evaluate(with_subject(FIRST, CHUNKS[:1]))
