"""A search of one's own that measures its elites again, so that what was luck falls, moves to another cell or leaves.

es-service run my_config.yaml --set search.algorithm=reevaluated_elites:reevaluated_elites --set map.enabled=true
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.search import PopulationConfig
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import Algorithm, Ask, CentreEvaluation, PolicyAsk, SearchState
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of
from es_service.search.maps.behaviour_map import resampled

DRAW = 100
"""Last id of the random stream of Domain.SELECTION that draws the elites; those of shipped searches are below."""


class ReevaluatedSettings(PopulationConfig):
    """The keys of every method that perturbs centres, and one more: `search.again`."""

    again: int = Field(
        4, ge=1, description="Elites that a generation draws, with equal probability, and measures again."
    )
    needs_map = "whose elites it measures again"


@method(ReevaluatedSettings)
def reevaluated_elites(config: RunConfig) -> Algorithm:
    """ES whose map has the means of all samples of its elites, and counts how many have left each cell."""

    shared = novelty_search(config, fitness_weight=1.0)
    again = settings_of(config, ReevaluatedSettings).again

    def drawn(state: SearchState, generation: int) -> list[int]:
        if state.map is None or not state.map.size:
            return []
        key = stream_keys(config.seed, Domain.SELECTION, generation, DRAW)
        drawn_N = uniforms(key, np.arange(again, dtype=np.uint32)).astype(np.float64)
        return np.unique(state.map.cell_N[(drawn_N * state.map.size).astype(int)]).tolist()

    def ask(state: SearchState, generation: int) -> tuple[Ask | PolicyAsk, ...]:
        rows = [state.map.row_of(cell) for cell in drawn(state, generation)]
        policies = [PolicyAsk(state.map.policy_N[rows])] if rows else []  # asked for by name
        return (*shared.ask(state, generation), *policies)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        count, before, map_, left = len(state.centres), state.map, state.map, dict(state.extra["left"])
        samples = [one for one in evaluations if one.centre >= count]
        for cell, one in zip(drawn(state, evaluations[0].generation), samples, strict=bool(samples)):
            row = before.row_of(cell)
            if not one.valid or map_.cell_of(before.generation_N[row], before.centre_N[row]) != cell:
                continue  # another elite that was measured again has taken its place
            map_, at, is_there = resampled(map_, cell, one.descriptor_B, one.fitness, one.episodes)
            if at != cell or not is_there:
                left[str(cell)] = left.get(str(cell), np.array(0)) + 1
        state = replace(state, map=map_, extra={"left": left})
        return shared.tell(state, tuple(one for one in evaluations if one.centre < count))

    return replace(shared, ask=ask, tell=tell, counts_samples=True, extra={"left": {}})
