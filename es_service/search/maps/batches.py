"""Insertion of a whole batch into the behaviour map. Axes: Q evaluated centres, B descriptor dimensions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME
from es_service.search.maps.behaviour_map import EMPTY, BehaviourMap, columns_of


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

    Args:
        descriptor_Q_B: mean descriptor of each, finite.
        fitness_Q: mean fitness of each, finite.
        samples: number of each one's evaluation episodes; not used by a map that does not count them.
    """
    cell_Q = map_.geometry.cells_of(descriptor_Q_B)
    fittest = np.lexsort((-fitness_Q, cell_Q))  # stable: of equally fit ones the first comes first
    fittest = fittest[np.flatnonzero(np.diff(cell_Q[fittest], prepend=EMPTY))]
    sorted_rows = np.argsort(map_.cell_N)
    position = np.searchsorted(map_.cell_N, cell_Q[fittest], sorter=sorted_rows)
    row = np.append(sorted_rows, -1)[position]
    is_filled = np.append(map_.cell_N, EMPTY)[row] == cell_Q[fittest]
    is_better = is_filled & (fitness_Q[fittest] > np.append(map_.fitness_N, 0.0)[row])
    # A cell was filled by the first one in it, which is not the fittest.
    filled_by = np.unique(cell_Q, return_index=True)[1][~is_filled]
    filling = fittest[~is_filled][np.argsort(filled_by)]
    given_Q = {
        "cell_N": cell_Q,
        "fitness_N": fitness_Q,
        "descriptor_N_B": descriptor_Q_B,
        "generation_N": np.full(cell_Q.shape, generation),
        "centre_N": centre_Q,
        "score_N": score_Q,
        **dict.fromkeys(("policy_N", "trace_N"), np.zeros(cell_Q.shape, NAME)),
        "samples_N": np.full(cell_Q.shape, samples),
    }
    if not is_better.any() and not filling.size:
        return map_
    columns = {}
    for name, values in columns_of(map_).items():
        columns[name] = np.concatenate([values, given_Q[name][filling].astype(values.dtype)])
        columns[name][row[is_better]] = given_Q[name][fittest[is_better]]
    return replace(map_, **columns)
