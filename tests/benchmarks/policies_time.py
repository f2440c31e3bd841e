"""What does a generation of policies cost the driver and its workers? MAP-Elites on PointMaze, by item.

    python -m tests.benchmarks.policies_time                # the driver, with made-up episodes: a minute, one core
    python -m tests.benchmarks.policies_time --workers      # messages and workers, with real episodes
    python -m tests.benchmarks.policies_time --bytes --task ant_trap --hidden 256 256 --batch 256

Milliseconds of the processor in this process, all its threads together, so other programs disturb them little; medians
over the generations after the first 50, in which the map fills. The digest at the end of a line shows whether two
versions have computed the same. With `--workers`, two workers in this process take turns, and the items are of both
together: messages are made and read as the engine inline does. With `--bytes`, the numbers are instead the kilobytes
that two workers are sent in a generation.
"""

from __future__ import annotations

import argparse
import json
import pickle
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from es_service import api
from es_service.config.tasks import task_of
from es_service.config.workload import policy_spec, worker_spec
from es_service.loop import driver
from es_service.loop.history import evaluated_columns, history_columns
from es_service.loop.state import no_observations
from es_service.protocol.episodes import DispatchCounts, addressed, together
from es_service.protocol.messages import EpisodesResult, Work, WorkerSpec
from es_service.protocol.policies import POLICIES_TOGETHER, PolicyChunk, slots
from es_service.protocol.sent import Memory, Received, parcel
from es_service.protocol.wire import framed
from es_service.search.algorithms import ALGORITHMS
from es_service.store.digest import checked_parts, digest_of
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from tests.helpers import AtTheEnd
from workers import worker
from workers.compiling import Compilable
from workers.rollouts import BACKENDS

FILLING = 50
ITEMS = ("propose", "policies_asked", "told_of_asks", "tell", "finish", "rows", "commit")
MESSAGES = ("send", "read", "arguments", "function", "results", "rest", "answer", "hear")
"""The driver makes messages; workers read them and make new parents, prepare their kernel, make policies and roll them
out, prepare the results, and do the rest; they answer, and the driver reads that."""


class Inventing(AtTheEnd):
    """Answers every chunk at once: policies end anywhere, and are seldom better than the elites."""

    counts = DispatchCounts()

    def __init__(self, *, counting: bool) -> None:
        self._rng = np.random.default_rng(0)
        self._workers = [Memory(2**28, int) for _ in range(2)] if counting else []
        self.sent_bytes: list[int] = []

    def evaluate(self, work):
        if self._workers and work:
            frames = map(_frames, _halves(work), self._workers)
            self.sent_bytes.append(sum(len(frame) for of_worker in frames for frame in of_worker))
        return [addressed(subject_chunk, self._answer(*subject_chunk)) for subject_chunk in work]

    def _answer(self, subject, chunk):
        slots_L = len(slots(subject, chunk)[0]) if isinstance(chunk, PolicyChunk) else chunk.episodes
        fitness = self._rng.normal(size=slots_L).astype(np.float32)
        place = self._rng.uniform(-1.0, 1.0, (slots_L, 2)).astype(np.float32)
        trace = np.zeros((*([slots_L] if isinstance(chunk, PolicyChunk) else []), 64, 2), np.float32)
        return EpisodesResult(fitness, fitness, place, np.full(slots_L, 200, np.int32), place, None, trace)


class Working(AtTheEnd):
    """Has every chunk run by two workers in this process."""

    counts = DispatchCounts()

    def __init__(self, spec: WorkerSpec, spent: dict[str, float]) -> None:
        self._spent, kinds_of, made = spent, worker.kinds_of, BACKENDS[spec.rollout].made

        def timed_kinds(*given: Any) -> Any:
            kinds = kinds_of(*given)
            function, *others = kinds[PolicyChunk]
            inside = Compilable(timed(function, spent, "function"), function.compile)
            return kinds | {
                PolicyChunk: worker.Kind(inside, *map(timed, others, [spent] * 2, ["arguments", "results"]))
            }

        with patch.object(worker, "kinds_of", timed_kinds):
            self._run = timed(worker.make_worker(spec), spent, "rest")
        self._workers = [(Memory(2**28, int), Received(2**28, made)) for _ in range(2)]

    def evaluate(self, work):
        parts = zip(_halves(work), self._workers, strict=True)
        return [result for part, sides in parts if part for result in self._half(part, *sides)]

    def _half(self, work: Sequence[Work], theirs: Memory[int], received: Received) -> list[Any]:
        frames = timed(_frames, self._spent, "send")(work, theirs)
        results = self._run(timed(_read, self._spent, "read")(frames, received))
        answer = timed(framed, self._spent, "answer")(results)
        return timed(lambda frame: pickle.loads(frame[8:]), self._spent, "hear")(answer)


def _halves(work: Sequence[Work]) -> list[Sequence[Work]]:
    middle = -(-len(work) // 2)
    return [work[:middle], work[middle:]]


def _frames(work: Sequence[Work], memory: Memory[int]) -> list[bytes]:
    """A work item's messages to a worker, as the engine inline sends them."""
    arrays, origins, pickled = parcel(together(work, POLICIES_TOGETHER), memory)
    return [*(framed(("arrays", {name: array})) for name, array in arrays.items()), framed(("work", origins, pickled))]


def _read(frames: Sequence[bytes], received: Received) -> list[Work]:
    """The work item of messages, with the parents of its policies."""
    *arrays, (_, origins, pickled) = [pickle.loads(frame[8:]) for frame in frames]
    for _, named in arrays:
        received.add(named)
    return received.work(origins, pickled)


def timed(function: Callable[..., Any], spent: dict[str, float], name: str) -> Callable[..., Any]:
    """The function, whose time on the processor is added to `spent`, without that of others of these in it."""

    def run(*arguments: Any, **named: Any) -> Any:
        inside, started = sum(spent.values()), time.process_time()
        result = function(*arguments, **named)
        inside = sum(spent.values()) - inside
        spent[name] = spent.get(name, 0.0) + time.process_time() - started - inside
        return result

    return run


def measure(batch: int, generations: int, place: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds of each item in a generation, or what is sent."""
    config = api.load_config(
        {
            "task": {"environment": given.task},
            "policy": {"hidden": given.hidden},
            "search": {"algorithm": "map_elites", "batch": batch},
            "budget": {"generations": FILLING + generations},
        }
    )
    task = task_of(config)
    rng = np.random.default_rng(1)
    numbers = policy_spec(config, task).parameters
    centres = [rng.normal(size=numbers).astype(np.float32) for _ in range(config.search.centres)]
    initial = centres, no_observations(task.observation_size)
    search = driver.Search(config, ALGORITHMS["map_elites"](config), lambda: initial, task)
    columns = history_columns(task, True), evaluated_columns(task, True)
    meta = RunMeta(
        f"{0:032x}",
        "2025-01-01T00:00:00+00:00",
        config.model_dump(mode="json"),
        config.constants(),
        asdict(task),
        *columns,
    )
    spent: dict[str, float] = {}
    rows: list[dict[str, float]] = []

    def note(row: Any) -> None:
        rows.append(dict(spent))

    items = MESSAGES if given.workers else ITEMS
    evaluator = Inventing(counting=given.bytes)
    if given.workers:
        evaluator = Working(replace(worker_spec(config, task), rollout="simd"), spent)
    kept = {name: getattr(driver, name) for name in ITEMS[:-1]}
    try:
        for name, function in kept.items():
            setattr(driver, name, timed(function, spent, name))
        with RunStore.create(place, config.resolved_yaml(), meta) as store:
            store.commit = timed(store.commit, spent, "commit")
            driver.drive(driver.run(search, store, None, note), evaluator)
    finally:
        for name, function in kept.items():
            setattr(driver, name, function)
    if given.bytes:
        sent = round(float(np.median(evaluator.sent_bytes[1 + FILLING :])) / 1e3, 1)
        return {"batch": batch, "kB": sent, "digest": digest_of(checked_parts(place)[0])[:12]}
    ms = {name: 1e3 * np.diff([row.get(name, 0.0) for row in rows])[FILLING - 1 :] for name in items}
    medians = {name: round(float(np.median(values)), 2) for name, values in ms.items()}
    whole = round(float(np.median(np.sum(list(ms.values()), axis=0))), 2)
    return {"batch": batch, **medians, "whole": whole, "digest": digest_of(checked_parts(place)[0])[:12]}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", nargs="+", type=int, default=[64, 256, 1024])
    parser.add_argument("--generations", type=int, default=150)
    parser.add_argument("--workers", action="store_true")
    parser.add_argument("--bytes", action="store_true")
    parser.add_argument("--task", default="point_maze")
    parser.add_argument("--hidden", nargs="*", type=int, default=[64, 64])
    arguments = parser.parse_args()
    for batch in arguments.batch:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(batch, arguments.generations, Path(folder) / "run", arguments)), flush=True)


if __name__ == "__main__":
    main()
