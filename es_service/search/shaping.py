"""Utilities from fitness, and from these the weights of the noise in the gradient estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


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


def pair_weights(utility_P_S: NDArray[np.float64]) -> NDArray[np.float32]:
    """Weight of each pair's noise, [P]: the utility of the member with sign + minus that of the member with sign -.

    Swapping the signs of all pairs negates every weight exactly, and therefore the gradient estimate.

    Args:
        utility_P_S: utilities with axes P (pairs) and S (signs [+, -]).
    """
    return (utility_P_S[:, 0] - utility_P_S[:, 1]).astype(np.float32)
