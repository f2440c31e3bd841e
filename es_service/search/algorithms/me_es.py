"""ME-ES: ES steps between elites of a behaviour map. Colas et al. 2020 (arXiv:2003.01825).

Generations come in blocks of `block_generations`. Before a block an elite is drawn from the map and takes the centre's
place with a fresh optimiser; inside it the ES climbs from wherever it has come, whether or not its centres entered the
map. A block either explores, climbing novelty among all centres ever evaluated, or exploits, climbing fitness.

How the cell is drawn, no two sources agree on (`cell_sampling`). `top`, as QDax has it, whose authors say they follow
the paper: exploring, one of the 5 most novel elites; exploiting, with probability a half each, one of the 2 fittest, or
one of the 2 fittest of the 5 that entered last. `score`, as in the released code: exploring, any elite with probability
0.1, else one of the 5 most novel in proportion to novelty; exploiting, with probability a half (and always with fewer
than 5 elites) the one with the highest score, else, of the newest min(5, half of all) cells, one of the 2 with the
highest scores in proportion to score - lowest score + 1.

Our choices, in both: an elite's novelty is that of its descriptor in today's archive without its own entry (the
released code lets it grow a generation old, and finds the own entry by distance 0), where all are 0 any elite is drawn;
of equal elites the one in the cell that was filled first counts as better. While the map is empty, as long as no centre
has been valid or after a fork that emptied it, the search goes on from where it is.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import NoveltyConfig, RunConfig, SearchConfig
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import Algorithm, Ask, SearchState, from_elite
from es_service.search.algorithms.steps import novelty_search
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.novelty import NoveltyArchive, novelty

MODE_CHOICE, CELL_CHOICE = 1, 2
"""Last ids of the streams of Domain.SELECTION: what a block does, where it starts."""
MOST_NOVEL, FITTEST, NEWEST = 5, 2, 5
ANYWHERE = 0.1
"""Probability of exploring from any cell, with `cell_sampling: score`."""
Mode = Literal["explore", "exploit"]


def me_es(config: RunConfig) -> Algorithm:
    """MAP-Elites with ES: blocks of exploring or exploiting generations from elites of the behaviour map."""
    search = config.search
    shared = novelty_search(config, fitness_weight=_weight(block_mode(search, config.seed, 1)))

    def start_cell(state: SearchState, generation: int) -> int | None:
        if (generation - 1) % search.block_generations or state.map is None or not state.map.size:
            return None
        key = stream_keys(config.seed, Domain.SELECTION, generation, CELL_CHOICE)
        first, second = (float(u) for u in uniforms(key, np.arange(2, dtype=np.uint32)))
        mode = block_mode(search, config.seed, generation)
        share_N = cell_shares(state.map, state.archive, config.novelty, mode, search.cell_sampling, first)
        cumulative_N = np.add.accumulate(share_N)
        return int(state.map.cell_N[np.searchsorted(cumulative_N, second * cumulative_N[-1], side="right")])

    def ask(state: SearchState, generation: int) -> Ask:
        return Ask(0, state.centres[0].centre_D, _weight(block_mode(search, config.seed, generation)))

    restart = partial(from_elite, own_statistics=search.parent_statistics == "elite")
    return replace(shared, ask=ask, start_cell=start_cell, restart=restart)


def block_mode(search: SearchConfig, seed: int, generation: int) -> Mode:
    """What the block does that a generation (from 1 on) belongs to."""
    if search.mode != "explore_exploit":
        return search.mode
    block = (generation - 1) // search.block_generations
    if search.alternation == "coin":
        key = stream_keys(seed, Domain.SELECTION, block, MODE_CHOICE)
        return "explore" if float(uniforms(key, np.zeros(1, np.uint32))[0]) < 0.5 else "exploit"
    other: Mode = "exploit" if search.first_block == "explore" else "explore"
    return other if block % 2 else search.first_block


def cell_shares(
    map_: BehaviourMap,
    archive: NoveltyArchive,
    settings: NoveltyConfig,
    mode: Mode,
    sampling: Literal["top", "score"],
    drawn: float,
) -> NDArray[np.float64]:
    """In what proportions the filled cells are drawn from, [N]; 0 for those that are not.

    Args:
        drawn: uniform in [0, 1); chooses between two ways of drawing where there are two.
    """
    share_N = np.zeros(map_.size)
    if mode == "explore":
        novelty_N = elite_novelty(map_, archive, settings)
        top = _best(novelty_N, MOST_NOVEL)
        if not novelty_N.any() or (sampling == "score" and drawn < ANYWHERE):
            share_N[:] = 1.0
        elif sampling == "top":
            share_N[top] = 1.0
        else:
            share_N[top] = novelty_N[top]
    elif sampling == "top":
        newest = np.arange(map_.size) if drawn < 0.5 else np.sort(_best(map_.generation_N, NEWEST))
        share_N[newest[_best(map_.fitness_N[newest], FITTEST)]] = 1.0
    else:
        # Initial centres have no score: they come last, and count as much as the lowest.
        known_N = np.isfinite(map_.score_N)
        lowest = map_.score_N[known_N].min() if known_N.any() else 0.0
        score_N = np.where(known_N, map_.score_N, -np.inf)
        if drawn < 0.5 or map_.size < NEWEST:
            share_N[_best(score_N, 1)] = 1.0
        else:
            newest = np.arange(map_.size - min(NEWEST, map_.size // 2), map_.size)
            two = newest[_best(score_N[newest], FITTEST)]
            share_N[two] = np.maximum(score_N[two], lowest) - lowest + 1.0
    return share_N


def elite_novelty(map_: BehaviourMap, archive: NoveltyArchive, settings: NoveltyConfig) -> NDArray[np.float64]:
    """Novelty of each elite's descriptor in the archive without the entry it made itself, [N]."""
    return novelty(
        archive,
        map_.descriptor_N_B,
        neighbours=settings.neighbours,
        distance=settings.distance,
        exclude_Q=_own_entries(map_, archive),
    )


def _own_entries(map_: BehaviourMap, archive: NoveltyArchive) -> NDArray[np.int64]:
    """Index of the entry that each elite made, [N]; -1 of one that made none. Entries ascend by generation and, among
    those of generation 0, centre."""
    centres = 1 + max(map_.centre_N.max(initial=0), archive.centre_N.max(initial=0))
    entry_N, elite_N = (one.generation_N * centres + one.centre_N for one in (archive, map_))
    found_N = np.searchsorted(entry_N, elite_N)
    is_there_N = np.append(entry_N, -1)[found_N] == elite_N
    return np.where(is_there_N, found_N, -1)


def _weight(mode: Mode) -> float:
    return 1.0 if mode == "exploit" else 0.0


def _best(values: NDArray, count: int) -> NDArray[np.intp]:
    """Indices of the highest values, descending; of equal ones the first."""
    return np.argsort(-values, kind="stable")[:count]
