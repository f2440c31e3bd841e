"""What does a full map cost the driver? ME-ES with 10,000 members and 50 x 50 cells, all of them filled by hand.

    python -m tests.benchmarks.map_time                # needs 2 GB of disk for a minute or two

Rollouts are made up, so that what is left is the driver and the store, in one process. In the worst case every
generation's centre enters the map. Medians of 200 generations, or 100 for the ant's policy; without a map beside it.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import resource
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from es_service import api
from es_service.config.tasks import task_of
from es_service.config.workload import policy_spec
from es_service.loop import driver
from es_service.loop.blocks import state_of, stored
from es_service.loop.history import history_columns
from es_service.loop.state import RunState, no_observations
from es_service.protocol.content import Arrays, Policy, name_of, names
from es_service.protocol.episodes import DispatchCounts, addressed
from es_service.protocol.messages import EpisodesResult, GradientChunk, GradientResult, PolicySpec, TrainingChunk
from es_service.search.algorithms import ALGORITHMS
from es_service.search.maps.behaviour_map import columns_of
from es_service.store.create import Beginning
from es_service.store.folder import DATABASE
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from tests.helpers import AtTheEnd, MemoryStore

CELLS = (50, 50)


class Inventing(AtTheEnd):
    """Answers every chunk at once: centres end anywhere and are better each time, so that each enters the map."""

    counts = DispatchCounts()

    def __init__(self, parameters: int, observations: int, bounds: Any, chunk_pairs: int) -> None:
        self._sum_D = np.ones(parameters, np.float32)
        self._none, self._bounds, self._pairs = no_observations(observations), np.array(bounds).T, chunk_pairs
        self._rng, self._centres = np.random.default_rng(0), 0

    def evaluate(self, work):
        place_2 = self._rng.uniform(*self._bounds)
        self._centres += isinstance(work[0][1], GradientChunk)
        return [self._answer(*subject_chunk, place_2) for subject_chunk in work]

    def _answer(self, subject, chunk, place_2):
        if isinstance(chunk, GradientChunk):
            return GradientResult(self._sum_D)
        training = isinstance(chunk, TrainingChunk)
        axes = (self._pairs, 2) if training else (chunk.episodes,)
        fitness = self._rng.normal(size=axes).astype(np.float32) if training else np.full(axes, self._centres, "f4")
        spread = self._rng.normal(size=(*axes, 2)) * (0.1 if training else 0.0)
        descriptor = (place_2 + spread).astype(np.float32)
        trace = None if training else np.zeros((64, 2), np.float32)
        steps = np.full(axes, 200, np.int32)
        result = EpisodesResult(fitness, fitness, descriptor, steps, descriptor, self._none, trace)
        return addressed((subject, chunk), result)


def filled(state: RunState, spec: PolicySpec, contents: dict[bytes, Arrays]) -> RunState:
    """The state of generation 0 with an elite in every cell, whose policies and traces are added to some contents."""
    rng, map_ = np.random.default_rng(1), state.search.map
    assert map_ is not None
    count, size = CELLS[0] * CELLS[1], spec.widths[0]
    rows = np.concatenate([np.arange(map_.size), np.zeros(count - map_.size, np.int64)])
    columns = {name: values[rows] for name, values in columns_of(map_).items()}
    columns["cell_N"] = np.concatenate([map_.cell_N, np.setdiff1d(np.arange(count), map_.cell_N)])
    columns["fitness_N"][map_.size :] = -1e6
    trace = {"trace_T_B": np.zeros((64, 2), np.float32)}
    policies = [
        Policy(spec, *(rng.normal(size=size).astype(np.float32) for size in (spec.parameters, size, size))).content
        for _ in range(count - map_.size)
    ]
    contents |= {name_of(content): content for content in (trace, *policies)}
    columns["policy_N"][map_.size :] = names(map(name_of, policies))
    columns["trace_N"][map_.size :] = names([name_of(trace)] * len(policies))
    return replace(state, search=replace(state.search, map=replace(map_, **columns)))


def prepared(environment: str, hidden: list[int], algorithm: str, generations: int, enabled: bool) -> tuple[Any, ...]:
    """(config, search, invented rollouts) of a case."""
    config = api.load_config(
        {
            "task": {"environment": environment},
            "policy": {"hidden": hidden},
            "search": {"algorithm": algorithm, "pairs": 5000},
            "map": {"cells": CELLS, "enabled": enabled},
            "budget": {"generations": generations},
        }
    )
    task, shape = task_of(config), policy_spec(config, task_of(config))
    initial = [np.zeros(shape.parameters, np.float32)], no_observations(task.observation_size)
    search = driver.Search(config, ALGORITHMS[algorithm](config), lambda: initial, task)
    size = shape.parameters, task.observation_size, task.descriptor_bounds, config.compute.chunk_pairs
    return config, search, Inventing(*size)


def fill(place: Path, *case: Any) -> None:
    """Create the run of a case, after generation 0, its map full."""
    config, search, invented = prepared(*case)
    memory = MemoryStore()
    with contextlib.suppress(_Enough):
        driver.drive(driver.run(search, memory, None, _stop), invented)
    state, contents = state_of(memory.parts, 0, 0.0), dict(memory.contents)
    if config.map.enabled:
        state = filled(state, policy_spec(config, search.task), contents)
    columns = history_columns(search.task, config.map.enabled)
    meta = RunMeta(
        f"{0:032x}",
        "2025-01-01T00:00:00+00:00",
        config.model_dump(mode="json"),
        config.constants(),
        asdict(search.task),
        columns,
    )
    beginning = Beginning(history=[memory.rows[0]], parts=stored(state), contents=contents, newest=0)
    RunStore.create(place, config.resolved_yaml(), meta, beginning).close()


def measure(place: Path, *case: Any) -> dict[str, Any]:
    """Go on with the run of a case, in this process."""
    config, search, invented = prepared(*case)
    rows: list[dict[str, Any]] = []
    sizes: list[int] = []
    started = time.perf_counter()
    with RunStore.open(place) as store:
        opened_s = time.perf_counter() - started
        commit = store.commit

        def measured(generation: int, parts: Any, history: Any, evaluations: Any, contents: Any) -> None:
            changed = [part for part in parts.values() if part is not None]
            sizes.append(sum(array.nbytes for part in (*changed, *contents.values()) for array in part.values()))
            commit(generation, parts, history, evaluations, contents)

        store.commit = measured
        driver.drive(driver.run(search, store, driver.stored_state(store), rows.append), invented)
    driver_ms, store_ms = (
        round(float(np.median([row[f"seconds_{part}"] for row in rows[5:]])) * 1e3, 2) for part in ("driver", "store")
    )
    return {
        "task": config.task.environment,
        "algorithm": config.search.algorithm,
        "map": config.map.enabled,
        "driver_ms": driver_ms,
        "store_ms": store_ms,
        "store_kb_per_generation": round(float(np.median(sizes)) / 1e3),
        "entered_percent": round(100 * np.mean([row["cell"] is not None for row in rows])) if config.map.enabled else 0,
        "open_s": round(opened_s, 2),
        "run_db_mb": round((place / DATABASE).stat().st_size / 1e6),
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


class _Enough(Exception):  # noqa: N818 (ends a loop)
    """Generation 0 is done."""


def _stop(row: object) -> None:
    raise _Enough


def main() -> None:
    context = multiprocessing.get_context("spawn")
    for environment, hidden, generations in (("point_maze", [64, 64], 200), ("ant_maze", [256, 256], 100)):
        for algorithm, enabled in (("es", False), ("es", True), ("me_es", True)):
            case = environment, hidden, algorithm, generations, enabled
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder) / "run"
                for step in (fill, measure):  # each in a process of its own, for its own peak of memory
                    with context.Pool(1) as pool:
                        result = pool.apply(step, (place, *case))
                print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
