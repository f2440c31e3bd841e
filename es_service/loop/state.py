"""Everything that a run carries from one generation to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME
from es_service.protocol.messages import FloatArray, Moments
from es_service.search.algorithms.base import CentreState, SearchState
from es_service.search.observation_statistics import normalisation


@dataclass(frozen=True)
class Best:
    """The centre with the highest mean fitness so far, with the observation statistics of its evaluation."""

    generation: int
    fitness: float
    policy: NDArray[Any]
    """Its name."""


NO_BEST = Best(0, -math.inf, np.zeros((), NAME))
"""Before the first generation."""


@dataclass(frozen=True)
class RunState:
    """State of a run after `generation` generations."""

    generation: int
    search: SearchState
    observations: Moments
    best: Best
    env_steps: int
    """Environment steps so far, evaluations included; a Python int, since it can exceed 32 bits."""
    episodes: int
    wall_clock_s: float
    """Seconds spent so far in all sessions. They are stored only in the history, because they are not deterministic."""
    rollout_s: float = 0.0
    cpu_s: float = 0.0
    """The columns of the history of these names; NaN if they are not known. They are stored only there."""
    durations: tuple[float, ...] = ()
    """`budget.durations` of the newest generations."""


def statistics_in_force(
    observations: Moments, centre: CentreState | None, enabled: bool
) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation with which a centre's episodes normalise observations, float32 [O] each.

    They are the centre's own if it has any, else those of the whole run; 0 and 1 if observations are not normalised.
    """
    if enabled and centre is not None and centre.own_mean_O is not None and centre.own_std_O is not None:
        return centre.own_mean_O, centre.own_std_O
    return normalisation(observations, enabled)
