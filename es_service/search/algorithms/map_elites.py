"""MAP-Elites: policies descend from elites of the behaviour map. Mouret and Clune 2015 (arXiv:1504.04909).

A generation makes `batch` policies, evaluates each as it is, and offers it to the map. A policy has two parents, x and
y, which are drawn with equal probability from all filled cells, and is their iso+line variation (Vassiliades and Mouret
2018, arXiv:1804.03906):

    x + iso_sigma * a + line_sigma * b * (y - x)

a has a standard normal variate for each parameter, b is a single one. The default standard deviations 0.005 and 0.05
are those of the examples of QDax. Both parents may be the same elite. The policies are asked for as recipes, which
workers follow: only the parents travel, once to each worker (`protocol.policies`).

The map begins with `centres` random policies, which are the initial centres; later they matter only as elites. Our own
choices: while the map is empty (a fork emptied it), the parents are these. Policies run with mean 0 and standard
deviation 1 of observations, since nothing gathers statistics. The novelty archive has only the initial centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import CountAtOnce, Elites, MeasuredNewcomers, NotNegative, Once
from es_service.config.search import SearchConfig, same
from es_service.protocol.messages import FloatArray
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.protocol.policies import IsoLine, recipes_of
from es_service.search.algorithms.base import Algorithm, CentreEvaluation, PolicyAsk, SearchState, in_columns
from es_service.search.algorithms.common import add_to_archive, add_to_archive_and_map
from es_service.search.algorithms.measured import (
    LAYER_CHOICE,
    asked_again,
    drawn_rows,
    extra_of,
    kept_of,
    shares,
    told_of_samples,
)
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import ELITES, settings_of
from es_service.search.maps.behaviour_map import insert_each
from es_service.search.maps.kept import KeptPolicies

PARENT_CHOICE = 3
"""Last id of the random stream of Domain.SELECTION that draws the parents."""


class MapElitesSettings(SearchConfig):
    """Policies and their variation. The map begins with 32 random policies unless the config has another number, which
    is our own choice: the store keeps all of them, and for an ant each takes a megabyte."""

    batch: CountAtOnce = Field(
        256,
        description="Number of policies that a generation makes and evaluates; with another `search.elites.kind` "
        "than `once`, the number of its samples.",
    )
    iso_sigma: NotNegative = Field(
        0.005, description="Standard deviation of the noise in each parameter, in parameter units."
    )
    line_sigma: NotNegative = Field(
        0.05,
        description="Standard deviation of the step along the line through both parents, as a share of the distance "
        "between them.",
    )

    elites: Elites = Field(Once(), discriminator="kind", description=ELITES)

    presets = (
        same("policy.observation_normalization", False, "QDax; nothing could gather the statistics"),
        same("search.evaluation_episodes", 1, "QDax, which evaluates a policy once"),
    )
    first_centres = 32
    needs_map = "whose policies descend from elites of the map"
    map_kinds = ("grid", "cvt", "dominated")
    spread_by = ("search.iso_sigma", "search.line_sigma")

    def policies(self) -> int:
        return self.batch

    def spread_keys(self) -> tuple[str, ...]:
        return ("search.batch",)


@method(MapElitesSettings)
def map_elites(config: RunConfig) -> Algorithm:
    """MAP-Elites: mutations of the map's elites, each evaluated as it is and offered to the map."""
    search = settings_of(config, MapElitesSettings)
    if isinstance(search.elites, MeasuredNewcomers):
        return _with_measured_elites(config, search, search.elites)

    def ask(state: SearchState, generation: int) -> tuple[PolicyAsk, ...]:
        drawn, parent_N_2 = np.unique(parent_cells(config, state, generation), return_inverse=True)
        key_N_4 = stream_keys(config.seed, Domain.VARIATION, generation, np.arange(search.batch))
        rule = IsoLine(search.iso_sigma, search.line_sigma)
        return (PolicyAsk(recipes_of(rule, parents(state, drawn), parent_N_2.reshape(-1, 2), key_N_4)),)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        if evaluations[0].generation == 0:
            return add_to_archive_and_map(state, evaluations)
        told, map_ = in_columns(evaluations), state.map
        valid, generation = told.valid_N, told.generation
        if map_ is None or not valid.any():
            return state
        columns = told.centre_N[valid], told.population_max_N[valid]
        map_ = insert_each(map_, told.descriptor_N_B[valid], told.fitness_N[valid], generation, *columns, told.episodes)
        return replace(state, map=map_)

    return Algorithm(ask, tell)


def _with_measured_elites(config: RunConfig, search: MapElitesSettings, elites: MeasuredNewcomers) -> Algorithm:
    """MAP-Elites whose generation has `batch` samples: of new policies, and of kept ones that are measured again.

    Everything that it needs of the kept policies is in its own state, so it names no parents.
    """

    def of_generation(state: SearchState, generation: int) -> tuple[KeptPolicies, int, NDArray[np.int64]]:
        kept = kept_of(state)
        count, again = shares(elites, search.batch, kept.size)
        return kept, count, drawn_rows(config, elites, kept, generation, again)

    def ask(state: SearchState, generation: int) -> tuple[PolicyAsk, ...]:
        kept, count, rows = of_generation(state, generation)
        if kept.size:
            row_N_2 = parent_rows(config, elites, kept, state, generation)[:count]
            serials, index_N_2 = np.unique(kept.serial_K[row_N_2], return_inverse=True)
            named = kept.policy_K[np.argsort(kept.serial_K)[np.searchsorted(np.sort(kept.serial_K), serials)]]
        else:
            drawn, index_N_2 = np.unique(parent_cells(config, state, generation)[:count], return_inverse=True)
            named = parents(state, drawn)
        key_N_4 = stream_keys(config.seed, Domain.VARIATION, generation, np.arange(count))
        # Sample s of policy n has number s * count + n, and resets of its own.
        samples, rule = (elites.first_samples, 1), IsoLine(search.iso_sigma, search.line_sigma)
        recipes = recipes_of(rule, named, np.tile(index_N_2.reshape(-1, 2), samples), np.tile(key_N_4, samples))
        return (PolicyAsk(recipes), *asked_again(kept, rows))

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        told = in_columns(evaluations)
        if told.generation == 0:
            for evaluation in told:
                state = add_to_archive(state, evaluation)
            return told_of_samples(config, elites, state, told, np.arange(len(told))[:, None])
        _, count, rows = of_generation(state, told.generation)
        index_S_N = np.arange(elites.first_samples * count).reshape(-1, count)
        return told_of_samples(config, elites, state, told, index_S_N.T, rows, np.arange(index_S_N.size, len(told)))

    return Algorithm(ask, tell, extra=extra_of(config, elites), counts_samples=True)


def parents(state: SearchState, drawn: NDArray[np.int64]) -> Sequence[FloatArray] | NDArray[Any]:
    """The elites of some cells, by name; while the map is empty, the centres of these indices.

    Args:
        drawn: some of `parent_cells`, increasing.
    """
    map_ = state.map
    if map_ is None or not map_.size:
        return [state.centres[index].centre_D for index in drawn.tolist()]
    sorted_rows = np.argsort(map_.cell_N)
    return map_.policy_N[sorted_rows[np.searchsorted(map_.cell_N, drawn, sorter=sorted_rows)]]


def parent_rows(
    config: RunConfig, elites: MeasuredNewcomers, kept: KeptPolicies, state: SearchState, generation: int
) -> NDArray[np.int64]:
    """Indices on axis K of the two parents of each policy, [N, 2].

    Their cells are drawn as by `parent_cells`. A parent is the fittest policy of its cell or, with `replaces: any`, one
    that is drawn in proportion to its fitness above the lowest of the cell; if all are equal, any.
    """
    cell_N_2 = parent_cells(config, state, generation)
    first_N_2 = np.searchsorted(kept.cell_K, cell_N_2)
    if elites.replaces == "worst":
        return first_N_2
    last_N_2 = np.searchsorted(kept.cell_K, cell_N_2, side="right") - 1
    of_cell_K = np.searchsorted(kept.cell_K, kept.cell_K, side="right") - 1  # the least fit policy of its cell
    share_K = kept.fitness_K - kept.fitness_K[of_cell_K]
    share_K[share_K[np.searchsorted(kept.cell_K, kept.cell_K)] == 0.0] = 1.0  # of the fittest: all are equal
    until_K = np.add.accumulate(share_K)
    before_N_2 = np.append(0.0, until_K)[first_N_2]
    key = stream_keys(config.seed, Domain.SELECTION, generation, LAYER_CHOICE)
    drawn_N_2 = uniforms(key, np.arange(cell_N_2.size, dtype=np.uint32)).reshape(-1, 2).astype(np.float64)
    wanted_N_2 = before_N_2 + drawn_N_2 * (until_K[last_N_2] - before_N_2)
    return np.clip(np.searchsorted(until_K, wanted_N_2, side="right"), first_N_2, last_N_2)


def parent_cells(config: RunConfig, state: SearchState, generation: int) -> NDArray[np.int64]:
    """Cells of the two parents of each policy, [N, 2]; while the map is empty, indices of centres."""
    among = state.map.cell_N if state.map is not None and state.map.size else np.arange(len(state.centres))
    key, batch = (
        stream_keys(config.seed, Domain.SELECTION, generation, PARENT_CHOICE),
        settings_of(config, MapElitesSettings).batch,
    )
    drawn_N_2 = uniforms(key, np.arange(2 * batch, dtype=np.uint32)).reshape(-1, 2)
    return among[(drawn_N_2.astype(np.float64) * among.size).astype(np.int64)]
