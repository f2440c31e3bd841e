"""Steps of a centre along a gradient estimate, by the kinds of `search.step`: pure functions of the step's state.

The state of a step is a few arrays by name, which the store keeps with the centre. Before the first step all of them
are 0, so a fresh state is made from any other of its kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from es_service.config.search import PopulationConfig, SearchConfig
from es_service.protocol.messages import FloatArray
from es_service.search.steps import adam, clipup, plain

StepState = Mapping[str, np.ndarray]


class Step(NamedTuple):
    """The functions of a kind of step."""

    fresh: Callable[[int], StepState]
    """(number of parameters) -> the state before any step."""
    take: Callable[[Any, StepState, FloatArray, FloatArray], tuple[StepState, FloatArray]]
    """(settings of this kind, state, centre [D], gradient estimate [D]) -> (new state, new centre [D])."""


STEPS = {
    "adam": Step(adam.fresh_adam, adam.adam_step),
    "adamw": Step(adam.fresh_adam, adam.adamw_step),
    "plain": Step(plain.fresh_plain, plain.plain_step),
    "clipup": Step(clipup.fresh_clipup, clipup.clipup_step),
}


def fresh_state(search: SearchConfig | None, parameters: int) -> StepState:
    """The state of a centre's step before the first one; empty for a search without steps.

    Args:
        parameters: number of policy parameters.
    """
    return STEPS[search.step.kind].fresh(parameters) if isinstance(search, PopulationConfig) else {}


def restarted(state: StepState) -> StepState:
    """The state of a step of the same kind before the first one."""
    return {name: np.zeros_like(values) for name, values in state.items()}
