"""Small things several tests need: a tiny spec, an evaluator without processes, recordings."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from es_service.dispatch.events import Limits
from es_service.errors import Interrupted
from es_service.loop.blocks import MAP, joined, value_of
from es_service.loop.contents import stored_elite
from es_service.loop.history import NO_INTEGER
from es_service.loop.state import Generation
from es_service.protocol.content import Policy
from es_service.protocol.episodes import DispatchCounts, Wait
from es_service.protocol.messages import Centre, Chunk, ChunkResult, PolicySpec, Work, WorkerSpec
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from workers.rollouts import recorder
from workers.worker import make_worker

SPEC = WorkerSpec(
    seed=3,
    environment="point_maze",
    environment_options={},
    episode_steps=200,
    fitness="sum",
    episodes_per_member=1,
    policy=PolicySpec((2, 8, 8, 2)),
    observation_clip=5.0,
    action_noise=0.01,
    common_random_numbers=True,
    chunk_pairs=8,
    rollout_block_pairs=4,
    gradient_block_pairs=8,
    rollout="xla",
)
PARAMETERS = SPEC.policy.parameters


def spec(**changes: object) -> WorkerSpec:
    return replace(SPEC, **changes)


def centre(parameters_D: np.ndarray, generation: int = 1, sigma: float = 0.1, observation_size: int = 2) -> Centre:
    mean_O, std_O = np.zeros(observation_size, np.float32), np.ones(observation_size, np.float32)
    return Centre(generation, parameters_D.astype(np.float32), sigma, mean_O, std_O)


def random_parameters(seed: int = 0, size: int = PARAMETERS, scale: float = 0.7) -> np.ndarray:
    return (np.random.default_rng(seed).normal(size=size) * scale).astype(np.float32)


def chunk_runner(worker_spec: WorkerSpec) -> Callable[[Centre, Chunk], ChunkResult]:
    """A worker that runs one chunk at a time."""
    run = make_worker(worker_spec)
    return lambda centre, chunk: run([(centre, chunk)])[0]


def policy_with(parameters_D: np.ndarray) -> Policy:
    """A policy with these parameters, for those who look at nothing else."""
    nothing = np.zeros(0, np.float32)
    return Policy(PolicySpec((1, 1)), parameters_D, nothing, nothing)


class AtTheEnd:
    """Begins to compute work when somebody waits for it."""

    def begin(self, work: Sequence[Work]) -> Wait:
        return lambda most_s: self.evaluate(work)

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        raise NotImplementedError


class DirectEvaluator(AtTheEnd):
    """An Evaluator in this process: one worker function, chunks in the order given. Records all it returned."""

    def __init__(self, worker_spec: WorkerSpec) -> None:
        self.run = make_worker(worker_spec)
        self.counts = DispatchCounts(workers=1)
        self.recorded: list[tuple[Centre, Chunk, ChunkResult]] = []

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        results = self.run(work)
        self.recorded += [(centre, chunk, result) for (centre, chunk), result in zip(work, results, strict=True)]
        return results


class WorkerHere(AtTheEnd):
    """An engine whose one worker is the caller."""

    platforms: frozenset[str] = frozenset()

    def __init__(self, run: Callable[[Sequence[Work]], list[ChunkResult]], should_stop: Callable[[], int | None]):
        self.run, self.should_stop = run, should_stop
        self.counts = DispatchCounts(workers=1, rollout_s=0.0, cpu_s=0.0)

    def wait_for_place(self) -> None:
        """Return at once, since the caller is there."""

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        if (number := self.should_stop()) is not None:
            raise Interrupted(number)
        began_s, used_s, before = time.monotonic(), time.process_time(), self.counts
        results = self.run(work)
        rollout_s, cpu_s = before.rollout_s + time.monotonic() - began_s, before.cpu_s + time.process_time() - used_s
        self.counts = replace(before, rollout_s=rollout_s, cpu_s=cpu_s)
        return results

    def close(self) -> None:
        """Leave the caller as it is."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_WORKERS: dict[str, Callable[[Sequence[Work]], list[ChunkResult]]] = {}
"""Workers by what they know, so that runs alike compile nothing twice."""


def worker_here(worker_spec: WorkerSpec) -> Callable[[Sequence[Work]], list[ChunkResult]]:
    """The worker of a spec; those of equal specs are one."""
    key = repr(worker_spec)
    if key not in _WORKERS:
        _WORKERS[key] = make_worker(worker_spec)
    return _WORKERS[key]


def inline_here(
    worker_spec: WorkerSpec, limits: Limits, should_stop: Callable[[], int | None] = lambda: None, **_: object
) -> WorkerHere:
    """In the place of `inline_engine`, for tests of what is done with a run and not of its processes."""
    return WorkerHere(worker_here(worker_spec), should_stop)


@contextmanager
def workers_in_this_process() -> Iterator[None]:
    """Inside the block neither the engine inline nor a recording of episodes starts a process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("es_service.runs.engine.inline_engine", inline_here)
        patch.setattr(
            "es_service.runs.replay.answer_of", lambda _, *given, request, limit_s: recorder(*given)(*request)
        )
        yield


def rows_of(table: Mapping[str, np.ndarray]) -> list[dict]:
    """The rows of a table; None for no value."""
    columns = {
        name: [None if value in (None, NO_INTEGER) or value != value else value for value in values.tolist()]
        for name, values in table.items()
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def map_of(parts: Mapping[str, Mapping[str, np.ndarray]]) -> BehaviourMap:
    """The behaviour map of a state in parts."""
    return value_of(BehaviourMap, joined(parts), MAP)


class MemoryStore:
    """A run store in memory, for driver tests that are not about the store."""

    def __init__(self) -> None:
        self.generation: int | None = None
        self.parts: dict[str, dict[str, np.ndarray]] = {}
        self.contents: dict[bytes, dict[str, np.ndarray]] = {}
        self.rows: list[dict] = []

    def load(self) -> dict[str, dict[str, np.ndarray]]:
        return dict(self.parts)

    def content(self, name: bytes) -> dict[str, np.ndarray]:
        return self.contents[name]

    def elite(self, cell: int, parts: Mapping[str, Mapping[str, np.ndarray]] | None = None) -> Elite:
        """The elite of a filled cell, as it is stored, in the newest state or in that of some parts."""
        map_ = map_of(self.parts if parts is None else parts)
        row = map_.row_of(cell)
        policy, trace = (self.contents[names[row].tobytes()] for names in (map_.policy_N, map_.trace_N))
        return stored_elite(PolicySpec(**json.loads(policy["spec"].tobytes())), policy, trace)

    def newest_history(self, count: int) -> list[dict]:
        return self.rows[-count:]

    def commit(self, generations: Sequence[Generation]) -> None:
        for one in generations:
            self.generation = one.number
            self.contents.update(one.contents)
            self.parts = {name: part for name, part in {**self.parts, **one.parts}.items() if part is not None}
            self.rows.append(dict(one.history))


def stop(pid: int) -> None:
    """Stop a process, and return once each of its threads stands still. Until then, others than the one that receives
    the signal go on, and may answer."""
    os.kill(pid, signal.SIGSTOP)
    states = [Path(f"/proc/{pid}/task/{thread}/stat") for thread in os.listdir(f"/proc/{pid}/task")]
    until = time.monotonic() + 30.0
    while any(state.read_text().rpartition(")")[2].split()[0] != "T" for state in states):
        assert time.monotonic() < until, f"process {pid} does not stop"
        time.sleep(0.01)
