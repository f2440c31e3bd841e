"""Whether the data of a run fit its config, checked before anything uses them: a run folder may come from a stranger.

The store checks types (`store.facts`); this is about what only readers of a run know: which columns there must be, and
what the parts of a state are.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from es_service.config.resolution import policy_of
from es_service.errors import StoreError
from es_service.loop.forms import INTEGER, REAL, Sizes, missing, problem
from es_service.loop.parts import Parts
from es_service.protocol.messages import PolicySpec
from es_service.search.steps import STEPS
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore

COLUMNS = {
    **dict.fromkeys(("generation", "env_steps", "episodes", "centre", "archive_size", "invalid_members"), "INTEGER"),
    **dict.fromkeys(("retries", "lost_workers", "workers"), "INTEGER"),
    **dict.fromkeys(("centre_fitness_mean", "best_fitness", "wall_clock_s", "steps_per_second"), "REAL"),
    **dict.fromkeys(("seconds_rollout", "seconds_gradient", "seconds_evaluation", "seconds_driver"), "REAL"),
}
"""Columns of every history -> their types."""
OF_CENTRES = {"centre": "INTEGER", "fitness_weight": "REAL", "fitness_mean": "REAL", "update_norm": "REAL"}
"""The same for the evaluated centres."""


def policy_spec(meta: RunMeta) -> PolicySpec:
    """What a run's policies are."""
    return policy_of(meta.constants, meta.task["observation_size"], meta.task["action_size"])


def sizes_of(meta: RunMeta) -> Sizes:
    """The sizes of a run's arrays."""
    dimensions, has_map = len(meta.task["descriptor_names"]), meta.constants["map.enabled"]
    cells = tuple(meta.constants["map.cells"] or ()) if has_map else None
    bounds = tuple((low, high) for low, high in meta.constants["map.bounds"] or ()) if has_map else ()
    step, kinds = STEPS.get(meta.constants.get("search.step.kind") or ""), {"i": INTEGER, "f": REAL}
    of_step = {} if step is None else {name: kinds[array.dtype.kind] for name, array in step.fresh(1).items()}
    return Sizes(policy_spec(meta).parameters, meta.task["observation_size"], dimensions, cells, bounds, of_step)


def sound_meta(folder: Path, meta: RunMeta) -> RunMeta:
    """The description of a run. Raises StoreError if it lacks a column that every run has."""
    for table, needed in ((meta.columns, COLUMNS), (meta.evaluation_columns, OF_CENTRES)):
        types = {column.name: column.type for column in table}
        for name, kind in needed.items():
            if types.get(name) != kind:
                raise StoreError(f"{folder} is not what es-service writes: it has no {kind} column {name}", run=folder)
    return meta


def sound_parts(
    folder: Path, meta: RunMeta, parts: Parts, wanted: Callable[[str], bool] = lambda part: True
) -> dict[str, dict[str, np.ndarray]]:
    """Parts of a state.

    Args:
        wanted: whether a part of this name must be among them if every state has it.

    Raises StoreError if one is missing, or has arrays that this run cannot have.
    """
    require_whole(folder, meta, parts, wanted)
    require_forms(folder, meta, parts)
    return {name: dict(arrays) for name, arrays in parts.items()}


def require_whole(
    folder: Path, meta: RunMeta, names: Collection[str], wanted: Callable[[str], bool] = lambda part: True
) -> None:
    """Raise StoreError if a part that every state has is not among those of these names; `wanted` as for
    `sound_parts`."""
    if absent := missing(names, sizes_of(meta), wanted):
        raise StoreError(f"{folder} is not what es-service writes: its state has no part {absent}", run=folder)


def require_forms(folder: Path, meta: RunMeta, parts: Parts) -> None:
    """Raise StoreError if a part has arrays that this run cannot have."""
    sizes = sizes_of(meta)
    if found := next(filter(None, (problem(part, arrays, sizes) for part, arrays in parts.items())), ""):
        raise StoreError(f"{folder} is not what es-service writes: {found}", run=folder)


def require_sound_state(store: RunStore) -> None:
    """Raise StoreError if the newest state in a store is none of its run; it is read part by part, since all elites
    together may be large."""
    if store.generation is None:
        return
    names = store.names()
    require_whole(store.folder, store.meta, names)
    for name in names:
        require_forms(store.folder, store.meta, {name: store.part(name)})
