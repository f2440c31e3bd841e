"""ME-ES: blocks of ES generations that start from elites of the behaviour map. Colas et al. 2020 (arXiv:2003.01825).

A block has `block_generations` generations. At its start an elite is drawn from the map and replaces the centre, with a
fresh optimiser. In the following generations the ES continues from its latest centre, whether or not its centres
entered the map. A block either explores, which climbs novelty, or exploits, which climbs fitness.

`emitters` blocks run side by side, each with a centre, an optimiser, a mode and a start cell of its own. All draw from
the map and the novelty archive as they were before the generation. Block b of emitter e has the mode of block b + e of
a single one, so that with `alternation: round_robin` half of the emitters explore at any time.

With `objectives`, the blocks of an emitter take these in turn instead; a block whose objective is not novelty counts as
exploiting where an elite is drawn.

The sources differ in how the elite is drawn (`cell_sampling`; its other values are those of `common.start_shares`):

* `top`, as in QDax, whose authors say they follow the paper. Exploring: one of the 5 most novel elites. Exploiting:
  with probability 1/2 one of the 2 fittest elites, else one of the 2 fittest of the 5 elites that entered last.
* `score`, as in the released code. Exploring: with probability 0.1 any elite, else one of the 5 most novel, with
  probability proportional to novelty. Exploiting: with probability 1/2, and always with fewer than 5 elites, the elite
  with the highest score; else one of the 2 elites with the highest scores among the min(5, half of all) cells that were
  filled last, with probability proportional to score - lowest score + 1.

Our own choices, for both: The novelty of an elite is that of its descriptor in the present novelty archive without the
elite's own entry (the released code uses values that are one generation old, and finds the own entry by distance 0). If
all novelties are 0, any elite is drawn. Of equally good elites the one whose cell was filled first counts as better.
While the map is empty (no centre has been valid yet, or a fork emptied the map), the search continues from its centre.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import Count, FitnessObjective, NoveltyObjective, Objective
from es_service.config.search import PresetRow
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import Algorithm, Ask, SearchState, from_elite
from es_service.search.algorithms.common import (
    TRIED,
    counted_starts,
    counting,
    drawn_cell,
    elite_novelty,
    novelty_search,
    population,
    start_shares,
)
from es_service.search.algorithms.measured import measuring, offering
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import EmittersSettings, settings_of
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.shaping import weight_of_fitness

MODE_CHOICE, CELL_CHOICE = 1, 2
"""Last ids of the random streams of Domain.SELECTION: for what a block does, and for the cell where it starts."""
MOST_NOVEL, FITTEST, NEWEST = 5, 2, 5
ANYWHERE = 0.1
"""Probability of exploring from any cell, with `cell_sampling: score`."""
Mode = Literal["explore", "exploit"]


class MeEsSettings(EmittersSettings):
    """Emitters, and the blocks that each of them runs."""

    alternation: Literal["round_robin", "coin"] = Field(
        "round_robin",
        description="How exploring and exploiting blocks follow each other. `round_robin`: in turn. `coin`: each "
        "block is chosen at random, with probability 1/2.",
    )
    first_block: Mode = Field(description="What the first block does with alternation `round_robin`.")
    block_generations: Count = Field(
        10,
        description="Generations in a block; each block starts from an elite drawn from the map, with a fresh "
        "optimiser.",
    )
    cell_sampling: Literal["top", "score", "uniform", "novelty", "least_tried", "fitness"] = Field(
        description="How the cell of that elite is drawn. `top`: as in QDax. `score`: as in the released code. The "
        "other values are those of `search.starts`."
    )

    presets = (
        PresetRow(
            "search.first_block", "explore", "exploit", "literature: QDax. uber: ME-ES, which flips its flag first."
        ),
        PresetRow("search.cell_sampling", "top", "score", "literature: QDax, which follows the paper. uber: ME-ES."),
    )
    needs_map = "whose blocks start from elites of the map"
    map_kinds = ("grid", "cvt", "dominated")


@method(MeEsSettings)
def me_es(config: RunConfig) -> Algorithm:
    """MAP-Elites with ES: blocks of exploring or exploiting generations that start from elites of the behaviour map."""
    search = settings_of(config, MeEsSettings)
    first = block_objective(search, config.seed, 1)
    shared = novelty_search(config, fitness_weight=weight_of_fitness(first), offer=offering(config))

    def objectives(state: SearchState, generation: int) -> list[Objective]:
        return [block_objective(search, config.seed, generation, emitter) for emitter in range(len(state.centres))]

    def start_cells(state: SearchState, generation: int) -> dict[int, int]:
        if (generation - 1) % search.block_generations or state.map is None or not state.map.size:
            return {}
        map_, cells, how = state.map, {}, search.cell_sampling
        modes: list[Mode] = [
            "exploit" if weight_of_fitness(emitter_objective) else "explore"
            for emitter_objective in objectives(state, generation)
        ]
        share_N = novelty_N = np.zeros(map_.size)
        if not (how == "top" or how == "score"):
            share_N = start_shares(how, map_, state.archive, config.novelty, state.extra.get(TRIED))
        elif "explore" in modes:
            novelty_N = elite_novelty(map_, state.archive, config.novelty)
        for emitter, mode in enumerate(modes):
            key = stream_keys(config.seed, Domain.SELECTION, generation, CELL_CHOICE, *_emitter_id(emitter))
            first, second = (float(u) for u in uniforms(key, np.arange(2, dtype=np.uint32)))
            if how == "top" or how == "score":
                share_N = cell_shares(map_, novelty_N, mode, how, first)
            cells[emitter] = drawn_cell(map_, share_N, second)
        return cells

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        return tuple(
            population(state, emitter, search, objective, generation)
            for emitter, objective in enumerate(objectives(state, generation))
        )

    restart = counting(partial(from_elite, elite_statistics=search.parent_statistics == "elite"))
    extra = counted_starts(config) if search.cell_sampling == "least_tried" else {}
    return measuring(config, replace(shared, ask=ask, start_cells=start_cells, restart=restart, extra=extra))


def block_objective(search: MeEsSettings, seed: int, generation: int, emitter: int = 0) -> Objective:
    """What an emitter's block in a generation (counted from 1) maximises."""
    if not search.objectives:
        return NoveltyObjective() if block_mode(search, seed, generation, emitter) == "explore" else FitnessObjective()
    block, several = (generation - 1) // search.block_generations, len(search.objectives)
    turn = int(several * _coin(seed, block, emitter)) if search.alternation == "coin" else block + emitter
    return search.objectives[turn % several]


def block_mode(search: MeEsSettings, seed: int, generation: int, emitter: int = 0) -> Mode:
    """Whether an emitter's block in a generation (counted from 1) explores or exploits."""
    if search.mode != "explore_exploit":
        return search.mode
    block = (generation - 1) // search.block_generations
    if search.alternation == "coin":
        return "explore" if _coin(seed, block, emitter) < 0.5 else "exploit"
    other: Mode = "exploit" if search.first_block == "explore" else "explore"
    return other if (block + emitter) % 2 else search.first_block


def _coin(seed: int, block: int, emitter: int) -> float:
    """A uniform random number in [0, 1) for an emitter's block."""
    key = stream_keys(seed, Domain.SELECTION, block, MODE_CHOICE, *_emitter_id(emitter))
    return float(uniforms(key, np.zeros(1, np.uint32))[0])


def _emitter_id(emitter: int) -> tuple[int, ...]:
    """What an emitter adds to the addresses of its random streams: nothing for the first."""
    return (emitter,) if emitter else ()


def cell_shares(
    map_: BehaviourMap,
    novelty_N: NDArray[np.float64],
    mode: Mode,
    sampling: Literal["top", "score"],
    drawn: float,
) -> NDArray[np.float64]:
    """Relative probability with which each filled cell of the map is drawn, [N] in the order of the map.

    Args:
        novelty_N: `elite_novelty` of the map; used only if the block explores.
        mode: what the block does.
        sampling: `search.cell_sampling`.
        drawn: a uniform random number in [0, 1), which decides where there are two ways of drawing.
    """
    share_N = np.zeros(map_.size)
    if mode == "explore":
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
        # Initial centres have no score: they rank last, and are drawn as if they had the lowest score.
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


def _best(values: NDArray, count: int) -> NDArray[np.intp]:
    """Indices of the `count` highest values, in descending order; of equal values the first comes first."""
    return np.argsort(-values, kind="stable")[:count]
