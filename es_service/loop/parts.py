"""The state as the run store keeps it: parts by name, each a few arrays. Inverse functions stand side by side.

`state_from_parts` makes a state from parts; `changes.py` finds those that a generation has changed. The content of the
parts is defined only here and, for what a search of the user's adds, in `search/state_parts.py`. Elites are read one at
a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from es_service.loop.state import Best, RunState
from es_service.protocol.messages import Moments
from es_service.search import state_parts
from es_service.search.algorithms.base import CentreState, FitnessWeight, SearchState, frozen
from es_service.search.maps.behaviour_map import BehaviourMap, Elite, empty_map, orders
from es_service.search.maps.geometry import Cvt, Geometry, Grid
from es_service.search.novelty import NoveltyArchive, archive_of, empty_archive
from es_service.search.steps import StepState

Arrays = dict[str, np.ndarray]
Parts = Mapping[str, Mapping[str, np.ndarray]]
"""Name of a part -> name of an array -> array."""
Changes = Mapping[str, Mapping[str, np.ndarray] | None]
"""Parts that a generation has changed, by name; None for a part that it has removed."""

OBSERVATIONS, COUNTERS, WEIGHT, BEST, GEOMETRY_PART = "observations", "counters", "weight", "best", "map"
CENTRE_PREFIX, CELL_PREFIX, ELITE_PREFIX, BLOCK_PREFIX = "centre_", "cell_", "elite_", "novelty_"
"""Prefixes of the names of numbered parts."""
BLOCK_ENTRIES = 256
"""Entries of the novelty archive in one part. A generation that only adds entries rewrites the last of these parts."""


def centre_part(index: int) -> str:
    """Name of a centre's part."""
    return f"{CENTRE_PREFIX}{index}"


def cell_part(cell: int) -> str:
    """Name of the part with a cell's entry in the behaviour map: fitness, descriptor and origin of its elite."""
    return f"{CELL_PREFIX}{cell:08d}"


def elite_part(cell: int) -> str:
    """Name of the part with a cell's elite: parameters, observation statistics and trace."""
    return f"{ELITE_PREFIX}{cell:08d}"


def block_part(block: int) -> str:
    """Name of a block of entries of the novelty archive."""
    return f"{BLOCK_PREFIX}{block:05d}"


def state_from_parts(parts: Parts, generation: int, wall_clock_s: float, dimensions: int) -> RunState:
    """The state that consists of parts; inverse of `changes.changed_parts(state, None)`. Elites are not needed.

    Args:
        dimensions: number of descriptor dimensions, needed while the novelty archive has no entry.
    """
    centres = []
    while centre_part(len(centres)) in parts:
        centres.append(centre_from_arrays(parts[centre_part(len(centres))]))
    counters = parts[COUNTERS]
    return RunState(
        generation=generation,
        search=frozen(
            SearchState(
                tuple(centres),
                archive_from_parts(parts, dimensions),
                weight_from_arrays(parts[WEIGHT]),
                map_from_parts(parts),
                state_parts.from_parts(parts),
            )
        ),
        observations=moments_from_arrays(parts[OBSERVATIONS]),
        best=best_from_arrays(parts[BEST]),
        env_steps=int(counters["env_steps"]),
        episodes=int(counters["episodes"]),
        wall_clock_s=wall_clock_s,
    )


def counters_to_arrays(state: RunState) -> Arrays:
    """Arrays of what a run has counted."""
    return {"env_steps": np.asarray(state.env_steps, np.int64), "episodes": np.asarray(state.episodes, np.int64)}


def moments_to_arrays(moments: Moments) -> Arrays:
    """Arrays of observation statistics."""
    return {"count": np.asarray(moments.count, np.float64), "mean_O": moments.mean_O, "m2_O": moments.m2_O}


def moments_from_arrays(arrays: Mapping[str, np.ndarray]) -> Moments:
    """Inverse of `moments_to_arrays`."""
    return Moments(float(arrays["count"]), arrays["mean_O"], arrays["m2_O"])


def centre_to_arrays(centre: CentreState) -> Arrays:
    """Arrays of a centre: its parameters, its archive entry, its cell, its own statistics, and those of its step."""
    own = {"own_mean_O": centre.own_mean_O, "own_std_O": centre.own_std_O}
    return {
        **{name: values for name, values in own.items() if values is not None},
        "centre_D": centre.centre_D,
        **centre.step,
        "entry": np.asarray(centre.entry, np.int64),
        "cell": np.asarray(centre.cell, np.int64),
    }


def centre_from_arrays(arrays: Mapping[str, np.ndarray]) -> CentreState:
    """Inverse of `centre_to_arrays`. What is not of the centre itself is of its step."""
    own_mean_O, own_std_O = arrays.get("own_mean_O"), arrays.get("own_std_O")
    step = {name: values for name, values in arrays.items() if name not in CentreState.__dataclass_fields__}
    return CentreState(arrays["centre_D"], step, int(arrays["entry"]), int(arrays["cell"]), own_mean_O, own_std_O)


def with_step(arrays: Mapping[str, np.ndarray], step: StepState) -> Arrays:
    """The arrays of a centre with another state of its step."""
    return {name: values for name, values in arrays.items() if name in CentreState.__dataclass_fields__} | dict(step)


def weight_to_arrays(weight: FitnessWeight) -> Arrays:
    """Arrays of the weight of fitness and of its adaptation."""
    return {
        "value": np.asarray(weight.value, np.float64),
        "record": np.asarray(weight.record, np.float64),
        "stagnant": np.asarray(weight.stagnant, np.int64),
    }


def weight_from_arrays(arrays: Mapping[str, np.ndarray]) -> FitnessWeight:
    """Inverse of `weight_to_arrays`."""
    return FitnessWeight(float(arrays["value"]), float(arrays["record"]), int(arrays["stagnant"]))


def archive_to_parts(archive: NoveltyArchive, stored: int) -> dict[str, Arrays]:
    """The blocks with the archive's entries from `stored` on, and the one before if it is not full."""
    parts = {}
    for block in range(stored // BLOCK_ENTRIES, -(-archive.size // BLOCK_ENTRIES)):
        entries = slice(block * BLOCK_ENTRIES, (block + 1) * BLOCK_ENTRIES)
        parts[block_part(block)] = {
            "descriptor_N_B": archive.descriptor_N_B[entries],
            "generation_N": archive.generation_N[entries],
            "centre_N": archive.centre_N[entries],
        }
    return parts


def archive_from_parts(parts: Parts, dimensions: int) -> NoveltyArchive:
    """Inverse of `archive_to_parts(archive, 0)`, among any other parts."""
    blocks = []
    while block_part(len(blocks)) in parts:
        blocks.append(parts[block_part(len(blocks))])
    if not blocks:
        return empty_archive(dimensions)
    descriptor_N_B, generation_N, centre_N = (
        np.concatenate([block[name] for block in blocks]) for name in ("descriptor_N_B", "generation_N", "centre_N")
    )
    return archive_of(descriptor_N_B, generation_N, centre_N)


def geometry_to_arrays(geometry: Geometry) -> Arrays:
    """Arrays of a map's cells, with the centroids, because other versions of SciPy might place them differently."""
    bounds = {"bounds_B_2": np.array(geometry.bounds, np.float64)}
    if isinstance(geometry, Grid):
        return bounds | {"shape_B": np.array(geometry.shape, np.int64)}
    return bounds | {"centroid_C_B": geometry.centroid_C_B}


def geometry_from_arrays(arrays: Mapping[str, np.ndarray]) -> Geometry:
    """Inverse of `geometry_to_arrays`."""
    bounds = tuple((float(low), float(high)) for low, high in arrays["bounds_B_2"])
    if "shape_B" in arrays:
        return Grid(bounds, tuple(int(n) for n in arrays["shape_B"]))
    return Cvt(bounds, arrays["centroid_C_B"])


def map_to_arrays(map_: BehaviourMap) -> Arrays:
    """Arrays of a map without its entries."""
    samples = {} if map_.samples_N is None else {"counts_samples": np.asarray(True)}
    return geometry_to_arrays(map_.geometry) | samples


def entries_to_parts(map_: BehaviourMap, rows: Iterable[int]) -> dict[str, Arrays]:
    """Parts of the cells of some rows of a map."""
    order_N = orders(map_)
    return {
        cell_part(int(map_.cell_N[row])): {
            "order": order_N[row],
            "fitness": map_.fitness_N[row],
            "descriptor_B": map_.descriptor_N_B[row],
            "generation": map_.generation_N[row],
            "centre": map_.centre_N[row],
            "score": map_.score_N[row],
            **({} if map_.samples_N is None else {"samples": map_.samples_N[row]}),
        }
        for row in rows
    }


def map_from_parts(parts: Parts) -> BehaviourMap | None:
    """Inverse of `map_to_arrays` and `entries_to_parts` of all rows, among any other parts; None without a map."""
    if GEOMETRY_PART not in parts:
        return None
    empty = empty_map(
        geometry_from_arrays(parts[GEOMETRY_PART]), counts_samples="counts_samples" in parts[GEOMETRY_PART]
    )
    entries = {
        int(name.removeprefix(CELL_PREFIX)): part for name, part in parts.items() if name.startswith(CELL_PREFIX)
    }
    if not entries:
        return empty
    cells = sorted(entries, key=lambda cell: int(entries[cell]["order"]))

    def column(name: str, kind: type[Any]) -> np.ndarray:
        return np.array([entries[cell][name] for cell in cells], kind)

    order_N = column("order", np.int64)
    return BehaviourMap(
        empty.geometry,
        np.array(cells, np.int64),
        column("fitness", np.float64),
        column("descriptor_B", np.float64),
        column("generation", np.int64),
        column("centre", np.int64),
        column("score", np.float64),
        None if empty.samples_N is None else column("samples", np.int64),
        None if np.array_equal(order_N, np.arange(order_N.size)) else order_N,
    )


_OF_ELITES = tuple(Elite.__dataclass_fields__)


def elite_to_arrays(elite: Elite) -> Arrays:
    """Arrays of an elite."""
    return {name: getattr(elite, name) for name in _OF_ELITES}


def elite_from_arrays(arrays: Mapping[str, np.ndarray]) -> Elite:
    """Inverse of `elite_to_arrays`."""
    return Elite(*[arrays[name] for name in _OF_ELITES])


def best_to_arrays(best: Best) -> Arrays:
    """Arrays of the best centre so far."""
    return {name: np.asarray(value) for name, value in vars(best).items()}


def best_from_arrays(arrays: Mapping[str, np.ndarray]) -> Best:
    """Inverse of `best_to_arrays`."""
    policy = (arrays[name] for name in ("centre_D", "observation_mean_O", "observation_std_O"))
    return Best(int(arrays["generation"]), float(arrays["fitness"]), *policy)
