"""What does a generation of policies cost the driver? MAP-Elites on PointMaze with made-up episodes, by item.

    python -m tests.benchmarks.policies_time                # a minute, one core
    python -m tests.benchmarks.policies_time --bytes --task ant_trap --hidden 256 256 --batch 256

Milliseconds of the processor in the driver's process, all its threads together, so other programs disturb them little;
medians over the generations after the first 50, in which the map fills. Messages to workers and rollouts are left out.
The digest at the end of a line shows whether two versions have computed the same. With `--bytes`, the numbers are
instead the kilobytes that two workers, which take turns, are sent in a generation: the median after the first 50.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from es_service import api
from es_service.config.model import policy_spec
from es_service.config.tasks import task_of
from es_service.loop import driver
from es_service.loop.history import evaluated_columns, history_columns
from es_service.protocol.evaluator import DispatchCounts
from es_service.protocol.kept_parents import KeptParents, as_sent, parents_to_send
from es_service.protocol.messages import EpisodesResult, Work
from es_service.protocol.policies import PolicyChunk, slots
from es_service.protocol.wire import framed
from es_service.search.algorithms import ALGORITHMS
from es_service.search.observation_statistics import no_observations
from es_service.store.digest import checked_parts, digest_of
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore

FILLING = 50
ITEMS = ("propose", "evaluate", "update", "finish", "rows", "commit")


class Inventing:
    """Answers every chunk at once: policies end anywhere, and are seldom better than the elites."""

    counts = DispatchCounts()

    def __init__(self, *, counting: bool) -> None:
        self._rng = np.random.default_rng(0)
        self._workers = [KeptParents(2**28, int) for _ in range(2)] if counting else []
        self.sent_bytes: list[int] = []

    def evaluate(self, work):
        if self._workers and work:
            parts = [work[number :: len(self._workers)] for number in range(len(self._workers))]
            self.sent_bytes.append(sum(map(_bytes_of, parts, self._workers)))
        return [self._answer(*one) for one in work]

    def _answer(self, subject, chunk):
        slots_L = len(slots(subject, chunk)[0]) if isinstance(chunk, PolicyChunk) else chunk.episodes
        fitness = self._rng.normal(size=slots_L).astype(np.float32)
        place = self._rng.uniform(-1.0, 1.0, (slots_L, 2)).astype(np.float32)
        trace = np.zeros((*([slots_L] if isinstance(chunk, PolicyChunk) else []), 64, 2), np.float32)
        return EpisodesResult(fitness, fitness, place, np.full(slots_L, 200, np.int32), place, None, trace)


def _bytes_of(work: Sequence[Work], kept: KeptParents[int]) -> int:
    """Bytes of a work item's messages to a worker, as the engine inline sends them."""
    parents = [framed(("parents", {name: given})) for name, given in parents_to_send(work, kept).items()]
    subjects = {id(subject): framed(("subject", 0, as_sent(subject))) for subject, _ in work}
    chunks = framed(("chunks", 0, 1, [(number, chunk) for number, (_, chunk) in enumerate(work)]))
    return sum(map(len, [*parents, *subjects.values(), chunks]))


def timed(function: Callable[..., Any], spent: dict[str, float], name: str) -> Callable[..., Any]:
    """The function, whose time on the processor is added to `spent`, without that of others of these in it."""

    def run(*arguments: Any) -> Any:
        inside, started = sum(spent.values()), time.process_time()
        result = function(*arguments)
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
    meta = RunMeta("benchmark", "", config.model_dump(mode="json"), config.constants(), asdict(task), *columns)
    spent: dict[str, float] = {}
    rows: list[dict[str, float]] = []

    def note(row: Any) -> None:
        rows.append(dict(spent))

    evaluator = Inventing(counting=given.bytes)
    kept = {name: getattr(driver, name) for name in ITEMS[:-1]}
    try:
        for name, function in kept.items():
            setattr(driver, name, timed(function, spent, name))
        with RunStore.create(place, config.resolved_yaml(), meta) as store:
            store.commit = timed(store.commit, spent, "commit")
            driver.run(search, evaluator, store, None, note)
    finally:
        for name, function in kept.items():
            setattr(driver, name, function)
    if given.bytes:
        sent = round(float(np.median(evaluator.sent_bytes[1 + FILLING :])) / 1e3, 1)
        return {"batch": batch, "kB": sent, "digest": digest_of(checked_parts(place)[0])[:12]}
    ms = {name: 1e3 * np.diff([row.get(name, 0.0) for row in rows])[FILLING - 1 :] for name in ITEMS}
    found = {name: round(float(np.median(values)), 2) for name, values in ms.items()}
    whole = round(float(np.median(np.sum(list(ms.values()), axis=0))), 2)
    return {"batch": batch, **found, "whole": whole, "digest": digest_of(checked_parts(place)[0])[:12]}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", nargs="+", type=int, default=[64, 256, 1024])
    parser.add_argument("--generations", type=int, default=150)
    parser.add_argument("--bytes", action="store_true")
    parser.add_argument("--task", default="point_maze")
    parser.add_argument("--hidden", nargs="*", type=int, default=[64, 64])
    arguments = parser.parse_args()
    for batch in arguments.batch:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(batch, arguments.generations, Path(folder) / "run", arguments)), flush=True)


if __name__ == "__main__":
    main()
