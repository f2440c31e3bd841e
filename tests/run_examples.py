"""Run folders of any task and size, written at once with made-up but consistent data: what reports are tested on."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from es_service.config.workload import policy_spec
from es_service.loop.blocks import stored
from es_service.loop.history import evaluated_columns, history_columns
from es_service.loop.state import Best, RunState
from es_service.protocol.content import NAME, Policy, name_of, names
from es_service.protocol.machine import platform_info
from es_service.protocol.messages import Moments, TaskSpec
from es_service.search.algorithms import OURS
from es_service.search.algorithms.base import CentreState, FitnessWeight, SearchState
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.maps.geometry import Cvt, Geometry, Grid, make_geometry
from es_service.search.novelty import archive_of
from es_service.search.steps import fresh_state
from es_service.store.create import Beginning
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from tests.es_service.config_examples import load_config
from workers.environments import SHIPPED
from workers.rollouts import BACKENDS


def write_run(
    folder: Path,
    settings: dict[str, Any] | None = None,
    *,
    task: TaskSpec = SHIPPED["point_maze"],
    generations: int = 20,
    filled: float = 0.5,
    invalid: int = 0,
    parent: dict[str, Any] | None = None,
) -> Path:
    """Write a run of one centre after some generations; every value follows from the arguments and the seed.

    Args:
        settings: dotted config keys.
        filled: share of the map's cells that have an elite.
        invalid: number of invalid members of the newest generation.
        parent: `RunMeta.parent`.
    """
    source = {"task.environment": task.name, "search.algorithm": "me_es", "budget.generations": generations or 1}
    config = load_config({}, source | (settings or {}), tasks={task.name: task}, algorithms=OURS, rollouts=BACKENDS)
    enabled, shape = config.map.enabled, policy_spec(config, task)
    meta = RunMeta(
        run_id=f"{config.seed:032x}",
        created="2025-01-01T00:00:00+00:00",
        config=config.model_dump(mode="json"),
        given=dict(config.made.given),
        constants=config.constants(),
        task=asdict(task),
        columns=history_columns(task, enabled),
        evaluation_columns=evaluated_columns(task, enabled),
        parent=parent,
    )
    rng = np.random.default_rng(config.seed)
    map_ = _filled(make_geometry(config.map), filled, rng) if enabled else None
    low_B, high_B = np.array(task.descriptor_bounds, float).T
    descriptor_G_B = rng.uniform(low_B, high_B, (generations + 1, low_B.size))
    fitness_G = -100.0 + 80.0 * (1 - np.exp(-np.arange(generations + 1) / 40)) + rng.normal(size=generations + 1)
    best = int(fitness_G.argmax())
    rows = [_row(task, g, fitness_G, descriptor_G_B[g], map_) for g in range(generations + 1)]
    rows[-1]["invalid_members"] = invalid
    centre_D = rng.normal(size=shape.parameters).astype(np.float32)
    size = task.observation_size
    policy = Policy(shape, centre_D, np.zeros(size, np.float32), np.ones(size, np.float32)).content
    traces = [] if map_ is None else [{"trace_T_B": _path(end_B, rng)} for end_B in map_.descriptor_N_B]
    if map_ is not None:
        named = {"policy_N": names([name_of(policy)] * map_.size), "trace_N": names(map(name_of, traces))}
        map_ = replace(map_, **named)
    state = RunState(
        generation=generations,
        search=SearchState(
            (CentreState(centre_D, fresh_state(config.search, centre_D.size)),),
            archive_of(descriptor_G_B, np.arange(generations + 1), np.zeros(generations + 1, np.int64)),
            FitnessWeight(1.0),
            map_,
        ),
        observations=Moments(10.0, np.zeros(size), np.ones(size)),
        best=Best(best, float(fitness_G[best]), names([name_of(policy)])[0]),
        env_steps=rows[-1]["env_steps"],
        episodes=rows[-1]["episodes"],
        wall_clock_s=rows[-1]["wall_clock_s"],
    )
    beginning = Beginning(
        history=[{name: value for name, value in row.items() if name != "evaluated"} for row in rows],
        parts=stored(state),
        contents={name_of(content): content for content in (policy, *traces)},
        platforms=[(0, dict(platform_info()))],
        newest=generations,
        evaluations=[row["evaluated"] for row in rows],
    )
    RunStore.create(folder, config.resolved_yaml(), meta, beginning).close()
    return folder


def _row(task: TaskSpec, g: int, fitness_G: np.ndarray, descriptor_B: np.ndarray, map_: BehaviourMap | None) -> dict:
    """History row of a generation, and under `evaluated` the centre that it evaluated."""
    fitness, names = float(fitness_G[g]), task.descriptor_names
    place = dict(zip(names, descriptor_B.tolist(), strict=True))
    quartiles = {
        f"population_{kind}_{name}": fitness + offset if g else None
        for kind in ("fitness", "return")
        for name, offset in (("min", -20.0), ("q25", -9.0), ("median", -6.0), ("q75", -3.0), ("max", 2.0))
    }
    distances = {"goal_distance": 1.0, "goal_distance_way": 0.75, "goal_distance_min": 0.5}
    goal = {name: value / (1 + g) for name, value in distances.items()} if task.has_goal else {}
    of_map = {}
    if map_ is not None:
        share = (g + 1) / fitness_G.size
        of_map = {
            "cell": int(map_.cell_N[g % map_.size]) if map_.size else None,
            "start_cell": None,
            "map_cells": int(map_.size * share),
            "coverage": map_.size * share / map_.geometry.size,
            "coverage_reachable": map_.size * share / map_.geometry.size,
            "map_fitness_max": fitness,
            "qd_score": 100.0 * map_.size * share,
        }
    return {
        "generation": g,
        "env_steps": 1000 * (g + 1),
        "episodes": 10 * (g + 1),
        "centre_fitness_mean": fitness,
        "centre_fitness_std": 1.0,
        "best_fitness": float(fitness_G[: g + 1].max()),
        **quartiles,
        **{f"centre_{name}": value for name, value in place.items()},
        **goal,
        **of_map,
        "centre": 0,
        "fitness_weight": float(g // 10 % 2),
        "centre_novelty": 1.0 / (1 + g) if g else None,
        "archive_size": g + 1,
        "update_norm": 1.0 if g else None,
        "parameter_norm": 10.0,
        "invalid_members": 0,
        "retries": 2 * (g == 5),
        "lost_workers": int(g == 5),
        "workers": 2,
        "wall_clock_s": 0.1 * (g + 1),
        "steps_per_second": 1e4,
        "seconds_rollout": 0.06,
        "seconds_gradient": 0.01,
        "seconds_evaluation": 0.02,
        "seconds_driver": 0.005,
        "seconds_store": 0.005,
        "evaluated": [
            {
                "centre": 0,
                "fitness_weight": float(g // 10 % 2),
                "cell": of_map.get("cell"),
                "fitness_mean": fitness,
                "fitness_std": 1.0,
                "fitness_max": fitness + 2.0,
                "return_mean": fitness,
                **place,
                **goal,
                "novelty": 1.0 / (1 + g) if g else None,
                "update_norm": 1.0 if g else None,
                "env_steps": 1000,
            }
        ],
    }


def _filled(geometry: Geometry, share: float, rng: np.random.Generator) -> BehaviourMap:
    cells = np.sort(rng.permutation(geometry.size)[: round(share * geometry.size)])
    if isinstance(geometry, Grid):
        index_N_B = np.array([geometry.index_of(int(cell)) for cell in cells], int).reshape(
            cells.size, len(geometry.bounds)
        )
        middle_N_B = [
            (edges[:-1] + edges[1:])[index] / 2 for edges, index in zip(geometry.edges, index_N_B.T, strict=True)
        ]
        descriptor_N_B = np.stack(middle_N_B, axis=1).reshape(cells.size, len(geometry.bounds))
    elif isinstance(geometry, Cvt):
        descriptor_N_B = geometry.centroid_C_B[cells]
    else:
        descriptor_N_B = rng.uniform(*np.array(geometry.bounds).T, (cells.size, len(geometry.bounds)))
    fitness_N = -200.0 + 180.0 * rng.uniform(size=cells.size)
    zeros, none = np.zeros(cells.size, np.int64), np.zeros(cells.size, NAME)
    columns = (fitness_N, descriptor_N_B, zeros, zeros, fitness_N, none, none)
    return BehaviourMap(geometry, cells.astype(np.int64), *columns)


def _path(end_B: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A way of 64 points to a place."""
    share_T = np.linspace(0.0, 1.0, 64)[:, None]
    return (share_T * end_B + (1 - share_T) * share_T * rng.normal(size=end_B.size)).astype(np.float32)
