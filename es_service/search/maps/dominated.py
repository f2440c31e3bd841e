"""Which policies a map of slots keeps: Dominated Novelty Search. Bahlous-Boldi et al. 2025 (arXiv:2502.00593).

The dominated novelty of a policy is the mean distance, between descriptors, to its nearest fitter ones, of which there
are `map.neighbours` or fewer; that of the fittest is infinite. When a generation has been evaluated, its policies and
the elites compete together, once, and those of the highest dominated novelty stay. So a policy stays if nothing near it
is fitter, and neither bounds nor cells have an effect. Distances are Euclidean in units of the descriptor, as in the
authors' code (adaptive-intelligent-robotics/Dominated-Novelty-Search).

Our own choice, for equal fitness: the older policy counts as the fitter one. The paper counts neither, so copies of the
fittest policy would all stay; the authors' code counts both, so these copies could all leave. The fittest policy always
stays, and of equal dominated novelties the fitter one does. All of this has a fixed order, so that results do not
depend on workers.

Axes: N policies, the older ones first; B descriptor dimensions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.nearest import mean_smallest, squared_to

BLOCK = 256
"""Policies whose distances are in memory together."""


def dominated_novelty(
    descriptor_N_B: NDArray[np.float64], fitness_N: NDArray[np.float64], neighbours: int
) -> NDArray[np.float64]:
    """Mean distance of each policy to its nearest `neighbours` fitter ones, or to all if there are fewer, [N].

    The distances are added in ascending order. The value is infinite for the fittest policy.

    Args:
        descriptor_N_B: finite.
        fitness_N: without NaN; of equally fit policies the first counts as the fittest.
    """
    novelty_N, order = np.full(fitness_N.size, np.inf), np.argsort(-fitness_N, kind="stable")
    ordered_N_B, rank_N = descriptor_N_B[order], np.arange(order.size)
    for first in range(0, order.size, BLOCK):
        rows = slice(first, first + BLOCK)
        squared = squared_to(ordered_N_B[rows], ordered_N_B[None, : first + BLOCK])
        squared[rank_N[None, : squared.shape[1]] >= rank_N[rows, None]] = np.inf  # a fitter one has a lower rank
        novelty_N[order[rows]] = mean_smallest(squared, neighbours, "euclidean")
    novelty_N[order[:1]] = np.inf
    return novelty_N


def survivors(
    descriptor_N_B: NDArray[np.float64], fitness_N: NDArray[np.float64], neighbours: int, slots: int
) -> NDArray[np.int64]:
    """Increasing indices of the policies that stay: at most `slots`, those of the highest dominated novelty.

    Of equal values, the fitter policy stays, and of equally fit ones the older.

    Args:
        descriptor_N_B, fitness_N, neighbours: as for `dominated_novelty`.
    """
    if fitness_N.size <= slots:
        return np.arange(fitness_N.size)
    novelty_N = dominated_novelty(descriptor_N_B, fitness_N, neighbours)
    return np.sort(np.lexsort((-fitness_N, -novelty_N))[:slots])
