"""The behaviour map as the driver keeps it in memory: fitness, descriptor and origin of each cell's elite.

An elite is the evaluated centre or policy with the highest fitness among all whose descriptor is in a cell. A map of
slots (`map.kind: dominated`) has other elites: `maps/dominated.py` says which, and its cells are the slots. An entry
names its policy and the trace of one of its episodes, which are in the run store. Most searches only insert; one that
measures its elites again may also change, move and remove entries. All functions are pure.

Axes: N filled cells, in the order in which they were filled, and slots in that in which their elites entered; B
descriptor dimensions; D policy parameters; O observation; T points of a trace; Q evaluated centres of a batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME, Policy
from es_service.protocol.messages import FloatArray
from es_service.search.maps.dominated import survivors
from es_service.search.maps.geometry import Dominated, Geometry, Tessellation, tessellation

COLUMNS: dict[str, Any] = {
    **{"fitness_N": "f8", "descriptor_N_B": "f8", "generation_N": "i8", "centre_N": "i8", "score_N": "f8"},
    **{"policy_N": NAME, "trace_N": NAME},
}
"""Type of each array that every map has besides the numbers of its cells."""
EMPTY = -1
"""Stands for no cell in an array of cells."""


@dataclass(frozen=True)
class BehaviourMap:
    """The filled cells of a map. It is immutable: `insert` and the other functions return a new map."""

    geometry: Geometry
    cell_N: NDArray[np.int64]
    """Number of each filled cell, as `geometry` counts cells; each is different."""
    fitness_N: NDArray[np.float64]
    """Mean fitness over the evaluation episodes; of all samples, if the search measures elites again."""
    descriptor_N_B: NDArray[np.float64]
    generation_N: NDArray[np.int64]
    """Generation in which each elite was first evaluated; 0 for initial centres."""
    centre_N: NDArray[np.int64]
    """Index of the centre or policy that became the elite."""
    score_N: NDArray[np.float64]
    """Highest fitness of a member of the population that led to the elite or, later, of the latest population around
    it; one noisy value, which `cell_sampling: score` uses. NaN where there was no population."""
    policy_N: NDArray[Any]
    """Name of each elite's policy. NO_NAME stands for what was evaluated as `centre_N` in this generation; the loop
    puts its name there when the search has been told."""
    trace_N: NDArray[Any]
    """Name of the trace of one of its episodes, likewise."""
    samples_N: NDArray[np.int64] | None = None
    """Number of episodes of which fitness and descriptor are the mean; None for a search that does not count them
    (`Algorithm.counts_samples`)."""

    @property
    def size(self) -> int:
        return self.cell_N.size

    def row_of(self, cell: int) -> int | None:
        """Index of a cell on axis N; None if the cell is empty."""
        rows = np.flatnonzero(self.cell_N == cell)
        return int(rows[0]) if rows.size else None

    def cell_of(self, generation: int, centre: int) -> int | None:
        """The cell whose elite is the centre that was evaluated in a generation; None if there is none."""
        cell = int(self.cells_with(generation, np.array([centre]))[0])
        return None if cell == EMPTY else cell

    def cells_with(self, generation: int, centre_Q: NDArray[np.int64]) -> NDArray[np.int64]:
        """The cell whose elite is each of the centres that were evaluated in a generation, [Q]; EMPTY where none is."""
        rows = np.flatnonzero(self.generation_N == generation)
        rows = rows[np.argsort(self.centre_N[rows], kind="stable")]
        found_Q = np.searchsorted(self.centre_N[rows], centre_Q)
        is_there_Q = np.append(self.centre_N[rows], 0)[found_Q] == centre_Q
        is_there_Q &= found_Q < rows.size
        return np.where(is_there_Q, np.append(self.cell_N[rows], EMPTY)[found_Q], EMPTY)


@dataclass(frozen=True, eq=False)
class Elite(Policy):
    """The elite of a cell: the policy and the trace that its entry names."""

    trace_T_B: FloatArray = field(repr=False)
    """Descriptor along one evaluation episode, from reset to end at equal intervals."""


def empty_map(geometry: Geometry, *, counts_samples: bool = False) -> BehaviourMap:
    dimensions = len(geometry.bounds)
    shapes = {"descriptor_N_B": (0, dimensions)}
    columns: dict[str, Any] = {name: np.zeros(shapes.get(name, 0), kind) for name, kind in COLUMNS.items()}
    none_N = np.zeros(0, np.int64)
    return BehaviourMap(geometry, none_N, **columns, samples_N=none_N if counts_samples else None)


def insert(
    map_: BehaviourMap,
    descriptor_B: NDArray[np.float64],
    fitness: float,
    generation: int,
    centre: int,
    score: float,
    samples: int = 1,
) -> tuple[BehaviourMap, int, bool]:
    """Insert an evaluated centre if it is better than its cell's elite: (new map, cell, whether it was inserted).

    It is inserted if the cell was empty or the fitness of the present elite is strictly lower; if they are equal, the
    present elite stays. Not for slots, which have no places: see `insert_each`.

    Args:
        descriptor_B: mean descriptor, finite.
        fitness: mean fitness over the evaluation episodes.
        score: see `BehaviourMap.score_N`.
        samples: number of the evaluation episodes; not used by a map that does not count them.
    """
    cell = int(_with_places(map_.geometry).cells_of(descriptor_B[None])[0])
    entry = {
        "fitness_N": fitness,
        "descriptor_N_B": descriptor_B,
        "generation_N": generation,
        "centre_N": centre,
        "score_N": score,
        **dict.fromkeys(("policy_N", "trace_N"), np.zeros((), NAME)),
        **({} if map_.samples_N is None else {"samples_N": samples}),
    }
    return _offered(map_, cell, entry)


def changed(
    map_: BehaviourMap,
    cell: int,
    *,
    fitness: float | None = None,
    score: float | None = None,
    samples: int | None = None,
) -> BehaviourMap:
    """The map with other values for a cell's elite, None for those that stay; unchanged if the cell is empty.

    Args:
        samples: not used by a map that does not count them.
    """
    row = map_.row_of(cell)
    values = {"fitness_N": fitness, "score_N": score, "samples_N": samples if map_.samples_N is not None else None}
    return (
        map_ if row is None else _with(map_, row, {name: value for name, value in values.items() if value is not None})
    )


def removed(map_: BehaviourMap, cell: int) -> BehaviourMap:
    """The map without a cell's elite; unchanged if the cell is empty. The others keep their order."""
    row = map_.row_of(cell)
    if row is None:
        return map_
    return replace(map_, **{name: np.delete(values, row, axis=0) for name, values in columns_of(map_).items()})


def moved(map_: BehaviourMap, cell: int, descriptor_B: NDArray[np.float64]) -> tuple[BehaviourMap, int, bool]:
    """Give a cell's elite a new descriptor: (new map, cell of the descriptor, whether the elite is in the map).

    If the descriptor is in another cell, the elite leaves its own and is offered there as by `insert`: it takes the
    place of an elite with a strictly lower fitness, and leaves the map where there is a better or an equal one. In an
    empty cell it is the newest entry of the map.

    Raises:
        KeyError: the cell is empty.
    """
    row, to = map_.row_of(cell), int(_with_places(map_.geometry).cells_of(descriptor_B[None])[0])
    if row is None:
        raise KeyError(cell)
    if to == cell:
        return _with(map_, row, {"descriptor_N_B": descriptor_B}), cell, True
    entry = {name: values[row] for name, values in columns_of(map_).items() if name != "cell_N"}
    return _offered(removed(map_, cell), to, entry | {"descriptor_N_B": descriptor_B})


def resampled(
    map_: BehaviourMap, cell: int, descriptor_B: NDArray[np.float64], fitness: float, samples: int
) -> tuple[BehaviourMap, int, bool]:
    """Add samples to a cell's elite, whose fitness and descriptor become the means of all; returns as `moved`.

    Args:
        descriptor_B: mean over the new samples, finite.
        fitness: likewise.
        samples: number of the new samples.

    Raises:
        KeyError: the cell is empty.
        ValueError: the map does not count samples.
    """
    row = map_.row_of(cell)
    if map_.samples_N is None:
        raise ValueError("this map does not count samples; set Algorithm.counts_samples")
    if row is None:
        raise KeyError(cell)
    total = int(map_.samples_N[row]) + samples
    share = samples / total
    fitness = float((1.0 - share) * map_.fitness_N[row] + share * fitness)
    descriptor_B = (1.0 - share) * map_.descriptor_N_B[row] + share * descriptor_B
    return moved(changed(map_, cell, fitness=fitness, samples=total), cell, descriptor_B)


def map_statistics(
    map_: BehaviourMap, qd_offset: float, reachable: NDArray[np.bool_] | None
) -> dict[str, float | None]:
    """Coverage, best fitness and QD-score of a map, by history column.

    The QD-score is the sum of fitness - qd_offset over all elites. It is summed exactly and rounded once, so that the
    order of the cells does not matter. Of a map of slots, all of this is said of its projection; see `projected`.

    Args:
        reachable: whether each cell can be reached, [cells]; None if this is unknown.
    """
    map_ = projected(map_)
    filled = map_.size
    return {
        "map_cells": filled,
        "coverage": filled / map_.geometry.size,
        "coverage_reachable": None if reachable is None else float(reachable[map_.cell_N].sum() / reachable.sum()),
        "map_fitness_max": float(map_.fitness_N.max()) if filled else None,
        "qd_score": math.fsum((map_.fitness_N - qd_offset).tolist()),
    }


def places_of(map_: BehaviourMap) -> NDArray[np.int64]:
    """Cell of the descriptor space in which each elite is, [N]: its own or, of a slot, that of `tessellation`."""
    cells = tessellation(map_.geometry)
    return map_.cell_N if cells is map_.geometry else cells.cells_of(map_.descriptor_N_B)


def projected(map_: BehaviourMap) -> BehaviourMap:
    """The map by whose cells coverage is counted, which can be compared with others: the fittest elite at each place.

    It is the map itself, unless this has slots. Of equally fit elites the oldest is shown. Source: the released code
    of Bahlous-Boldi et al. 2025 (arXiv:2502.00593) measures coverage and QD-score so.
    """
    place_N = places_of(map_)
    if place_N is map_.cell_N:
        return map_
    rows = np.sort(_fittest(place_N, map_.fitness_N))
    columns = {name: values[rows] for name, values in columns_of(map_).items()}
    return replace(map_, geometry=tessellation(map_.geometry), **columns | {"cell_N": place_N[rows]})


def with_names(
    map_: BehaviourMap,
    generation: int,
    index_N: NDArray[np.int64],
    names: Callable[[Sequence[int]], tuple[NDArray[Any], NDArray[Any]]],
) -> BehaviourMap:
    """The map in which entries that were evaluated in a generation name their policies and traces.

    Args:
        index_N: centres and policies that were evaluated.
        names: function from indices on that axis to the names of the policies and of the traces.

    Raises:
        ValueError: an entry without a name was not evaluated in this generation.
    """
    rows = np.flatnonzero(map_.policy_N == np.zeros((), NAME))
    if not rows.size:
        return map_
    order = np.argsort(index_N, kind="stable")
    found = np.append(order, -1)[np.searchsorted(index_N, map_.centre_N[rows], sorter=order)]
    is_known = (map_.generation_N[rows] == generation) & (np.append(index_N, -1)[found] == map_.centre_N[rows])
    if not is_known.all():
        row = rows[~is_known][0]
        raise ValueError(
            f"the new elite of cell {map_.cell_N[row]} is centre {map_.centre_N[row]} of generation "
            f"{map_.generation_N[row]}, which was not evaluated now; `policy_N` must name one that comes from elsewhere"
        )
    columns = {"policy_N": map_.policy_N.copy(), "trace_N": map_.trace_N.copy()}
    for column, named in zip(columns.values(), names(found.tolist()), strict=True):
        column[rows] = named
    return replace(map_, **columns)


def columns_of(map_: BehaviourMap) -> dict[str, np.ndarray]:
    samples = {} if map_.samples_N is None else {"samples_N": map_.samples_N}
    return {"cell_N": map_.cell_N, **{name: getattr(map_, name) for name in COLUMNS}, **samples}


def _with_places(geometry: Geometry) -> Tessellation:
    """A geometry whose cells have places. Raises ValueError for one of slots."""
    if isinstance(geometry, Dominated):
        raise ValueError("the slots of a dominated map have no places; offer a whole generation by `insert_each`")
    return geometry


def _fittest(cell_Q: NDArray[np.int64], fitness_Q: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index of the fittest in each cell, the first of equally fit ones, by cell."""
    fittest = np.lexsort((-fitness_Q, cell_Q))  # stable: of equally fit ones the first comes first
    return fittest[np.flatnonzero(np.diff(cell_Q[fittest], prepend=EMPTY))]


def _offered(map_: BehaviourMap, cell: int, entry: dict[str, Any]) -> tuple[BehaviourMap, int, bool]:
    """Insert an entry into a cell unless the elite there is as fit; see `insert`."""
    row = map_.row_of(cell)
    if row is not None:
        enters = entry["fitness_N"] > map_.fitness_N[row]
        return (_with(map_, row, entry) if enters else map_), cell, bool(enters)
    columns = {
        name: np.concatenate([values, np.asarray(value, values.dtype)[None]])
        for name, values in columns_of(map_).items()
        for value in [cell if name == "cell_N" else entry[name]]
    }
    return replace(map_, **columns), cell, True


def _with(map_: BehaviourMap, row: int, values: dict[str, Any]) -> BehaviourMap:
    columns = {name: getattr(map_, name).copy() for name in values}
    for name, value in values.items():
        columns[name][row] = value
    return replace(map_, **columns)


def insert_each(
    map_: BehaviourMap,
    descriptor_Q_B: NDArray[np.float64],
    fitness_Q: NDArray[np.float64],
    generation: int,
    centre_Q: NDArray[np.int64],
    score_Q: NDArray[np.float64],
    samples: int = 1,
) -> BehaviourMap:
    """The map after `insert` of each evaluated centre, one after another.

    For slots, all of them compete with the elites at once, as `maps/dominated.py` says. An elite that stays keeps its
    slot; those that enter take the free ones, the first the lowest.

    Args:
        descriptor_Q_B: mean descriptor of each, finite.
        fitness_Q: mean fitness of each, finite.
        samples: number of each one's evaluation episodes; not used by a map that does not count them.
    """
    given_Q = {
        "fitness_N": fitness_Q,
        "descriptor_N_B": descriptor_Q_B,
        "generation_N": np.full(fitness_Q.shape, generation),
        "centre_N": centre_Q,
        "score_N": score_Q,
        **dict.fromkeys(("policy_N", "trace_N"), np.zeros(fitness_Q.shape, NAME)),
        "samples_N": np.full(fitness_Q.shape, samples),
    }
    if isinstance(map_.geometry, Dominated):
        return _into_slots(map_, map_.geometry, given_Q)
    cell_Q = map_.geometry.cells_of(descriptor_Q_B)
    fittest = _fittest(cell_Q, fitness_Q)
    sorted_rows = np.argsort(map_.cell_N)
    position = np.searchsorted(map_.cell_N, cell_Q[fittest], sorter=sorted_rows)
    row = np.append(sorted_rows, -1)[position]
    is_filled = np.append(map_.cell_N, EMPTY)[row] == cell_Q[fittest]
    is_better = is_filled & (fitness_Q[fittest] > np.append(map_.fitness_N, 0.0)[row])
    # A cell was filled by the first one in it, which is not the fittest.
    filled_by = np.unique(cell_Q, return_index=True)[1][~is_filled]
    filling = fittest[~is_filled][np.argsort(filled_by)]
    given_Q["cell_N"] = cell_Q
    if not is_better.any() and not filling.size:
        return map_
    columns = {}
    for name, values in columns_of(map_).items():
        columns[name] = np.concatenate([values, given_Q[name][filling].astype(values.dtype)])
        columns[name][row[is_better]] = given_Q[name][fittest[is_better]]
    return replace(map_, **columns)


def _into_slots(map_: BehaviourMap, geometry: Dominated, given_Q: dict[str, np.ndarray]) -> BehaviourMap:
    """The map of the elites and the newcomers that stay; see `insert_each`."""
    given_Q["cell_N"] = np.full(given_Q["fitness_N"].shape, EMPTY)
    both = {name: np.concatenate([was, given_Q[name].astype(was.dtype)]) for name, was in columns_of(map_).items()}
    rows = survivors(both["descriptor_N_B"], both["fitness_N"], geometry.neighbours, geometry.slots)
    columns = {name: values[rows] for name, values in both.items()}
    is_new = columns["cell_N"] == EMPTY
    if not is_new.any():
        return map_
    free = np.setdiff1d(np.arange(geometry.slots), columns["cell_N"][~is_new])
    columns["cell_N"][is_new] = free[: int(is_new.sum())]
    return replace(map_, **columns)
