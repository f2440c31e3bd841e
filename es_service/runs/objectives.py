"""What the centres of a run climb: fitness, novelty or both, by the weight of fitness of every evaluated centre.

A row of the history has the weight of one centre only, the fittest of its generation. The centres of some methods
differ, in a generation or from block to block: each either explores, that is, climbs novelty alone (weight 0), or
exploits, that is, climbs fitness alone (weight 1). So the table of evaluated centres is read, and no method needs to be
known. Only centres that a population has moved count: no population has used the weight of initial centres or policies.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Objectives(NamedTuple):
    """What some centres climb."""

    centres: int
    exploring: int
    """Centres that climb novelty alone."""
    exploiting: int
    """Centres that climb fitness alone."""
    fitness_weight: float
    """Mean weight of fitness; NaN for no centre."""

    @property
    def are_separate(self) -> bool:
        """Whether each centre climbs one of the two alone, and both occur."""
        return min(self.exploring, self.exploiting) > 0 and self.exploring + self.exploiting == self.centres


def objectives(weight_N: NDArray[np.float64]) -> Objectives:
    """What centres with these weights of fitness climb."""
    exploring, exploiting = (int((weight_N == alone).sum()) for alone in (0.0, 1.0))
    return Objectives(weight_N.size, exploring, exploiting, float(weight_N.mean()) if weight_N.size else float("nan"))


def weights(centres: Mapping[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Generation and weight of fitness of each centre that a population has moved, [N], in order.

    Args:
        centres: columns of the evaluated centres, in which NaN stands for no value.
    """
    moved_N = np.isfinite(centres["update_norm"])
    return centres["generation"][moved_N], centres["fitness_weight"][moved_N]
