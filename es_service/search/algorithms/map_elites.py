"""MAP-Elites: policies descend from elites of the behaviour map. Mouret and Clune 2015 (arXiv:1504.04909).

A generation makes `batch` policies, evaluates each as it is, and offers it to the map. A policy has two parents, x and
y, which are drawn with equal probability from all filled cells, and is their iso+line variation (Vassiliades and Mouret
2018, arXiv:1804.03906):

    x + iso_sigma * a + line_sigma * b * (y - x)

a has a standard normal variate for each parameter, b is a single one. The default standard deviations 0.005 and 0.05
are those of the examples of QDax. Both parents may be the same elite. The policies are asked for as recipes, which
workers follow: only the parents travel, once to each worker (`protocol.recipes`).

The map begins with `centres` random policies, which are the initial centres; later they matter only as elites. Our own
choices: while the map is empty (a fork emptied it), the parents are these. Policies run with mean 0 and standard
deviation 1 of observations, since nothing gathers statistics. The novelty archive has only the initial centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from es_service.config.fields import Count, NotNegative
from es_service.config.model import RunConfig
from es_service.config.presets import same
from es_service.config.search import SearchConfig
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.protocol.recipes import IsoLine, recipes_of
from es_service.search.algorithms.base import Algorithm, CentreEvaluation, PolicyAsk, SearchState, in_columns
from es_service.search.algorithms.common import archived_and_mapped
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of
from es_service.search.maps.batches import insert_each

PARENT_CHOICE = 3
"""Last id of the random stream of Domain.SELECTION that draws the parents."""


class MapElitesSettings(SearchConfig):
    """Policies and their variation. The map begins with 32 random policies unless the config has another number, which
    is our own choice: the store keeps all of them, and for an ant each takes a megabyte."""

    batch: Count = Field(256, description="Number of policies that a generation makes and evaluates.")
    iso_sigma: NotNegative = Field(
        0.005, description="Standard deviation of the noise in each parameter, in parameter units."
    )
    line_sigma: NotNegative = Field(
        0.05,
        description="Standard deviation of the step along the line through both parents, as a share of the distance "
        "between them.",
    )

    presets = (
        same("policy.observation_normalization", False, "QDax; nothing could gather the statistics"),
        same("search.evaluation_episodes", 1, "QDax, which evaluates a policy once"),
    )
    first_centres = 32
    needs_map = "whose policies descend from elites of the map"

    def policies(self) -> int:
        """A batch."""
        return self.batch

    def spread_keys(self) -> tuple[str, ...]:
        """The key that makes more policies."""
        return ("search.batch",)


@method(MapElitesSettings)
def map_elites(config: RunConfig) -> Algorithm:
    """MAP-Elites: mutations of the map's elites, each evaluated as it is and offered to the map."""
    search = settings_of(config, MapElitesSettings)

    def parents(state: SearchState, generation: int) -> list[int]:
        has_elites = state.map is not None and state.map.size
        return np.unique(parent_cells(config, state, generation)).tolist() if has_elites else []

    def ask(state: SearchState, generation: int) -> tuple[PolicyAsk, ...]:
        known = {cell: elite.centre_D for cell, elite in state.elites.items()}
        known = known or {index: centre.centre_D for index, centre in enumerate(state.centres)}
        drawn, drawn_N_2 = np.unique(parent_cells(config, state, generation), return_inverse=True)
        key_N_4 = stream_keys(config.seed, Domain.VARIATION, generation, np.arange(search.batch))
        parents = [known[one] for one in drawn.tolist()]
        rule = IsoLine(search.iso_sigma, search.line_sigma)
        return (PolicyAsk(recipes_of(rule, parents, drawn_N_2.reshape(-1, 2), key_N_4)),)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        if evaluations[0].generation == 0:
            return archived_and_mapped(state, evaluations)
        told, map_ = in_columns(evaluations), state.map
        valid, generation = told.valid_N, told.generation
        if map_ is None or not valid.any():
            return state
        columns = told.centre_N[valid], told.population_max_N[valid]
        map_ = insert_each(map_, told.descriptor_N_B[valid], told.fitness_N[valid], generation, *columns, told.episodes)
        return replace(state, map=map_)

    return Algorithm(ask, tell, parents=parents)


def parent_cells(config: RunConfig, state: SearchState, generation: int) -> NDArray[np.int64]:
    """Cells of the two parents of each policy, [N, 2]; while the map is empty, indices of centres."""
    among = state.map.cell_N if state.map is not None and state.map.size else np.arange(len(state.centres))
    key, batch = (
        stream_keys(config.seed, Domain.SELECTION, generation, PARENT_CHOICE),
        settings_of(config, MapElitesSettings).batch,
    )
    drawn_N_2 = uniforms(key, np.arange(2 * batch, dtype=np.uint32)).reshape(-1, 2)
    return among[(drawn_N_2.astype(np.float64) * among.size).astype(np.int64)]
