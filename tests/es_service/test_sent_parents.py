"""What both engines send of the parents of policies: each once, again what was forgotten, all to a worker that lacks
some. The workers' side is the project's own, in threads and in this process; what it computes are the policies."""

from __future__ import annotations

import pickle
import random
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from es_service.dispatch import inline_engine as inline_module
from es_service.dispatch.engine import Answer, Engine
from es_service.dispatch.events import Compiled, Failure, Limits, Placed, WorkerUp
from es_service.dispatch.ray_calls import IN_CALL_BYTES
from es_service.dispatch.ray_cluster import Connection
from es_service.dispatch.ray_engine import Actors
from es_service.dispatch.ray_nodes import ONE_CORE
from es_service.errors import EvaluationError
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.child import Child, socket_pair
from es_service.protocol.messages import TrainingChunk, Work, with_subject
from es_service.protocol.nearest import ROWS, archive_entries
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.policies import IsoLine, Policies, Recipes, recipes_of
from es_service.protocol.process_environment import child_environment
from es_service.protocol.sent import LackingError, Memory, Received, parcel
from tests.es_service.test_ray_engine import PretendedRay
from tests.helpers import centre, spec
from workers import process
from workers.actor import WorkerActor
from workers.compiling import Compilable
from workers.reports import Reports
from workers.worker import Made

PARENTS, WORKERS = 60, 2
FAILING = 9
"""Number of an ask whose chunks raise an exception."""
POINT = centre(np.arange(8, dtype=np.float32))
LIMITS, SPEC = Limits(workers=WORKERS, max_attempts=1), spec()


def made(work: Sequence[Work]) -> list[Any]:
    """In the place of results: the policies of each chunk."""
    if work[0][1].ask == FAILING:
        raise ValueError("no memory")
    return [subject.parameters_N_D.made().tobytes() for subject, _ in work]


COMPUTING = Compilable(made, lambda work: [])


class Generations:
    """Work of one generation after another, whose parents change slowly."""

    def __init__(self, size: int) -> None:
        rng = np.random.default_rng(0)
        self.rng, self.size, self.generation = rng, size, 0
        self.parents = [self.parent() for _ in range(PARENTS)]

    def parent(self) -> np.ndarray:
        values = self.rng.normal(size=self.size).astype(np.float32)
        values.flags.writeable = False
        return values

    def next(self, policies: int = 64, new: int = 2) -> list[Work]:
        for _ in range(new):
            self.parents[self.rng.integers(PARENTS)] = self.parent()
        self.generation += 1
        used, drawn = np.unique(self.rng.integers(PARENTS, size=(policies, 2)), return_inverse=True)
        keys = stream_keys(0, Domain.VARIATION, self.generation, np.arange(policies))
        rule = IsoLine(0.1, 0.2)
        recipes = recipes_of(rule, [self.parents[one] for one in used], drawn.reshape(-1, 2), keys)
        return policy_work(recipes, no_statistics(policies, 2), 1, seed=0, generation=self.generation).work


class Threads(inline_module.ChildProcesses):
    """Workers of the inline engine as threads of this process, which may keep less than their sender believes."""

    def __init__(self, sender: int, worker: int) -> None:
        super().__init__(spec(parent_cache_bytes=sender))
        self.theirs = spec(parent_cache_bytes=worker)
        self.sent: list[list[bytes]] = []
        """Names of the parents that were sent with each work item."""

    def start(self, worker: int) -> None:
        child = Child("tests.es_service.shell_child:shell", child_environment())
        ours, theirs = socket_pair()
        computing: Future[Any] = Future()
        computing.set_result(Made(COMPUTING, set()))
        given = theirs.detach(), computing, self.theirs, Reports(self.theirs)
        threading.Thread(target=process._work, args=given, daemon=True).start()
        self._add(worker, child, ours)
        self._ready.append(Placed(worker))

    def send(self, worker, item_id, attempt, work):
        before = set(self._workers[worker].memory)
        super().send(worker, item_id, attempt, work)
        self.sent.append([name for name in self._workers[worker].memory if name not in before])


class ActorsHere(PretendedRay):
    """Actors of the Ray engine that compute in this process."""

    def __init__(self, worker: int) -> None:
        super().__init__()
        self.theirs = worker

    def _start(self, spec: bytes, index: int, gpus: float, cores: int) -> Any:
        found, actor = super()._start(spec, index, gpus, cores), WorkerActor(spec, index)
        actor._made = Made(COMPUTING, set())
        actor._received = Received(self.theirs, Recipes.made)
        actor._reports = Reports(SPEC)

        def remote(name: str) -> SimpleNamespace:
            def body(*parts: Any) -> Any:
                return getattr(actor, name)(*(self.stored[one] if isinstance(one, int) else one for one in parts))

            return SimpleNamespace(remote=self._caller(found.itself, name, body))

        return SimpleNamespace(itself=found.itself, place=found.place, build=found.build, run=remote("run"),
                               compile=remote("compile"))  # fmt: skip


@contextmanager
def inline(sender: int, worker: int) -> Iterator[tuple[Engine, Any]]:
    transport = Threads(sender, worker)
    with Engine(transport, LIMITS) as engine:
        yield engine, lambda: [name for names in transport.sent for name in names]


@contextmanager
def ray(sender: int, worker: int) -> Iterator[tuple[Engine, Any]]:
    pretended = ActorsHere(worker)
    transport = Actors(
        Connection(pretended),
        spec(parent_cache_bytes=sender),
        type(None),
        ONE_CORE,
        None,
        None,
        WORKERS,
    )

    def sent() -> list[bytes]:
        small = [pickle.loads(item)[0] for item, *_ in pretended.calls]
        large = [pickle.loads(pretended.stored[one]) for _, *stored in pretended.calls for one in stored]
        return [name for arrays in (*small, *large) for name in arrays]

    with Engine(transport, LIMITS) as engine:
        yield engine, sent


@pytest.mark.parametrize("size", [10, IN_CALL_BYTES // 2], ids=["small", "large"])
@pytest.mark.parametrize("engine", [inline, ray])
def test_each_parent_is_sent_at_most_once_to_each_worker_that_keeps_all(engine, size):
    generations = Generations(size)
    with engine(2**40, 2**40) as (evaluator, sent):
        needed: set[bytes] = set()
        for _ in range(12):
            work = generations.next()
            assert evaluator.evaluate(work) == made(work)
            needed |= {name for subject, _ in work for name in subject.parameters_N_D.names}
        assert needed == set(sent())
        assert len(sent()) <= WORKERS * len(needed)
        assert evaluator.counts.retries == evaluator.counts.lost_workers == 0
        before = len(sent())
        evaluator.evaluate(generations.next(new=0))
        warm = len(sent()) - before
    assert warm < PARENTS / 2, "of some sixty parents that each of two workers needs"


def test_a_large_parent_is_stored_once_for_all_actors_and_a_small_one_never():
    for size, is_stored in ((10, False), (IN_CALL_BYTES // 2, True)):
        pretended, generations = ActorsHere(2**40), Generations(size)
        transport = Actors(Connection(pretended), spec(), type(None), ONE_CORE, None, None, WORKERS, lambda _: None)
        with Engine(transport, LIMITS) as evaluator:
            names: set[bytes] = set()
            for _ in range(6):
                evaluator.evaluate(work := generations.next())
                names |= {name for subject, _ in work for name in subject.parameters_N_D.names}
        assert len(pretended.stored) == (len(names) if is_stored else 0)
        if not is_stored:
            assert max(map(len, pretended.calls)) == 1, "the policies of all chunks and their parents are one argument"


@pytest.mark.parametrize("keeps", [1, 20, 40])
@pytest.mark.parametrize("engine", [inline, ray])
def test_what_a_worker_has_forgotten_is_sent_again(engine, keeps):
    generations, limit = Generations(10), keeps * 40
    with engine(limit, limit) as (evaluator, sent):
        for _ in range(12):
            work = generations.next()
            assert evaluator.evaluate(work) == made(work)
        assert len(sent()) > len(set(sent()))
        assert evaluator.counts.retries == 0


@pytest.mark.parametrize("engine", [inline, ray])
def test_a_worker_that_lacks_parents_is_sent_them_and_no_attempt_is_charged(engine):
    """Which may be the only one: the engines above allow no second attempt."""
    generations, rng = Generations(10), random.Random(0)
    with engine(2**40, 10 * 40) as (evaluator, sent):
        for _ in range(20):
            work = generations.next(rng.choice([16, 48, 200]))
            assert evaluator.evaluate(work) == made(work)
        assert evaluator.counts.retries == evaluator.counts.lost_workers == 0
        names = sent()
    assert len(names) > 3 * len(set(names)), "most of them again and again"


@pytest.mark.parametrize("engine", [inline, ray])
def test_a_worker_that_lacks_what_it_was_just_sent_has_failed(engine, monkeypatch):
    generations = Generations(10)
    with engine(2**40, 2**40) as (evaluator, _):
        evaluator.evaluate(generations.next())
        monkeypatch.setattr(Received, "add", lambda self, arrays: None)
        with pytest.raises(EvaluationError, match="though it was sent all of them"):
            evaluator.evaluate(generations.next(new=PARENTS))


def test_what_was_sent_with_an_item_that_failed_is_not_sent_again():
    transport, generations = Threads(2**40, 2**40), Generations(10)
    transport.start(0)
    work = generations.next()
    transport.send(0, "bad", 1, [(subject, replace(chunk, ask=FAILING)) for subject, chunk in work])
    transport.send(0, "good", 1, work)
    heard = [message for _ in range(5) if (message := transport.receive(10.0)) is not None]
    transport.close()
    assert [type(one) for one in heard] == [Placed, WorkerUp, Compiled, Failure, Answer]
    assert heard[-1].results == made(work)
    assert (len(transport.sent[0]) > 0, transport.sent[1]) == (True, [])


def test_a_worker_says_that_it_lacks_entries_of_the_novelty_archive_and_is_sent_all_again():
    """What it has of them stays while it is sent other work."""
    places, sender, worker = np.random.default_rng(0).normal(size=(ROWS + 2, 2)), Memory(2**20, int), None

    def sent(size):
        entries = archive_entries(places[:size], None, 10, "euclidean")
        arrays, origins, written = parcel([(replace(POINT, archive=entries), TrainingChunk(1, 0))], sender)
        worker.add(arrays)
        [(subject, _)] = worker.work(origins, written)
        np.testing.assert_array_equal(subject.archive.descriptors, places[:size])
        return [len(array) for array in arrays.values()]

    worker = Received(2**20, Recipes.made)
    assert sent(ROWS + 1) == [ROWS, 1]
    worker.add(parcel([(POINT, TrainingChunk(1, 0))], sender).arrays)
    assert sent(ROWS + 2) == [2]
    worker = Received(2**20, Recipes.made)
    with pytest.raises(LackingError):
        sent(ROWS + 1)
    sender.clear()
    assert sent(ROWS + 2) == [ROWS, 2]


def test_a_policy_alone_is_not_taken_for_a_centre_with_the_same_bits():
    """Items with both are under way at a time, so that one worker has both."""
    parameters_D = np.arange(2048, dtype=np.float32)
    alone = policy_work(parameters_D[None], no_statistics(1, 2), 4, seed=0, generation=1).work
    as_centre = with_subject(centre(parameters_D), [TrainingChunk(1, 0)])
    sender, worker = Memory(2**20, int), Received(2**20, Recipes.made)
    for work in (as_centre, alone, as_centre):
        arrays, origins, written = parcel(work, sender)
        worker.add(arrays)
        [(subject, _)] = worker.work(origins, written)
        found = subject.parameters_N_D if isinstance(subject, Policies) else subject.parameters_D
        np.testing.assert_array_equal(found, parameters_D[None] if work is alone else parameters_D, strict=True)
