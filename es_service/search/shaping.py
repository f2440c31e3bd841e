"""Utilities from fitness or novelty, and from these the weights of the noise in the gradient estimate."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.config.parts import Shaping, TopPairs


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
