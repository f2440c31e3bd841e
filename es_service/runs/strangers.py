"""Whether the data of a run fit its config, checked before anything uses them: a run folder may come from a stranger.

The store checks types (`store.facts`); this is about what only readers of a run know: which columns there must be, and
what the parts of a state are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from es_service.config.resolution import policy_of
from es_service.errors import StoreError
from es_service.loop.arrays import Nodes, joined
from es_service.loop.forms import INTEGER, REAL, Sizes, missing, policy_problem, problem
from es_service.protocol.content import Arrays
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


def sound_nodes(folder: Path, meta: RunMeta, blocks: Nodes, wanted: Collection[str] = ("",)) -> dict[str, Arrays]:
    """The nodes of a state, of its blocks.

    Args:
        wanted: the beginnings of the paths of the nodes that must be among them, if every state has them.

    Raises StoreError if one is missing, or has arrays that this run cannot have.
    """
    sizes = sizes_of(meta)
    try:
        nodes = joined(blocks)
    except (ValueError, KeyError) as error:  # blocks that do not fit each other
        raise StoreError(f"{folder} is not what es-service writes: {error}", run=folder) from error
    absent = missing(nodes, sizes, wanted)
    found = f"its state has no part {absent}" if absent else ""
    if found := found or next(filter(None, (problem(path, arrays, sizes) for path, arrays in nodes.items())), ""):
        raise StoreError(f"{folder} is not what es-service writes: {found}", run=folder)
    return nodes


def sound_contents(folder: Path, meta: RunMeta, contents: Mapping[bytes, Arrays]) -> Mapping[bytes, Arrays]:
    """Policies and traces. Raises StoreError if one has arrays that this run cannot have."""
    sizes = sizes_of(meta)
    for name, arrays in contents.items():
        if found := policy_problem(arrays, sizes):
            text = f"{folder} is not what es-service writes: the content {name.hex()} {found}"
            raise StoreError(text, run=folder)
    return contents


def require_sound_state(store: RunStore) -> None:
    """Raise StoreError if the newest state in a store, or a policy in it, is none of its run."""
    if store.generation is None:
        return
    sound_nodes(store.folder, store.meta, store.load())
    for name in store.contents():  # one at a time, since all policies together may be large
        sound_contents(store.folder, store.meta, {name: store.content(name)})
