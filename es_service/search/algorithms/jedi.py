"""JEDi: evolution strategies towards targets that a model of the map finds promising. Templier et al. 2024
(arXiv:2405.04308).

`emitters` evolution strategies run side by side, each for `target_generations` generations towards one target, a
descriptor. Then each gets a new one. A Gaussian process is fitted to the fitness of the elites at their descriptors. A
cell of which the process expects much, or knows little, can be a target: the middles of all cells that no other cell
exceeds in both expected fitness and variance are the candidates, and each emitter draws one of these with equal
probability. It starts from the elite whose descriptor is nearest to its target, with a fresh optimiser.

Members rank by nearness to the target and fitness, each scaled to its range in the population; the weight of nearness
goes from `target_weight_start` to `target_weight` along the generations of a target. In the model, the variance of an
elite's value is `model_noise` of the variance of all values, divided by the number of centres that ended in its cell,
so that a cell that was visited once stays uncertain.

Differences from the released code: the strategies take the steps of `search.step` instead of those of CMA-ES, only
centres and not all members enter the map, and the noise of the model is a setting. While the map is empty, emitters
climb fitness. The process is fitted in one thread, so that its bits do not depend on the number of cores; they may
depend on the kind of processor.

Axes: M emitters, N elites, C candidate cells, B descriptor dimensions.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from es_service.config.model import RunConfig
from es_service.config.parts import Count, CountAtOnce, FitnessObjective, Fraction, NearnessObjective, Positive
from es_service.config.search import PopulationConfig, same
from es_service.errors import ConfigError, WayOut
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import Algorithm, Ask, CentreEvaluation, SearchState, read_only
from es_service.search.algorithms.common import novelty_search, population
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.maps.geometry import cell_count, tessellation

TARGET_CHOICE = 5
"""Last id of the random stream of Domain.SELECTION that draws the targets."""
TARGET, VISITS = "target", "visits"
"""Names of the search's own arrays: the target of each emitter [M, B], NaN for none; and the number of valid centres
that ended in each cell [cells]."""
MOST_POINTS = 1024
"""Most elites to which the model is fitted, and most cells that can be targets; of more, evenly spaced ones are taken.
The time of a fit grows with the cube of this."""


class JediSettings(PopulationConfig):
    """Emitters, their targets, and the model of the map."""

    emitters: CountAtOnce = Field(
        4,
        description="Number of evolution strategies side by side, with `search.pairs` pairs each in every generation.",
    )
    target_generations: Count = Field(100, description="Generations after which each emitter gets a new target.")
    target_weight_start: Fraction = Field(
        1.0, description="Weight of nearness to the target beside fitness in the first generation of a target."
    )
    target_weight: Fraction = Field(0.3, description="The same in the last one; in between it changes linearly.")
    model_noise: Positive = Field(
        0.1,
        description="Variance of one evaluation of an elite in the model of the map, as a share of the variance of the "
        "elites' fitness.",
    )

    presets = (
        same("search.sigma", 0.05, "the code of JEDi"),
        same("search.pairs", 128, "the code of JEDi on Brax, populations of 256"),
    )
    only_centres = "search.emitters"
    needs_map = "whose emitters start from elites of the map"

    def populations(self) -> int:
        return self.emitters

    def spread_keys(self) -> tuple[str, ...]:
        return ("search.emitters",)


@method(JediSettings)
def jedi(config: RunConfig) -> Algorithm:
    """Quality diversity by targets: ES towards cells of which a model of the map expects much or knows little."""
    require_model()
    search = settings_of(config, JediSettings)
    shared = novelty_search(config, fitness_weight=1.0)

    def start_cells(state: SearchState, generation: int) -> dict[int, int]:
        target_M_B = state.extra[TARGET]
        if state.map is None or not state.map.size:
            return {}
        if (generation - 1) % search.target_generations or np.isnan(target_M_B).any():
            return {}
        distance_M_N = np.linalg.norm(target_M_B[:, None] - state.map.descriptor_N_B, axis=-1)
        return {emitter: int(state.map.cell_N[nearest]) for emitter, nearest in enumerate(distance_M_N.argmin(axis=1))}

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        weight, is_empty = target_weight(search, generation), _has_no_elites(state)
        objectives = [
            FitnessObjective()
            if is_empty or np.isnan(target_B).any()
            else NearnessObjective(descriptor=tuple(target_B.tolist()), weight=weight)
            for target_B in state.extra[TARGET]
        ]
        return tuple(
            population(state, emitter, search, objective, generation) for emitter, objective in enumerate(objectives)
        )

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        was_empty = _has_no_elites(state)  # also in a fork whose task has other places
        state, generation, extra = shared.tell(state, evaluations), evaluations[0].generation, dict(state.extra)
        if was_empty:
            extra[VISITS] = np.zeros_like(extra[VISITS])
        valid = [evaluation.descriptor_B for evaluation in evaluations if evaluation.valid]
        if valid and state.map is not None:
            cells = tessellation(state.map.geometry)
            cell_N, size = cells.cells_of(np.array(valid)), cells.size
            extra[VISITS] = extra[VISITS] + np.bincount(cell_N, minlength=size)
        if generation % search.target_generations == 0 and state.map is not None and state.map.size:
            candidate_C_B = promising(state.map, extra[VISITS], search.model_noise)
            key = stream_keys(config.seed, Domain.SELECTION, generation, TARGET_CHOICE)
            drawn_M = uniforms(key, np.arange(search.emitters, dtype=np.uint32)).astype(np.float64)
            extra[TARGET] = candidate_C_B[(drawn_M * len(candidate_C_B)).astype(np.int64)]
        return replace(state, extra=read_only(extra))

    dimensions = len(config.map.bounds)
    extra = {TARGET: np.full((search.emitters, dimensions), np.nan), VISITS: np.zeros(cell_count(config.map), np.int64)}
    return replace(shared, start_cells=start_cells, ask=ask, tell=tell, extra=extra)


def _has_no_elites(state: SearchState) -> bool:
    return state.map is None or not state.map.size


def target_weight(search: JediSettings, generation: int) -> float:
    """Weight of nearness in a generation, counted from 1."""
    last = search.target_generations - 1
    share = (generation - 1) % search.target_generations / last if last else 1.0
    return search.target_weight_start + share * (search.target_weight - search.target_weight_start)


def promising(map_: BehaviourMap, visits: NDArray[np.int64], noise: float) -> NDArray[np.float64]:
    """Middles of the cells that no other cell exceeds in expected fitness and in variance, [C, B].

    Args:
        map_: a map with at least one elite.
        visits: number of centres that ended in each cell, [cells].
        noise: `search.model_noise`.
    """
    rows = _spread(map_.size)
    low_B, high_B = np.array(map_.geometry.bounds, np.float64).T
    middle_C_B = tessellation(map_.geometry).middles_of(_spread(map_.geometry.size))
    mean_C, std_C = predicted(
        (map_.descriptor_N_B[rows] - low_B) / (high_B - low_B),
        map_.fitness_N[rows].astype(np.float64),
        noise / np.maximum(visits[map_.cell_N[rows]], 1),
        (middle_C_B - low_B) / (high_B - low_B),
    )
    return middle_C_B[is_not_dominated(mean_C, std_C)]


def predicted(
    place_N_B: NDArray[np.float64],
    fitness_N: NDArray[np.float64],
    noise_N: NDArray[np.float64],
    at_C_B: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of a Gaussian process at places, in units of the standardised fitness, [C] each.

    Its kernel is a scale times a radial basis function, whose scale and length maximise the likelihood.

    Args:
        place_N_B: descriptors of the elites, scaled to the bounds of the map.
        fitness_N: their fitness.
        noise_N: variance of each value, in units of the variance of all.
        at_C_B: places, scaled likewise.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel
    from threadpoolctl import threadpool_limits

    spread = float(fitness_N.std())
    standard_N = (fitness_N - fitness_N.mean()) / (spread or 1.0)
    kernel = ConstantKernel(1.0, (1e-2, 1e2)) * RBF(0.2, (1e-2, 1e1))
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length or a scale at the end of its range is as good as any
        options: dict[str, Any] = {"alpha": noise_N}
        model = GaussianProcessRegressor(kernel, **options).fit(place_N_B, standard_N)
        mean_C, std_C = model.predict(at_C_B, return_std=True)
    return np.asarray(mean_C, np.float64), np.asarray(std_C, np.float64)


def is_not_dominated(first_C: NDArray[np.float64], second_C: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether no other candidate is at least as high in both values and higher in one, [C]."""
    order = np.lexsort((-second_C, -first_C))
    is_undominated_C = np.zeros(first_C.size, bool)
    highest, equal = -np.inf, (np.nan, np.nan)
    for index in order:
        values = (first_C[index], second_C[index])
        if values[1] > highest or values == equal:
            is_undominated_C[index], highest, equal = True, max(highest, values[1]), values
    return is_undominated_C


def require_model() -> None:
    """Raise ConfigError if the package of the model is not installed."""
    if importlib.util.find_spec("sklearn") is None:
        raise ConfigError(
            "search.algorithm: this search needs scikit-learn for the model of its map",
            field="search.algorithm",
            ways_out=[WayOut("install", "install it", extra="jedi")],
        )


def _spread(count: int) -> NDArray[np.int64]:
    """All of `count` indices, or MOST_POINTS evenly spaced ones."""
    most = min(count, MOST_POINTS)
    return np.arange(most) * count // most
