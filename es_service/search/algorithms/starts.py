"""How the elite is drawn from which a centre begins again.

Axis N: filled cells of the map, in its order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import NoveltyConfig, RunConfig
from es_service.search.algorithms.base import SearchState
from es_service.search.arrays import read_only
from es_service.search.maps.behaviour_map import BehaviourMap, Elite
from es_service.search.maps.geometry import cell_count
from es_service.search.novelty import NoveltyArchive, novelty

Starts = Literal["uniform", "novelty", "least_tried", "fitness"]
Restart = Callable[[SearchState, int, int, Elite], SearchState]
TRIED = "tried"
"""Name of an array of the search's own [cells]: number of centres that have begun from each cell."""


def counted_starts(config: RunConfig) -> dict[str, NDArray[np.int64]]:
    """The array TRIED before any start."""
    return {TRIED: np.zeros(cell_count(config.map), np.int64)}


def counting(restart: Restart) -> Restart:
    """The same function, which also counts the start if the search counts them."""

    def counted(state: SearchState, index: int, cell: int, elite: Elite) -> SearchState:
        if (tried_C := state.extra.get(TRIED)) is not None:
            tried_C = tried_C + (np.arange(tried_C.size) == cell)
            state = replace(state, extra=read_only({**state.extra, TRIED: tried_C}))
        return restart(state, index, cell, elite)

    return counted


def start_shares(
    starts: Starts,
    map_: BehaviourMap,
    archive: NoveltyArchive,
    settings: NoveltyConfig,
    tried_C: NDArray[np.int64] | None,
) -> NDArray[np.float64]:
    """Relative probability with which each filled cell is drawn, [N].

    uniform: all the same. novelty: in proportion to the novelty of the elite. least_tried: the cells from which the
    fewest centres have begun. fitness: in proportion to the fitness above the lowest. If all shares would be 0, all
    have the same.

    Args:
        settings: how novelty is computed.
        tried_C: number of centres that have begun from each cell, [cells]; used by least_tried alone.
    """
    share_N = np.ones(map_.size)
    if starts == "novelty":
        share_N = elite_novelty(map_, archive, settings)
    elif starts == "least_tried":
        assert tried_C is not None, "the search counts starts"
        tried_N = tried_C[map_.cell_N]
        share_N = (tried_N == tried_N.min()).astype(np.float64)
    elif starts == "fitness":
        share_N = map_.fitness_N.astype(np.float64) - map_.fitness_N.min()
    return share_N if share_N.any() else np.ones(map_.size)


def drawn_cell(map_: BehaviourMap, share_N: NDArray[np.float64], uniform: float) -> int:
    """The cell that a uniform random number in [0, 1) draws."""
    cumulative_N = np.add.accumulate(share_N)
    return int(map_.cell_N[np.searchsorted(cumulative_N, uniform * cumulative_N[-1], side="right")])


def elite_novelty(map_: BehaviourMap, archive: NoveltyArchive, settings: NoveltyConfig) -> NDArray[np.float64]:
    """Novelty of each elite's descriptor in the novelty archive without the elite's own entry, [N]."""
    return novelty(archive, map_.descriptor_N_B, **dict(settings), exclude_Q=_entries_of_elites(map_, archive))


def _entries_of_elites(map_: BehaviourMap, archive: NoveltyArchive) -> NDArray[np.int64]:
    """Index of each elite's own entry in the novelty archive, [N]; -1 for an elite without one.

    Entries are in the order of the asks, which need not be that of the centres.
    """
    centres = 1 + max(map_.centre_N.max(initial=0), archive.centre_N.max(initial=0))
    entry_N, elite_N = (entries.generation_N * centres + entries.centre_N for entries in (archive, map_))
    order = np.argsort(entry_N, kind="stable")
    found_N = np.append(order, -1)[np.searchsorted(entry_N, elite_N, sorter=order)]
    return np.where(np.append(entry_N, -1)[found_N] == elite_N, found_N, -1)
