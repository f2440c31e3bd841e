"""The state as the run store keeps it: parts by name, each a few arrays. Inverse functions stand side by side.

`state_parts` returns the parts that a generation has changed, and `state_from_parts` makes a state from parts. The
content of the parts is defined only here; searches and maps do not depend on it. Elites are written when they enter the
map and read one at a time.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from es_service.loop.state import Best, RunState, require_successor
from es_service.protocol.messages import Moments
from es_service.search.algorithms.base import CentreState, FitnessWeight, SearchState, frozen
from es_service.search.maps.behaviour_map import BehaviourMap, Elite, empty_map, unchanged_entries
from es_service.search.maps.geometry import Cvt, Geometry, Grid
from es_service.search.novelty import NoveltyArchive, archive_of, empty_archive
from es_service.search.optimizer import Adam

Arrays = dict[str, np.ndarray]
Parts = Mapping[str, Mapping[str, np.ndarray]]
"""Name of a part -> name of an array -> array."""
Changes = Mapping[str, Arrays | None]
"""Parts that a generation has changed, by name; None for a part that it has removed."""

OBSERVATIONS, COUNTERS, WEIGHT, BEST, GEOMETRY_PART = "observations", "counters", "weight", "best", "map"
OWN = "own"
"""Name of the part with the arrays of a search's own."""
CENTRE_PREFIX, CELL_PREFIX, ELITE_PREFIX, BLOCK_PREFIX = "centre_", "cell_", "elite_", "novelty_"
"""Prefixes of the names of numbered parts."""
BLOCK_ENTRIES = 256
"""Entries of the novelty archive in one part. A generation rewrites only the last of these parts."""


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


def state_parts(state: RunState, before: RunState | None) -> dict[str, Arrays]:
    """The parts of `state` that differ from `before`; all parts if `before` is None.

    Raises:
        StoreError: the search's state cannot follow `before`; see `SearchState`.
    """
    require_successor(before, state)
    search, earlier = state.search, before.search if before is not None else None
    parts = {OBSERVATIONS: moments_to_arrays(state.observations), COUNTERS: _counters_to_arrays(state)}
    for index, centre in enumerate(search.centres):
        if earlier is None or centre is not earlier.centres[index]:
            parts[centre_part(index)] = centre_to_arrays(centre)
    if earlier is None or search.weight != earlier.weight:
        parts[WEIGHT] = weight_to_arrays(search.weight)
    if search.own and (earlier is None or search.own is not earlier.own):
        parts[OWN] = dict(search.own)
    if earlier is None or search.archive is not earlier.archive:
        parts |= archive_to_parts(search.archive, earlier.archive.size if earlier is not None else 0)
    if search.map is not None:
        parts |= map_to_parts(search.map, earlier.map if earlier is not None else None)
        parts |= {elite_part(cell): elite_to_arrays(elite) for cell, elite in state.elites.items()}
    if before is None or state.best is not before.best:
        parts[BEST] = best_to_arrays(state.best)
    return parts


def state_from_parts(parts: Parts, generation: int, wall_clock_s: float, dimensions: int) -> RunState:
    """Inverse of `state_parts(state, None)`; elites are not needed.

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
                parts.get(OWN, {}),
            )
        ),
        observations=moments_from_arrays(parts[OBSERVATIONS]),
        best=best_from_arrays(parts[BEST]),
        env_steps=int(counters["env_steps"]),
        episodes=int(counters["episodes"]),
        wall_clock_s=wall_clock_s,
    )


def _counters_to_arrays(state: RunState) -> Arrays:
    return {"env_steps": np.asarray(state.env_steps, np.int64), "episodes": np.asarray(state.episodes, np.int64)}


def moments_to_arrays(moments: Moments) -> Arrays:
    """Arrays of observation statistics."""
    return {"count": np.asarray(moments.count, np.float64), "mean_O": moments.mean_O, "m2_O": moments.m2_O}


def moments_from_arrays(arrays: Mapping[str, np.ndarray]) -> Moments:
    """Inverse of `moments_to_arrays`."""
    return Moments(float(arrays["count"]), arrays["mean_O"], arrays["m2_O"])


def centre_to_arrays(centre: CentreState) -> Arrays:
    """Arrays of a centre: its parameters, its optimiser, its archive entry, its cell and its own statistics."""
    adam = centre.adam
    own = {"own_mean_O": centre.own_mean_O, "own_std_O": centre.own_std_O}
    return {
        **{name: values for name, values in own.items() if values is not None},
        "centre_D": centre.centre_D,
        "adam_m_D": adam.m_D,
        "adam_v_D": adam.v_D,
        "adam_step": np.asarray(adam.step, np.int64),
        "entry": np.asarray(centre.entry, np.int64),
        "cell": np.asarray(centre.cell, np.int64),
    }


def centre_from_arrays(arrays: Mapping[str, np.ndarray]) -> CentreState:
    """Inverse of `centre_to_arrays`."""
    adam = Adam(arrays["adam_m_D"], arrays["adam_v_D"], int(arrays["adam_step"]))
    own_mean_O, own_std_O = arrays.get("own_mean_O"), arrays.get("own_std_O")
    return CentreState(arrays["centre_D"], adam, int(arrays["entry"]), int(arrays["cell"]), own_mean_O, own_std_O)


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
    """The blocks that are new or changed if the archive's first `stored` entries are stored already."""
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


def map_to_parts(map_: BehaviourMap, before: BehaviourMap | None) -> dict[str, Arrays]:
    """Parts of the cells whose entries differ from an earlier map; for None, of all cells, and the geometry's part."""
    parts = {GEOMETRY_PART: geometry_to_arrays(map_.geometry)} if before is None else {}
    same_N = np.zeros(map_.size, bool)
    if before is not None:
        same_N[: before.size] = unchanged_entries(map_, before)
    for row in np.flatnonzero(~same_N):
        parts[cell_part(int(map_.cell_N[row]))] = {
            "order": np.asarray(row, np.int64),
            "fitness": map_.fitness_N[row],
            "descriptor_B": map_.descriptor_N_B[row],
            "generation": map_.generation_N[row],
            "centre": map_.centre_N[row],
            "score": map_.score_N[row],
        }
    return parts


def map_from_parts(parts: Parts) -> BehaviourMap | None:
    """Inverse of `map_to_parts(map, None)`, among any other parts; None where there is no map."""
    if GEOMETRY_PART not in parts:
        return None
    empty = empty_map(geometry_from_arrays(parts[GEOMETRY_PART]))
    found = {int(name.removeprefix(CELL_PREFIX)): part for name, part in parts.items() if name.startswith(CELL_PREFIX)}
    if not found:
        return empty
    cells = sorted(found, key=lambda cell: int(found[cell]["order"]))
    return BehaviourMap(
        empty.geometry,
        np.array(cells, np.int64),
        np.array([found[cell]["fitness"] for cell in cells], np.float64),
        np.array([found[cell]["descriptor_B"] for cell in cells], np.float64),
        np.array([found[cell]["generation"] for cell in cells], np.int64),
        np.array([found[cell]["centre"] for cell in cells], np.int64),
        np.array([found[cell]["score"] for cell in cells], np.float64),
    )


def elite_to_arrays(elite: Elite) -> Arrays:
    """Arrays of an elite."""
    return {name: getattr(elite, name) for name in Elite.__dataclass_fields__}


def elite_from_arrays(arrays: Mapping[str, np.ndarray]) -> Elite:
    """Inverse of `elite_to_arrays`."""
    return Elite(**{name: arrays[name] for name in Elite.__dataclass_fields__})


def best_to_arrays(best: Best) -> Arrays:
    """Arrays of the best centre so far."""
    return {
        "generation": np.asarray(best.generation, np.int64),
        "fitness": np.asarray(best.fitness, np.float64),
        "centre_D": best.centre_D,
        "observation_mean_O": best.observation_mean_O,
        "observation_std_O": best.observation_std_O,
    }


def best_from_arrays(arrays: Mapping[str, np.ndarray]) -> Best:
    """Inverse of `best_to_arrays`."""
    return Best(
        generation=int(arrays["generation"]),
        fitness=float(arrays["fitness"]),
        centre_D=arrays["centre_D"],
        observation_mean_O=arrays["observation_mean_O"],
        observation_std_O=arrays["observation_std_O"],
    )
