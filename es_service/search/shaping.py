"""Fitness -> utilities: what the gradient estimate weighs the noise with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def centred_ranks(fitness_PS: ArrayLike) -> NDArray[np.float64]:
    """Map fitness to utilities in [-0.5, 0.5], evenly spaced by rank over all members; higher fitness, higher utility.

    Only the order matters, so a strictly increasing map of the fitness changes nothing. Equal values share the mean of
    their ranks. Members whose fitness is not finite are invalid and share the lowest ranks, averaged.

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


def pair_weights(utility_P_S: NDArray[np.float64]) -> NDArray[np.float32]:
    """Utility of + minus utility of -, per pair: the antithetic weight of the pair's noise.

    Swapping the signs of all pairs negates every weight exactly, and with it the gradient estimate.
    """
    return (utility_P_S[:, 0] - utility_P_S[:, 1]).astype(np.float32)
