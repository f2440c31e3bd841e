"""MEMES: many evolution strategies side by side on one behaviour map. Flageat et al. 2024 (arXiv:2303.06137).

`emitters` evolution strategies run side by side as in ME-ES, but each keeps one objective: with `mode: explore_exploit`
every second emitter, beginning with the first, explores, which climbs novelty, and the others exploit, which climb
fitness. There are no blocks of a fixed length. An emitter is reset at the start of a generation if none of its centres
has entered the map in the last `stagnation_generations` generations: an elite replaces its centre, with a fresh
optimiser, and the count of its generations begins again. The elite is drawn as `starts` says, by default with equal
probability from all filled cells. A centre that another centre of its generation replaced at once has not entered.

This follows the released code (adaptive-intelligent-robotics/MEMES), with two differences: its emitters of one
objective come first and the others after them, and it resets one generation later (it compares with >).

Our own choices: while the map is empty, no emitter is reset; `objectives` gives emitters others than novelty and
fitness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import Count, FitnessObjective, NoveltyObjective, Objective
from es_service.config.search import same
from es_service.protocol.content import Policy
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import (
    NO_CELL,
    Algorithm,
    Ask,
    CentreEvaluation,
    SearchState,
    from_elite,
    read_only,
)
from es_service.search.algorithms.common import (
    TRIED,
    Starts,
    counted_starts,
    counting,
    drawn_cell,
    novelty_search,
    population,
    start_shares,
)
from es_service.search.algorithms.measured import measuring, offering
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import EmittersSettings, settings_of
from es_service.search.shaping import weight_of_fitness

RESET_CHOICE = 4
"""Last id of the random stream of Domain.SELECTION that draws the cells from which emitters begin again."""
STAGNANT = "stagnant"
"""Name of the search's own array [emitters]: newest generations in which no centre of an emitter entered the map."""
AGE = "age"
"""Name of the search's own array [emitters]: generations since an emitter began, if `exploit_generations` is given."""


class MemesSettings(EmittersSettings):
    """Emitters, and when they begin again."""

    stagnation_generations: Count = Field(
        32,
        description="Generations after which an emitter none of whose centres has entered the map since then begins "
        "again from an elite, with a fresh optimiser.",
    )
    exploit_generations: Count | None = Field(
        None,
        description="Generations after which an emitter that does not climb novelty begins again, even if its centres "
        "still enter the map. So small gains at one place do not hold it there for ever. `null`: never.",
    )
    starts: Starts = Field(
        "uniform",
        description="How the elite is drawn from which an emitter begins again. `uniform`: any. `novelty`: in "
        "proportion to its novelty. `least_tried`: one of the cells from which the fewest emitters have begun. "
        "`fitness`: in proportion to its fitness above the lowest.",
    )

    presets = (
        same("policy.observation_normalization", False, "the code of MEMES, which has none"),
        same("policy.action_noise", 0.0, "the code of MEMES, which has none"),
        same("search.emitters", 16, "an eighth of the 128 of the code of MEMES, sized for one machine"),
        same("search.pairs", 32, "an eighth of the 512 members of the code of MEMES, sized for one machine"),
        same("search.step.l2", 0.0, "the code of MEMES"),
        same("search.evaluation_episodes", 1, "the code of MEMES, which evaluates a centre once"),
        same("novelty.newest", 50_000, "the code of MEMES, whose novelty archive keeps no more"),
    )
    needs_map = "whose emitters begin again from elites of the map"
    map_kinds = ("grid", "cvt", "dominated")


@method(MemesSettings)
def memes(config: RunConfig) -> Algorithm:
    """MAP-Elites with many ES: each explores or exploits, until its centres no longer enter the map."""
    search = settings_of(config, MemesSettings)
    first = emitter_objective(search, 0)
    shared = novelty_search(config, fitness_weight=weight_of_fitness(first), offer=offering(config))

    def start_cells(state: SearchState, generation: int) -> dict[int, int]:
        if state.map is None or not state.map.size:
            return {}
        key = stream_keys(config.seed, Domain.SELECTION, generation, RESET_CHOICE)
        drawn_M = uniforms(key, np.arange(len(state.centres), dtype=np.uint32)).astype(np.float64)
        is_reset_M = state.extra[STAGNANT] >= search.stagnation_generations
        if search.exploit_generations is not None:
            is_reset_M = is_reset_M | (exploits_M & (state.extra[AGE] >= search.exploit_generations))
        if not is_reset_M.any():
            return {}
        share_N = start_shares(search.starts, state.map, state.archive, config.novelty, state.extra.get(TRIED))
        return {
            int(emitter): drawn_cell(state.map, share_N, drawn_M[emitter]) for emitter in np.flatnonzero(is_reset_M)
        }

    def restart(state: SearchState, index: int, cell: int, elite: Policy) -> SearchState:
        counts = {name: counts_M for name, counts_M in state.extra.items() if name in (STAGNANT, AGE)}
        zeroed = {name: np.where(np.arange(counts_M.size) == index, 0, counts_M) for name, counts_M in counts.items()}
        return elite_restart(replace(state, extra=read_only({**state.extra, **zeroed})), index, cell, elite)

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        return tuple(
            population(state, emitter, search, emitter_objective(search, emitter), generation)
            for emitter in range(len(state.centres))
        )

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        state = shared.tell(state, evaluations)
        entered_M = np.array([centre.cell != NO_CELL for centre in state.centres])
        counts = {STAGNANT: np.where(entered_M, 0, state.extra[STAGNANT] + 1)}
        if AGE in state.extra and evaluations[0].generation > 0:  # generation 0 evaluates what the others begin with
            counts[AGE] = state.extra[AGE] + 1
        return replace(state, extra=read_only({**state.extra, **counts}))

    exploits_M = np.array(
        [weight_of_fitness(emitter_objective(search, emitter_index)) > 0.0 for emitter_index in range(search.emitters)]
    )
    elite_restart = counting(partial(from_elite, elite_statistics=search.parent_statistics == "elite"))
    extra = {STAGNANT: np.zeros(search.emitters, np.int64)}
    if search.exploit_generations is not None:
        extra[AGE] = np.zeros(search.emitters, np.int64)
    if search.starts == "least_tried":
        extra |= counted_starts(config)
    return measuring(config, replace(shared, start_cells=start_cells, restart=restart, ask=ask, tell=tell, extra=extra))


def emitter_objective(search: MemesSettings, emitter: int) -> Objective:
    if search.objectives:
        return search.objectives[emitter % len(search.objectives)]
    explores = emitter % 2 == 0 if search.mode == "explore_exploit" else search.mode == "explore"
    return NoveltyObjective() if explores else FitnessObjective()
