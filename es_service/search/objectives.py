"""What members are ranked by: an objective gives each member a value, and shaping makes utilities of the values.

Axes: P pairs, S signs [+, -], E episodes, B descriptor dimensions. The functions take results with any leading axes,
[P, S] of a population or [E] of a centre's evaluation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.config.parts import (
    FitnessObjective,
    MixtureObjective,
    NearnessObjective,
    NoveltyObjective,
    Objective,
    Shaping,
    TargetObjective,
)
from es_service.config.sections import NoveltyConfig
from es_service.protocol.messages import EpisodesResult
from es_service.search.novelty import NoveltyArchive, novelty
from es_service.search.shaping import centred_ranks, shaped


def weight_of_fitness(objective: Objective) -> float:
    """Weight of fitness beside novelty, for the history: 0 for novelty, 1 for what does not look at novelty."""
    if isinstance(objective, MixtureObjective):
        return objective.weight
    return 0.0 if isinstance(objective, NoveltyObjective) else 1.0


def weighted(weight: float) -> Objective:
    """The objective with a weight of fitness beside novelty, from 0 to 1."""
    plain = {0.0: NoveltyObjective(), 1.0: FitnessObjective()}
    return plain.get(weight) or MixtureObjective(weight=weight)


def utilities(
    objective: Objective,
    results: EpisodesResult,
    archive: NoveltyArchive,
    settings: NoveltyConfig,
    shaping: Shaping,
) -> NDArray[np.float64]:
    """Utility of each member of a population, [P, S].

    A mixture is (1 - weight) * shaped novelty + weight * shaped fitness, each shaped by itself, so that their scales do
    not matter. An invalid member (fitness NaN) is the worst by any objective.

    Args:
        results: results of the population, [P, S].
        archive: the novelty archive as it was before the generation.
        settings: how novelty is computed.
        shaping: how values become utilities.
    """
    weight = weight_of_fitness(objective)
    utility_P_S = np.zeros(results.fitness.shape)
    if weight > 0.0:
        utility_P_S += weight * shaped(shaping, values(objective, results))
    if weight < 1.0:
        novelty_P_S = novelty(archive, results.descriptor, **dict(settings))
        novelty_P_S[np.isnan(results.fitness)] = np.nan
        utility_P_S += (1.0 - weight) * shaped(shaping, novelty_P_S)
    return utility_P_S


def values(objective: Objective, results: EpisodesResult) -> NDArray:
    """Value of each episode or member by an objective, with the leading axes of the results; higher is better.

    Of a mixture it is that of fitness; novelty has none without an archive, and counts as fitness too. Invalid ones
    (fitness NaN) have NaN.
    """
    if isinstance(objective, TargetObjective):
        return target_values(objective, results.fitness, results.descriptor)
    if isinstance(objective, NearnessObjective):
        return nearness_values(objective, results.fitness, results.descriptor)
    of: dict[str, Callable[[], NDArray]] = {
        "return": lambda: results.returns,
        "final": lambda: results.outputs["last_reward"],
        "goal_distance": lambda: -results.goal_distance[..., 0],
    }
    value = of.get(objective.kind, lambda: results.fitness)()
    return np.where(np.isnan(results.fitness), np.nan, value)


def target_values(target: TargetObjective, fitness: ArrayLike, descriptor_B: ArrayLike) -> NDArray[np.float64]:
    """Ranks from -0.5 to 0.5 by a target set: inside, by fitness; outside, below all of those, by distance from it.

    So the first aim is that as many members as possible end in the set, and fitness decides only among those that do.
    Ranks and not values, since the scales of fitness and of distances have nothing to do with each other. Equal ones
    share the mean of their ranks. Members whose fitness or descriptor is not finite are NaN.

    Args:
        target: the set, a ball of descriptors; its border is inside.
        fitness: fitness of every member, any shape.
        descriptor_B: their descriptors, the same shape with a last axis B.

    Source: ARIA, Grillotti et al. 2023 (arXiv:2304.03672), whose set is a cell and which adds a large constant to the
    fitness inside.
    """
    fitness = np.asarray(fitness, np.float64)
    distance = np.linalg.norm(np.asarray(descriptor_B, np.float64) - np.asarray(target.descriptor), axis=-1)
    is_valid = np.isfinite(fitness) & np.isfinite(distance)
    is_inside = is_valid & (distance <= target.radius)
    keys = np.stack([is_inside.astype(np.float64), np.where(is_inside, fitness, -distance)], axis=-1)
    keys[~is_valid] = -np.inf
    _, place = np.unique(keys.reshape(-1, 2), axis=0, return_inverse=True)  # in the order of the first, then the second
    return np.where(is_valid, centred_ranks(place.reshape(fitness.shape)), np.nan)


def nearness_values(near: NearnessObjective, fitness: ArrayLike, descriptor_B: ArrayLike) -> NDArray[np.float64]:
    """weight * nearness to a descriptor + (1 - weight) * fitness, each scaled to 0 to 1 in its range among the members.

    Nearness is 1 for the nearest and 0 for the farthest member. What is equal for all is 0. Members whose fitness or
    descriptor is not finite are NaN.

    Args:
        near: the descriptor, and the weight of nearness.
        fitness: fitness of every member, any shape.
        descriptor_B: their descriptors, the same shape with a last axis B.

    Source: the weighted target fitness score of JEDi, Templier et al. 2024 (arXiv:2405.04308).
    """
    fitness = np.asarray(fitness, np.float64)
    distance = np.linalg.norm(np.asarray(descriptor_B, np.float64) - np.asarray(near.descriptor), axis=-1)
    is_valid = np.isfinite(fitness) & np.isfinite(distance)
    scaled = [_scaled(np.where(is_valid, term, np.nan)) for term in (-distance, fitness)]
    return near.weight * scaled[0] + (1.0 - near.weight) * scaled[1]


def _scaled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values from 0 for the lowest to 1 for the highest; all 0 if they are equal; NaN stays."""
    known = values[~np.isnan(values)]
    low, width = (known.min(), np.ptp(known)) if known.size else (0.0, 0.0)
    return (values - low) / (width or 1.0)
