"""The Ray engine on a pretended Ray in memory: nodes that die or hang under workers, and actors without a place."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from es_service.dispatch import ray_calls, ray_cluster, waits
from es_service.dispatch import ray_engine as ray_engine_module
from es_service.dispatch.engine import Answer, Engine
from es_service.dispatch.events import (
    Compiled,
    Drain,
    Failure,
    Limits,
    Placed,
    Progress,
    SetWorkers,
    WorkerLost,
    WorkerUp,
)
from es_service.dispatch.ray_calls import IN_CALL_BYTES, Looks
from es_service.dispatch.ray_cluster import Connection
from es_service.dispatch.ray_engine import Actors
from es_service.dispatch.ray_nodes import ONE_CORE, Claim, Growth, Membership, emptiest, read_membership
from es_service.dispatch.staying import staying, workers
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol.messages import EvaluationChunk, Report, TrainingChunk, Work, with_subject
from es_service.protocol.policies import Recipes
from es_service.protocol.sent import LEAST_BYTES, Received
from es_service.protocol.sources import OtherCodeError
from tests.helpers import SPEC, centre, random_parameters

FIRST = centre(random_parameters())
CHUNK = TrainingChunk(3, 0)


class RayError(Exception):
    """As in Ray."""


class RayTaskError(RayError):
    """As in Ray."""


class OtherCodeRayTaskError(RayTaskError, OtherCodeError):
    """An exception of a worker, as Ray raises it in the driver."""

    def __init__(self, text: str) -> None:
        super().__init__(f"a traceback: {text}")
        self.cause = OtherCodeError(text)


class ActorDiedError(RayError):
    """As in Ray."""


@dataclass(eq=False)
class Actor:
    """An actor that answers at once. `state`: pending (without a place), alive, busy, hung or dead."""

    number: int
    state: str
    owed: list[Ref] = field(default_factory=list)
    ran: int = 0
    """Chunks."""
    seen: tuple[Any, str, int, int] = (0, "", 0, 0)
    """What it answers when it is asked how far it is, while it does not hang, with"""
    report: Report | None = None
    """its report, which is that of a call of `run`, too."""


@dataclass(eq=False)
class Ref:
    value: Any = None
    error: Exception | None = None
    is_ready: bool = False


class PretendedRay:
    """What the engine uses of the module. `on_run` says what becomes of an actor that runs chunks."""

    def __init__(self, room: int = 1000) -> None:
        self.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)
        self._private = SimpleNamespace(worker=SimpleNamespace())
        self.room, self.job = room, 1
        self.actors: list[Actor] = []
        self.on_run: Callable[[Actor], Any] = lambda actor: None
        self.node_of: Callable[[int], str] = lambda number: "node"
        self.calls: list[tuple[Any, ...]] = []
        """Arguments of each call of `run`."""
        self.compiled: list[tuple[int, str]] = []
        """(actor, kind of chunks) of each call of `compile`."""
        self.refusing: set[str] = set()
        """Nodes whose code is not the driver's."""
        self.logs: tuple[str, ...] = ()
        """Files of what actors print."""
        self.stored: list[bytes] = []
        self.strategies: list[Any] = []
        """Where each actor was to be placed: "SPREAD", or (node, options)."""
        self.selectors: list[Any] = []
        """The labels that its node must have, or None."""
        affinity = SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, **options: (node, options))
        self.util = SimpleNamespace(scheduling_strategies=affinity)

    def remote(self, **_: Any) -> Callable[[type], Any]:
        return lambda cls: SimpleNamespace(options=self._options)

    def _options(self, scheduling_strategy: Any, label_selector: dict[str, str] | None = None) -> Any:
        self.strategies.append(scheduling_strategy)
        self.selectors.append(label_selector)
        return SimpleNamespace(remote=self._start)

    def wait(self, refs: list[Ref], num_returns: int, timeout: float) -> tuple[list[Ref], list[Ref]]:
        ready = [ref for ref in refs if ref.is_ready][:num_returns]
        if not ready:
            time.sleep(timeout)
        return ready, []

    def get(self, ref: Ref) -> Any:
        if ref.error is not None:
            raise ref.error
        return ref.value

    def put(self, value: bytes) -> int:
        """Stores a value under its index, which stands for a reference."""
        self.stored.append(value)
        return len(self.stored) - 1

    def kill(self, actor: Any, no_restart: bool) -> None:
        self.end(actor.itself)

    def is_initialized(self) -> bool:
        return self.job > 0

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(get_node_id=lambda: "node", get_job_id=lambda: str(self.job))

    def shutdown(self) -> None:
        self.job = 0

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    available_resources = cluster_resources

    def end(self, actor: Actor, state: str = "dead") -> None:
        """An actor dies or hangs: nothing it owes is answered any more; or it gets a place and answers."""
        actor.state = state
        for ref in actor.owed:
            self._settle(actor, ref)

    def _start(self, spec: bytes, index: int, gpus: float, cores: int) -> Any:
        placed = sum(actor.state in ("alive", "hung") for actor in self.actors)
        excluded = self.node_of(index) in str(self.selectors[-1])
        actor = Actor(index, "alive" if placed < self.room and not excluded else "pending")
        self.actors.append(actor)
        received = Received(2**40, Recipes.made)

        def work(item: bytes, *stored: int) -> list[Work]:
            small, origins, pickled = pickle.loads(item)
            for arrays in (small, *(pickle.loads(self.stored[one]) for one in stored)):
                received.add(arrays)
            return received.work(origins, pickled)

        def compile(*item: Any) -> float:
            self.compiled.append((actor.number, type(work(*item)[0][1]).__name__))
            return 0.0

        methods = {
            "place": lambda: ("host", actor.number, self.node_of(actor.number), self.logs),
            "build": lambda *given: f"kind {actor.number % 2}",
            "compile": compile,
            "run": lambda *item: pickle.dumps(
                ([f"of {chunk}" for _, chunk in work(*item)], actor.report, 10.0 * (1 + actor.ran))
            ),
        }
        calls = {name: SimpleNamespace(remote=self._caller(actor, name, body)) for name, body in methods.items()}
        looked = SimpleNamespace(
            remote=lambda: Ref((actor.seen, actor.report), is_ready=actor.state in ("alive", "busy"))
        )
        calls["progress"] = SimpleNamespace(options=lambda concurrency_group: looked)
        return SimpleNamespace(itself=actor, **calls)

    def _caller(self, actor: Actor, name: str, body: Callable[..., Any]) -> Callable[..., Ref]:
        def call(*arguments: Any) -> Ref:
            ref = Ref(body(*arguments))
            actor.owed.append(ref)
            if name == "run":
                self.calls.append(arguments)
            if name == "build" and self.node_of(actor.number) in self.refusing:
                ref.error = OtherCodeRayTaskError(f"{self.node_of(actor.number)} has other code: a.py")
            if name == "run" and actor.state == "alive":
                actor.ran += 1
                self.on_run(actor)
            self._settle(actor, ref)
            return ref

        return call

    def _settle(self, actor: Actor, ref: Ref) -> None:
        if not ref.is_ready and actor.state in ("alive", "dead"):
            ref.error = ActorDiedError("gone") if actor.state == "dead" else ref.error
            ref.is_ready = True


class PretendedWatch:
    """Of a cluster that never changes, unless `now` does."""

    def __init__(self) -> None:
        self.now = Membership({}, {}, frozenset(), frozenset())

    def latest(self) -> Membership:
        return self.now

    def close(self) -> None:
        pass


def transport(
    ray: PretendedRay,
    limits: Limits,
    watch: PretendedWatch | None = None,
    growth: Growth | None = None,
    claim: Claim = ONE_CORE,
    on_refusal: Callable[[str], None] = lambda refusal: None,
) -> Actors:
    return Actors(Connection(ray), SPEC, type(None), claim, watch, growth, limits.workers, on_refusal)


def ray_engine(ray: PretendedRay, limits: Limits, watch: PretendedWatch | None = None) -> Engine[Actors]:
    return Engine(transport(ray, limits, watch), limits)


@pytest.mark.parametrize("state", ["dead", "hung"])
def test_a_node_that_dies_is_one_fault_of_what_it_ran_however_many_workers_it_held(state):
    """One chunk, and more idle actors on its node than it has attempts: they are called, in vain, and blame nobody."""
    ray, limits = PretendedRay(), Limits(6, chunk_timeout_s=0.05, first_chunk_timeout_s=0.05, restart_backoff_s=0.01)

    def node_dies(actor: Actor) -> None:
        for number in range(5):
            ray.end(ray.actors[number], state)
        ray.on_run = lambda actor: None

    with ray_engine(ray, limits) as engine:
        while not all(actor.ran for actor in ray.actors):  # so that all are up
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
        ray.on_run = node_dies
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert engine.counts.lost_workers == 5


def test_what_a_lost_actor_of_a_ray_of_our_own_has_printed_is_read_without_a_task_of_ray(tmp_path):
    """A task would need a process, which a busy machine may not start in time."""
    (tmp_path / "out").write_text("the licence has expired\n")
    ray = PretendedRay()
    ray.logs = (str(tmp_path / "out"),)
    ours = transport(ray, Limits(1))
    ours.start(0)
    while not ours.places():
        ours.receive(0.0)
    ours.kill(0)
    assert ours.last_words(0) == "the licence has expired"
    assert ours.last_words(0) == "", "it is told once"


def test_seconds_of_processors_are_those_of_the_driver_and_of_all_actors_lost_ones_too():
    ray = PretendedRay()
    with ray_engine(ray, Limits(2)) as engine:
        while not all(actor.ran for actor in ray.actors):
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
        ray.end(ray.actors[0])
        engine.evaluate(with_subject(FIRST, [CHUNK]))
        used = 10.0 * sum(actor.ran for actor in ray.actors)
        assert ray.actors[0].ran > 0
        assert engine.transport.cpu_s() - time.process_time() == pytest.approx(used, abs=1.0)


def test_an_actor_that_waited_for_its_place_says_once_that_it_has_one():
    """And not again, when it is asked later whether it is still there."""
    ray = PretendedRay(room=0)
    actors = transport(ray, Limits(2))
    actors.start(0)
    assert (actors.receive(0.0), actors.silent()) == (None, (0,))
    (actor,) = ray.actors
    actor.owed[0].is_ready = True
    assert [actors.receive(0.0) for _ in range(2)] == [Placed(0), None]
    assert actors.silent() == ()
    ray.end(actor, "alive")
    assert [actors.receive(0.0) for _ in range(2)] == [WorkerUp(0), None]
    ray.room = 2
    actors.start(1)
    assert [actors.receive(0.0) for _ in range(3)] == [Placed(1), WorkerUp(1), None]
    ray.end(ray.actors[1])
    for worker in (1, 0):
        actors.send(worker, "key", 1, with_subject(FIRST, [CHUNK]))
    assert isinstance(actors.receive(0.0), WorkerLost)
    actors.send(0, "other key", 1, with_subject(FIRST, [CHUNK]))
    assert [type(actors.receive(0.0)) for _ in range(4)] == [Compiled, Answer, Answer, type(None)]


def test_an_actor_that_is_given_no_place_is_not_lost():
    """Of three there is room for two. One of those hangs, long enough for the third to be started anew many times."""
    ray, limits = PretendedRay(room=2), Limits(3, start_timeout_s=0.02, chunk_timeout_s=0.3, first_chunk_timeout_s=0.3)

    def hang(actor: Actor) -> None:
        ray.end(actor, "hung")
        ray.on_run = lambda actor: None

    with ray_engine(ray, limits) as engine:
        ray.on_run = hang
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert len(ray.actors) > 8
        assert engine.counts.lost_workers == 1
        assert "no answer to work item" in engine.last_loss()


@pytest.mark.parametrize(
    ("watch", "rooms", "advice"),
    [
        (None, {}, "do not start"),
        (PretendedWatch(), {}, "No node has 1 CPU"),
        (PretendedWatch(), {"n": 2}, "or add nodes"),
    ],
)
def test_a_run_that_got_no_place_says_what_it_needs_and_what_there_is(watch, rooms, advice):
    """In a Ray of our own, there is room for each worker, so more nodes would not help."""
    if watch is not None:
        watch.now = Membership(rooms, {}, frozenset(), frozenset({"head", *rooms}))
    ray, limits = PretendedRay(0), Limits(2, start_timeout_s=0.1, place_timeout_s=0.25)
    text = (
        r"no worker got a place for 0\.25 s \(compute.place_timeout_s\).* Each worker needs 1 CPU; .*has 2 CPU.*"
        + advice
    )
    with ray_engine(ray, limits, watch) as engine, pytest.raises(EvaluationError, match=text):
        engine.wait_for_place()
    assert {actor.state for actor in ray.actors} == {"dead"}, "none still asks for a place"


def test_the_wait_for_a_first_place_is_told_of_twice_and_can_be_stopped(monkeypatch):
    """When it has lasted for a while, and when it is over; work that is given meanwhile waits, too."""
    monkeypatch.setattr(waits, "NOTICE_S", 0.0)
    ray, told, calls = PretendedRay(room=0), [], []

    def should_stop() -> int | None:
        calls.append(len(ray.actors))
        if told and "add nodes" in told[-1] and len(calls) > 3:
            ray.room = 2
            ray.end(ray.actors[-1], "alive")
        return None

    watch = PretendedWatch()
    watch.now = Membership({"node": 2}, {}, frozenset(), frozenset({"node"}))
    limits = Limits(2, start_timeout_s=0.2)
    with Engine(transport(ray, limits, watch), limits, should_stop, on_wait=told.append) as engine:
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        engine.wait_for_place()
        assert len(told) == 2
        assert told[0].startswith("Each worker needs 1 CPU; the cluster has 2 CPU")
        assert told[1] == ""
    engine = Engine(transport(PretendedRay(room=0), limits), limits, lambda: 2)
    with engine, pytest.raises(Interrupted):
        engine.wait_for_place()


def test_workers_of_several_cores_are_placed_one_by_one_where_there_is_most_room():
    """Those for which no node has room, and those of one core, are left to Ray."""
    assert emptiest({"small": 1, "large": 3}, ["large", "large", "large"]) == "small"
    assert emptiest({"small": 1, "large": 3}, ["large", "large", "large", "small"]) is None
    assert emptiest({}, ["gone"]) is None
    ray, watch = PretendedRay(room=2), PretendedWatch()
    watch.now = Membership({"small": 2, "large": 9}, {"small": 1, "large": 3}, frozenset(), frozenset())
    actors = transport(ray, Limits(4), watch, claim=Claim(8))
    for worker in range(5):
        actors.start(worker)
    while actors.receive(0.0):
        pass
    watch.now = replace(watch.now, free={"small": 1, "large": 2})  # since two have their places
    actors.start(5)
    actors.kill(2)
    actors.start(6)
    assert [strategy if strategy == "SPREAD" else strategy[0] for strategy in ray.strategies] == [
        *["large", "large", "small", "large", "SPREAD"], "large", "small"
    ]  # fmt: skip
    assert ray.strategies[0][1] == {"soft": True, "_spill_on_unavailable": True}
    one_core = PretendedRay()
    transport(one_core, Limits(1), watch).start(0)
    assert one_core.strategies == ["SPREAD"]


def test_work_is_divided_among_the_workers_that_have_a_place():
    """Not among those that wait for one, perhaps for ever: then there would be more and smaller messages."""
    ray, limits = PretendedRay(room=2), Limits(9, item_s=60.0)
    with ray_engine(ray, limits) as engine:
        chunks = [TrainingChunk(2, chunk) for chunk in range(18)]
        for _ in range(3):  # so that it is known how long a chunk takes
            ray.calls.clear()
            engine.evaluate(with_subject(FIRST, chunks))
        assert len(ray.calls) == 2


def test_a_run_asks_for_more_workers_than_there_is_room_for_up_to_its_work():
    """Whatever becomes of the nodes; an answer without any node is no information."""

    def nodes(room: int) -> Membership:
        return Membership({"node": room} if room else {}, {}, frozenset(), frozenset({"head"}))

    asks, follows = Growth(10, ahead=4), Growth(10)
    assert [asks.wanted(nodes(room), 7) for room in (0, 3, 8, 99)] == [4, 7, 10, 10]
    assert [follows.wanted(nodes(room), 7) for room in (0, 3, 8, 99)] == [7, 3, 8, 10]
    assert asks.wanted(Membership({}, {}, frozenset(), frozenset()), 7) == 7


def test_an_actor_compiles_once_for_each_kind_and_nothing_else_is_asked_of_it():
    """Also while several items are sent ahead. If compiling fails, it is asked again with the next item."""
    ray = PretendedRay()
    with ray_engine(ray, Limits(2)) as engine:
        for _ in range(3):
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
            engine.evaluate(with_subject(FIRST, [EvaluationChunk(2, chunk) for chunk in range(20)]))
        kinds = ("EvaluationChunk", "TrainingChunk")
        assert sorted(ray.compiled) == [(actor, kind) for actor in (0, 1) for kind in kinds]
        calls = [len(actor.owed) for actor in ray.actors]
        assert sum(calls) == 2 * (2 + len(kinds)) + len(ray.calls), "place and build, compile, run"
    actors = transport(ray := PretendedRay(), Limits(1))
    actors.start(0)
    actors.send(0, "a", 1, with_subject(FIRST, [CHUNK]))
    actors.send(0, "b", 1, with_subject(FIRST, [CHUNK]))
    for call in (2, 3):
        ray.actors[0].owed[call].error = RayTaskError("no")
    told = [type(actors.receive(0.0)) for _ in range(5)]
    assert told == [Placed, WorkerUp, Failure, Answer, type(None)]
    actors.send(0, "a", 2, with_subject(FIRST, [CHUNK]))
    assert [type(actors.receive(0.0)) for _ in range(3)] == [Compiled, Answer, type(None)]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("run", b"no pickle"),
        ("run", pickle.dumps(object())),
        ("run", b"cno_such_module\nno_such_name\n."),
        ("place", ("host", 1)),
        ("compile", "soon"),
    ],
)
def test_a_message_that_cannot_be_read_is_the_loss_of_its_worker(call, message):
    ray, calls = PretendedRay(), ("place", "build", "compile", "run")
    actors = transport(ray, Limits(1))
    actors.start(0)
    actors.send(0, "key", 1, with_subject(FIRST, [CHUNK]))
    ray.actors[0].owed[calls.index(call)].value = message
    told = [actors.receive(0.0) for _ in range(calls.index(call) + 2)]
    lost = told[-2]
    assert isinstance(lost, WorkerLost)
    assert "its message cannot be read: " in lost.reason
    assert lost.charge_item == (call in ("compile", "run"))
    assert told[-1] is None
    assert ray.actors[0].state == "dead"


def test_a_message_that_is_damaged_once_costs_one_attempt():
    ray, limits = PretendedRay(), Limits(1, restart_backoff_s=0.0)

    def damage(actor: Actor) -> None:
        actor.owed[-1].value = b"no pickle"
        ray.on_run = lambda actor: None

    ray.on_run = damage
    with ray_engine(ray, limits) as engine:
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert engine.counts.lost_workers == 1


def test_no_actor_is_killed_through_a_head_that_does_not_answer():
    """Ray would wait for it, and end this process after a minute."""
    ray, limits = PretendedRay(), Limits(2)
    with ray_engine(ray, limits) as engine:
        engine.evaluate(with_subject(FIRST, [CHUNK]))

        def check_alive(nodes: list[bytes], timeout: float) -> None:
            raise ActorDiedError("timed out while waiting for GCS")

        client = SimpleNamespace(check_alive=check_alive)
        ray._private.worker = SimpleNamespace(global_worker=SimpleNamespace(gcs_client=client))
    assert [actor.state for actor in ray.actors] == ["alive", "alive"]


@pytest.mark.parametrize(
    ("free", "advice"),
    [
        ({"node": 1}, "There is room, so the processes of the workers are still starting"),
        ({"node": 0}, "If no other program uses it, the processes of the workers are still starting; otherwise"),
    ],
)
def test_a_wait_for_processes_that_start_is_not_taken_for_a_full_cluster(free, advice):
    ray, watch, limits = PretendedRay(), PretendedWatch(), Limits(2)
    watch.now = Membership({"node": 2}, free, frozenset(), frozenset({"node"}))
    with Engine(actors := transport(ray, limits, watch), limits):
        assert actors.shortage().partition(" free. ")[2].startswith(advice)


@pytest.mark.parametrize("grows", [False, True])
def test_a_node_that_refuses_is_told_of_once_and_gets_no_other_worker(grows):
    """The run goes on with the others, and the refusal is no fault."""
    ray, watch, told = PretendedRay(room=4), PretendedWatch(), []
    ray.refusing = {"bad"}
    ray.node_of = lambda number: "good" if ray.selectors[number] or number % 2 else "bad"
    watch.now = Membership({"good": 2, "bad": 2}, {"good": 2, "bad": 2}, frozenset(), frozenset({"good", "bad"}))
    limits = Limits(4 if grows else 6, start_timeout_s=1000.0)
    actors = transport(ray, limits, watch, Growth(4) if grows else None, on_refusal=told.append)
    with Engine(actors, limits) as engine:
        for _ in range(5):
            chunks = [TrainingChunk(2, chunk) for chunk in range(20)]
            assert engine.evaluate(with_subject(FIRST, chunks)) == [f"of {chunk}" for chunk in chunks]
        assert told == ["bad has other code: a.py"]
        assert engine.counts.lost_workers == 0
        assert [ray.node_of(actor.number) for actor in ray.actors].count("bad") == (2 if grows else 3)
        assert ray.selectors[: limits.workers] == [None] * limits.workers
        later = ray.selectors[limits.workers :]
        assert len(later) <= 3
        assert all(selector == {"ray.io/node-id": "!in(bad)"} for selector in later)
        assert engine.counts.workers == (2 if grows else 6)
        assert "bad has other code" in actors.shortage()


@pytest.mark.parametrize("watched", [False, True])
def test_a_run_ends_at_once_if_every_node_refuses_but_not_before_its_last_worker_is_gone(watched):
    """A worker that is up goes on when the code of its host changes; the driver's own Ray has one host."""
    ray, watch = PretendedRay(), PretendedWatch() if watched else None
    if watch is not None:
        watch.now = Membership({"bad": 2, "head": 0}, {}, frozenset(), frozenset({"bad", "head"}))
    ray.node_of = lambda number: "bad"
    with Engine(transport(ray, Limits(2), watch), Limits(2, restart_backoff_s=0.0)) as engine:
        while not all(actor.ran for actor in ray.actors):
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
        ray.refusing = {"bad"}
        ray.end(ray.actors[1])
        for _ in range(3):
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
        ray.end(ray.actors[0])
        for actor in ray.actors[2:]:
            ray.end(actor)
        with pytest.raises(EvaluationError, match="bad has other code"):
            engine.evaluate(with_subject(FIRST, [CHUNK]))
    ray = PretendedRay()
    ray.node_of, ray.refusing = (lambda number: "bad"), {"bad"}
    with Engine(transport(ray, Limits(2), watch), Limits(2)) as engine:
        with pytest.raises(EvaluationError, match="bad has other code"):
            engine.evaluate(with_subject(FIRST, [CHUNK]))
        assert all(ray.selectors[2:]), "none of those that replace the first two could get a place there"


def test_a_node_that_dies_under_idle_workers_takes_none_of_the_others_along():
    """The newest are on the node that stays. The smaller room is known before any call fails; nor is a node dead that
    was not seen yet, or when no node at all is seen."""
    ray, watch = PretendedRay(), PretendedWatch()
    ray.node_of = lambda number: "old" if number < 2 else "new"
    actors = transport(ray, Limits(4), watch, Growth(4))
    with Engine(actors, Limits(4)) as engine:
        for alive in ({"old"}, {"old", "new"}, set(), {"old", "new"}):
            watch.now = Membership({"old": 2, "new": 2}, {}, frozenset(), frozenset(alive))
            engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
            assert engine.counts.lost_workers == 0
        for number in range(2):
            ray.end(ray.actors[number])
        watch.now = Membership({"new": 2}, {}, frozenset(), frozenset({"new"}))
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert (engine.counts.lost_workers, engine.counts.workers, engine.counts.retries) == (2, 2, 0)
        assert "its node died" in engine.last_loss()
        assert [actor.state for actor in ray.actors[:4]] == ["dead", "dead", "alive", "alive"]


def test_nodes_that_are_about_to_go_are_alive_and_give_no_room():
    nodes = [
        {"NodeID": name, "Alive": name != "dead", "Resources": {"CPU": float(cpus)}}
        for name, cpus in (("stays", 4), ("leaves", 2), ("dead", 1))
    ]
    state = SimpleNamespace(get_draining_nodes=lambda: {"leaves": 0})
    unused = {"stays": {"CPU": 3.0}, "leaves": {"CPU": 2.0}}
    private = SimpleNamespace(state=SimpleNamespace(state=state, available_resources_per_node=lambda: unused))
    ray = SimpleNamespace(nodes=lambda: nodes, _private=private)
    seen = read_membership(ray, ONE_CORE)
    assert seen == Membership({"stays": 4}, {"stays": 3}, frozenset({"leaves"}), frozenset({"stays", "leaves"}))


def test_what_changed_in_a_cluster_is_told_in_the_order_that_keeps_workers():
    """Those that leave with their node's consent, then those lost with theirs, then how many there should be."""
    ray, watch = PretendedRay(), PretendedWatch()
    ray.node_of = str
    actors = transport(ray, Limits(3), watch, Growth(3))
    watch.now = Membership({"0": 1, "1": 1, "2": 1}, {}, frozenset(), frozenset("012"))
    for worker in range(3):
        actors.start(worker)
    while actors.receive(0.0):
        pass
    actors.send(0, "key", 1, with_subject(FIRST, [CHUNK]))
    watch.now = Membership({"2": 1}, {}, frozenset("1"), frozenset("12"))
    told = [actors.receive(0.0) for _ in range(4)]
    assert told[0] == Drain(1)
    assert isinstance(told[1], WorkerLost)
    assert (told[1].worker, told[1].charge_item) == (0, True)
    assert told[2:] == [SetWorkers(1), None]
    watch.now = Membership({"2": 7}, {}, frozenset("1"), frozenset("12"))
    assert [actors.receive(0.0) for _ in range(2)] == [SetWorkers(3), None], "no more than there is work for"


@pytest.mark.parametrize("error", [RayTaskError, ActorDiedError])
@pytest.mark.parametrize("call", [0, 1, 3])
def test_what_is_said_of_an_error_has_no_colours(error, call):
    """Neither of one in a place, a build or a run; it is for logs, too."""
    ray = PretendedRay()
    actors = transport(ray, Limits(1))
    actors.start(0)
    actors.send(0, "key", 1, with_subject(FIRST, [CHUNK]))
    ray.actors[0].owed[call].error = error("\x1b[36mray::worker-0\x1b[39m: \x1b[1;31mno\x1b[0m")
    told = [actors.receive(0.0) for _ in range(4)]
    said = [message.reason for message in told if isinstance(message, WorkerLost)]
    said += [message.message for message in told if isinstance(message, Failure)]
    assert len(said) == 1
    assert said[0].endswith("ray::worker-0: no")


def test_a_chunk_that_kills_its_workers_is_found_out_after_as_many_as_it_has_attempts():
    """Although all the others were asked whether they are still there: they are."""
    ray = PretendedRay()
    with ray_engine(ray, Limits(9)) as engine:
        engine.evaluate(with_subject(FIRST, [TrainingChunk(2, chunk) for chunk in range(20)]))
        ray.on_run = ray.end
        with pytest.raises(EvaluationError, match="TrainingChunk 0 of generation 3 failed in 4 attempts"):
            engine.evaluate(with_subject(FIRST, [CHUNK]))
        assert engine.counts.lost_workers == 4


@pytest.mark.parametrize("size", [LEAST_BYTES // 4, IN_CALL_BYTES // 4 + 1])
def test_a_centre_is_sent_once_to_an_actor_and_a_large_one_is_stored_once_while_it_is_new(size, monkeypatch):
    monkeypatch.setattr(ray_calls, "SENDER_BYTES", 3 * 4 * size)
    ray, points = PretendedRay(), [centre(np.full(size, number, np.float32)) for number in range(5)]

    def evaluate(*numbers: int) -> tuple[int, int]:
        """Evaluates chunks of these centres; returns how many arrays were sent and how many stored for that."""
        work = [(points[number], TrainingChunk(3, number, position)) for position, number in enumerate(numbers)]
        stored = len(ray.stored)
        ray.calls.clear()
        assert engine.evaluate(work) == [f"of {chunk}" for _, chunk in work]
        sent = [len(large) + len(pickle.loads(item)[0]) for item, *large in ray.calls]
        return sum(sent), len(ray.stored) - stored

    with ray_engine(ray, Limits(1, item_s=60.0)) as engine:
        found = [evaluate(*numbers) for numbers in ([0], [0], [0, 1, 1, 0], [1, 2], [0], [3], [0], [4, 1])]
    sent = [1, 0, 1, 1, 1, 1, 1, 2]  # a centre that an item does not need is sent with a later one again
    stored = [1, 0, 1, 1, 0, 1, 0, 2] if size > IN_CALL_BYTES // 4 else [0] * 8
    assert found == [*zip(sent, stored, strict=True)]


def test_an_actor_is_asked_how_far_it_is_with_a_call_that_takes_long():
    """At each look but the first of a call. Its answer counts if it has changed and the call is still the oldest."""
    ray = PretendedRay()
    reports = []
    looks, first, second = Looks(ray, lambda *report: reports.append(report)), Ref(), Ref()
    handle = ray.remote()(type(None)).options("SPREAD").remote(b"", 0, 0.0, 1)

    def look(call: Ref, moves: int) -> list[Progress]:
        ray.actors[0].seen = moves, "making", moves, 9
        return looks.look({0: call}, {0: handle})

    assert [look(first, 1), look(first, 2), look(first, 3)] == [[], [], []], "begun, asked, answered once"
    assert look(first, 3) == [Progress(0, "making", 3, 9)]
    assert [look(first, 3), look(first, 4)] == [[], []], "it hangs, and goes on"
    assert look(first, 4) == [Progress(0, "making", 4, 9)]
    assert [look(second, 5), look(second, 6), look(second, 7)] == [[], [], []], "an answer to the call before is none"
    assert look(second, 7) == [Progress(0, "making", 7, 9)]
    assert looks.look({}, {}) == [], "it has been killed"
    assert not reports
    ray.actors[0].report = Report("a line", "")
    for _ in range(3):
        look(first, 8)
    assert reports == [(0, Report("a line", ""))]


def test_an_actor_that_says_that_it_is_spent_is_drained_once_and_replaced_which_is_no_fault():
    ray, told = PretendedRay(), []
    engine = ray_engine(ray, Limits(1))
    engine.transport._on_report = lambda *report: told.append(report)
    with engine:
        engine.evaluate(with_subject(FIRST, [CHUNK]))
        ray.actors[0].report = Report("a line", "it leaks")
        for _ in range(3):
            assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert [actor.state for actor in ray.actors] == ["dead", "alive"]
        assert engine.counts.lost_workers == engine.counts.retries == 0
    assert {*told} == {("worker 0 on host (pid 0)", Report("a line", "it leaks"))}


@pytest.mark.slow
def test_a_call_that_takes_long_is_not_taken_for_one_that_hangs(monkeypatch):
    """Until it shows no more progress, with more than three times its time."""
    monkeypatch.setattr(ray_engine_module, "LOOK_S", 0.02)
    ray, began = PretendedRay(), []
    limits = Limits(1, chunk_timeout_s=0.6, first_chunk_timeout_s=0.6, restart_backoff_s=0.01)

    def flies(actor: Actor) -> None:
        actor.state = "busy"
        ray.on_run = lambda actor: began.append(time.monotonic())
        began.append(time.monotonic())

    def moves() -> None:
        if began and time.monotonic() - began[0] < 2.0:
            ray.actors[0].seen = time.monotonic(), "", 0, 0

    ray.on_run = flies
    with Engine(transport(ray, limits), limits, moves) as engine:
        assert engine.evaluate(with_subject(FIRST, [CHUNK])) == [f"of {CHUNK}"]
        assert "no progress with work item TrainingChunk 0 of generation 3 for 0.6 s" in engine.last_loss()
    assert 2.2 < began[1] - began[0] < 8.0


@pytest.fixture
def stays(monkeypatch):
    """A Ray that `connect` gives, and the list of the connections that were made to it."""
    ray, made = PretendedRay(), []

    def connect(address, *, gpus, cpus):
        if (waiting := staying().take(ray_cluster.RAY)) is not None:
            waiting.end()
        assert not (made and ray.is_initialized()), "Ray allows one connection at a time"
        ray.job = len(made) + 1
        made.append(address)
        return ray

    monkeypatch.setattr(ray_cluster, "connect", connect)
    monkeypatch.setattr(ray_cluster, "ask_head", lambda ray: None)
    monkeypatch.setattr(ray_cluster, "ANSWER_S", 0.1)
    yield ray, made
    assert not staying()._idle
    assert {actor.state for actor in ray.actors} <= {"dead"}
    assert not ray.is_initialized()


def compute(address: str | None = None, given: Any = SPEC, claim: Claim = ONE_CORE, alone: bool = False) -> None:
    """What one engine with two workers does: one of its actors computes, and both are up."""
    connection = ray_cluster.connected(address, gpus=False, cpus=2)
    actors = Actors(connection, given, type(None), claim, None, None, 2, alone=alone)
    with Engine(actors, Limits(2)) as engine:
        while len(actors._up) < 2:
            assert len(engine.evaluate(with_subject(FIRST, [CHUNK]))) == 1
        assert engine.counts.lost_workers == 0


def numbers(ray: PretendedRay, *states: str) -> list[int]:
    return [place for place, actor in enumerate(ray.actors) if actor.state in states]


def test_actors_stay_in_a_block_and_end_with_it(stays):
    ray, made = stays
    compute()
    assert (numbers(ray, "dead"), ray.is_initialized()) == ([0, 1], False)
    with workers():
        compute()
        assert (numbers(ray, "alive"), ray.is_initialized()) == ([2, 3], True)
        compute(given=replace(SPEC, seed=9, environment="another"))
    assert (len(ray.actors), len(made)) == (4, 2)


@pytest.mark.parametrize("state", ["dead", "hung"])
def test_an_actor_that_dies_or_hangs_between_two_runs_is_replaced_without_a_word(stays, state):
    ray, made = stays
    with workers():
        compute()
        ray.end(ray.actors[0], state)
        compute()
        assert (numbers(ray, "alive"), ray.actors[0].state) == ([1, 2], "dead")
    assert len(made) == 1


def test_actors_serve_only_runs_of_their_kind(stays):
    """Those of another kind end, since they have the cores that the run needs."""
    ray, made = stays
    other_code = replace(SPEC, sources={**SPEC.sources, "a.py": "0"})
    with workers():
        compute()
        for count, given in enumerate(
            [
                {"given": other_code},
                {"given": other_code, "claim": Claim(2)},
                {"alone": True},
                {"alone": True, "given": replace(SPEC, episode_steps=SPEC.episode_steps + 1)},
            ],
            start=1,
        ):
            compute(**given)
            assert numbers(ray, "alive") == [2 * count, 2 * count + 1]
            compute(**given | {"given": replace(given.get("given", SPEC), seed=count)})
            assert len(ray.actors) == 2 * count + 2
    assert len(made) == 1


def test_a_connection_serves_only_runs_of_the_same_cluster_and_environment(stays, monkeypatch, tmp_path):
    ray, made = stays
    with workers():
        compute()
        compute("head:6379")
        monkeypatch.setenv("SIMULATOR_LICENCE", "7")
        compute("head:6379")
        monkeypatch.chdir(tmp_path)
        compute("head:6379")
        compute("head:6379")
        monkeypatch.setattr(ray_cluster, "ask_head", lambda ray: 1 / (ray.job - 4))  # the head of the fourth is gone
        compute("head:6379")
    assert (made, len(ray.actors)) == ([None, *["head:6379"] * 4], 10)


def test_after_a_shutdown_by_the_user_nothing_of_it_is_used_and_nothing_of_the_user_s_is_ended(stays):
    ray, made = stays
    with workers():
        compute()
        for actor in ray.actors:
            ray.end(actor)
        ray.shutdown()
        ray.job = 7  # the user's own
        with workers():
            pass
    assert ray.is_initialized()
    ray.shutdown()
    with workers():
        compute()
        ray.shutdown()
        for actor in ray.actors:
            ray.end(actor)
        compute()
        assert numbers(ray, "alive") == [4, 5]
    assert len(made) == 3


def test_an_error_inside_a_block_and_one_of_a_run_end_the_actors(stays):
    ray, _ = stays

    @workers()
    def raises() -> None:
        compute()
        assert numbers(ray, "alive") == [0, 1]
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        raises()
    assert numbers(ray, "alive") == []
    with workers():
        ray.on_run = lambda actor: ray.end(actor, "hung")
        with ray_engine_of(ray) as engine, pytest.raises(EvaluationError):
            engine.evaluate(with_subject(FIRST, [CHUNK]))
        assert all(ray.actors[place].ran == 0 for place in numbers(ray, "alive")), "what computes does not stay"
        ray.on_run = lambda actor: None
        compute()


def ray_engine_of(ray: PretendedRay) -> Engine[Actors]:
    connection = ray_cluster.connected(None, gpus=False, cpus=2)
    limits = Limits(2, max_attempts=1, chunk_timeout_s=0.05, first_chunk_timeout_s=0.05)
    return Engine(Actors(connection, SPEC, type(None), ONE_CORE, None, None, 2), limits)


def test_a_cluster_that_does_not_answer_while_it_waits_is_left(stays, monkeypatch):
    ray, _ = stays
    monkeypatch.setattr(ray_cluster, "MEMBERSHIP_S", 0.01)
    monkeypatch.setattr(ray_cluster, "SILENCE_S", 0.05)
    with workers():
        compute("head:6379")
        monkeypatch.setattr(ray_cluster, "ask_head", lambda ray: 1 / 0)
        until = time.monotonic() + 10.0
        while staying()._idle and time.monotonic() < until:
            time.sleep(0.01)
        assert (ray.is_initialized(), numbers(ray, "alive")) == (False, [])
