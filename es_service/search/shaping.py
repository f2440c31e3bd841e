"""Utilities: what members are ranked by, and the weights of the noise in the gradient estimate."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

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
    TopPairs,
)
from es_service.config.sections import NoveltyConfig
from es_service.protocol.messages import EpisodesResult
from es_service.search.novelty import NoveltyArchive, novelty


def centred_ranks(fitness_PS: ArrayLike) -> NDArray[np.float64]:
    """Map fitness to utilities in [-0.5, 0.5], evenly spaced by rank over all members; higher fitness, higher utility.

    Only the order matters, so a strictly increasing function of the fitness gives the same utilities. Equal values get
    the mean of their ranks. Members whose fitness is not finite are invalid; they get the mean of the lowest ranks.

    Args:
        fitness_PS: fitness of every member, any shape, at least two members.

    Returns:
        Utilities of the same shape; they sum to zero up to rounding.

    Source: rank shaping of Salimans et al. 2017 (arXiv:1703.03864); averaging ties is our choice.
    """
    fitness_PS = np.asarray(fitness_PS, np.float64)
    flat = np.where(np.isfinite(fitness_PS), fitness_PS, -np.inf).ravel()
    _, group, size = np.unique(flat, return_inverse=True, return_counts=True)
    first_rank = np.cumsum(size) - size
    mean_rank = first_rank + (size - 1) / 2.0
    return (mean_rank[group] / (flat.size - 1) - 0.5).reshape(fitness_PS.shape)


def pair_signs(fitness_P_S: ArrayLike) -> NDArray[np.float64]:
    """Map fitness to 0.5 for the better member of each pair and -0.5 for the other; 0 for both if they are equal.

    A member whose fitness is not finite is worse than any other; two of them are equal.

    Args:
        fitness_P_S: fitness of every member, with axes P (pairs) and S (signs [+, -]).

    Returns:
        Utilities of the same shape, so that the weight of a pair is the sign of its difference.
    """
    fitness_P_S = np.asarray(fitness_P_S, np.float64)
    plus_P, minus_P = np.where(np.isfinite(fitness_P_S), fitness_P_S, -np.inf).T
    half_P = 0.5 * (plus_P > minus_P) - 0.5 * (plus_P < minus_P)
    return np.stack([half_P, -half_P], axis=1)


def standardised(fitness_PS: ArrayLike) -> NDArray[np.float64]:
    """Map fitness to utilities with mean 0 and standard deviation 1; all 0 if no two members differ.

    The utilities are proportional to the fitness itself, and their scale is that of no task. Members whose fitness is
    not finite are invalid; they count with the lowest fitness of the others.

    Args:
        fitness_PS: fitness of every member, any shape.

    Returns:
        Utilities of the same shape. Swapping members swaps their utilities, to the bit.
    """
    known_PS = invalid_lowest(fitness_PS)
    spread = standard_deviation(known_PS)
    return (known_PS - _mean(known_PS)) / spread if spread else np.zeros_like(known_PS)


def invalid_lowest(fitness_PS: ArrayLike) -> NDArray[np.float64]:
    """The fitness of every member, in which those that are not finite have the lowest of the others; 0 if all are."""
    fitness_PS = np.asarray(fitness_PS, np.float64)
    is_valid_PS = np.isfinite(fitness_PS)
    lowest = fitness_PS[is_valid_PS].min() if is_valid_PS.any() else 0.0
    return np.where(is_valid_PS, fitness_PS, lowest)


def standard_deviation(values: NDArray[np.float64]) -> float:
    """Standard deviation of all values (population formula); exactly 0 if they are equal.

    Sums are rounded once, so the order of the values does not matter, nor does the processor.
    """
    if not np.ptp(values):
        return 0.0  # the mean of equal values may differ from them in the last bit
    return math.sqrt(_mean(np.square(values - _mean(values))))


def _mean(values: NDArray[np.float64]) -> float:
    return math.fsum(values.ravel().tolist()) / values.size


def top_pair_differences(settings: TopPairs, fitness_P_S: ArrayLike) -> NDArray[np.float64]:
    """Map fitness to utilities with which a pair has the weight (f+ - f-) * P / (b * s); 0 for all but the best pairs.

    These are the b = `count` pairs whose better member has the highest fitness, and s is the standard deviation of
    their 2 b fitness values; P is the number of all pairs, by which the gradient estimate is divided. An invalid member
    counts with the lowest fitness of the others. Of equally good pairs the first one is taken (the released code takes
    all of them). If all these fitness values are equal, all utilities are 0 (it divides by 0).

    Args:
        fitness_P_S: fitness of every member, with axes P (pairs) and S (signs [+, -]).

    Returns:
        Utilities of the same shape, of a pair half of its weight and the negative of that.

    Source: augmented random search, Mania et al. 2018 (arXiv:1803.07055).
    """
    known_P_S = invalid_lowest(fitness_P_S)
    count = settings.count or len(known_P_S)
    top = np.argsort(-known_P_S.max(axis=1), kind="stable")[:count]
    spread = standard_deviation(known_P_S[top])
    half_P = np.zeros(len(known_P_S))
    if spread:
        half_P[top] = 0.5 * ((known_P_S[top, 0] - known_P_S[top, 1]) * (len(known_P_S) / (count * spread)))
    return np.stack([half_P, -half_P], axis=1)


SHAPINGS: dict[str, Callable[[Any, ArrayLike], NDArray[np.float64]]] = {
    "ranks": lambda settings, fitness_P_S: centred_ranks(fitness_P_S),
    "signs": lambda settings, fitness_P_S: pair_signs(fitness_P_S),
    "returns": lambda settings, fitness_P_S: standardised(fitness_P_S),
    "top_pairs": top_pair_differences,
}
"""Kind of `search.shaping` -> (its settings, fitness or novelty of a population [P, S]) -> utilities [P, S]."""


def shaped(settings: Shaping, fitness_P_S: ArrayLike) -> NDArray[np.float64]:
    """Utilities [P, S] of the fitness, or of the novelty, [P, S] of a population."""
    return SHAPINGS[settings.kind](settings, fitness_P_S)


def pair_weights(utility_P_S: NDArray[np.float64]) -> NDArray[np.float32]:
    """Weight of each pair's noise, [P]: the utility of the member with sign + minus that of the member with sign -.

    Swapping the signs of all pairs negates every weight exactly, and therefore the gradient estimate.
    """
    return (utility_P_S[:, 0] - utility_P_S[:, 1]).astype(np.float32)


# What members are ranked by: an objective gives each member a value, and shaping makes utilities of the values.
#
# Axes: P pairs, S signs [+, -], E episodes, B descriptor dimensions. The functions take results with any leading axes,
# [P, S] of a population or [E] of a centre's evaluation.


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
    novelty_P_S: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Utility of each member of a population, [P, S].

    A mixture is (1 - weight) * shaped novelty + weight * shaped fitness, each shaped by itself, so that their scales do
    not matter. An invalid member (fitness NaN) is the worst by any objective.

    Args:
        results: results of the population, [P, S].
        archive: the novelty archive as it was before the generation.
        settings: how novelty is computed.
        shaping: how values become utilities.
        novelty_P_S: novelty of each member, if it is known.
    """
    weight = weight_of_fitness(objective)
    utility_P_S = np.zeros(results.fitness.shape)
    if weight > 0.0:
        utility_P_S += weight * shaped(shaping, values(objective, results))
    if weight < 1.0:
        if novelty_P_S is None:
            novelty_P_S = novelty(archive, results.descriptor, **dict(settings))
        utility_P_S += (1.0 - weight) * shaped(shaping, np.where(np.isnan(results.fitness), np.nan, novelty_P_S))
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
    share the mean of their ranks; with `ties: distance`, the nearer of equally fit ones ranks higher. Members whose
    fitness or descriptor is not finite are NaN.

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
    keys = [is_inside.astype(np.float64), np.where(is_inside, fitness, -distance)]
    if target.ties == "distance":
        keys.append(-distance)
    of_each = np.stack(keys, axis=-1)
    of_each[~is_valid] = -np.inf
    # In the order of the first key, then of the second, then of the third.
    _, place = np.unique(of_each.reshape(-1, len(keys)), axis=0, return_inverse=True)
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
