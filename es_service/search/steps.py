"""Steps of a centre along a gradient estimate, by the kinds of `search.step`: pure functions of the step's state.

adam, adamw    Adam in NumPy float32, as in the released code of the evolution-strategies papers. It differs from that
               of optax: epsilon is added to sqrt(v) *before* the bias correction.
clipup         steps of a momentum along normalised gradient estimates, none of them longer than a given speed
plain          the gradient estimate times a factor

The state of a step is a few arrays by name, which the store keeps with the centre. Before the first step all of them
are 0, so a fresh state is made from any other of its kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from es_service.config.parts import AdamStep, AdamWStep, ClipUpStep, PlainStep
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.protocol.messages import FloatArray

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


def fresh_adam(parameters: int) -> dict[str, np.ndarray]:
    """The state before any step: both moments and the number of steps are 0.

    Args:
        parameters: D, the number of policy parameters.

    Returns:
        adam_m_D, the running mean of the descent direction; adam_v_D, that of its square; adam_step, the number of
        steps taken.
    """
    zeros_D = np.zeros(parameters, np.float32)
    return {"adam_m_D": zeros_D, "adam_v_D": zeros_D.copy(), "adam_step": np.asarray(0, np.int64)}


def adam_step(
    settings: AdamStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """Take one step up the gradient estimate: (new state, new centre).

    The weight penalty is part of the direction in which Adam descends: -gradient + l2 * centre. The new centre is the
    old one minus learning_rate * sqrt(1 - b2^t) / (1 - b1^t) * m / (sqrt(v) + eps), with t counted from 1.

    Args:
        gradient_D: estimate of the gradient; it points to higher utility.

    Source: released code of deep-neuroevolution and ME-ES (optimizers.py); constants 0.9, 0.999, 1e-8.
    """
    return _adam(settings.learning_rate, settings.l2, state, centre_D, gradient_D)


def adamw_step(
    settings: AdamWStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """Take one step up the gradient estimate, and another of learning_rate * l2 * centre towards 0.

    Adam's moments, by which its step is divided, do not see the weight decay, so the decay is in proportion to the
    centre; arguments and results as `adam_step`.

    Source: Loshchilov and Hutter 2019 (arXiv:1711.05101); the rest as `adam_step`.
    """
    after, new_centre_D = _adam(settings.learning_rate, 0.0, state, centre_D, gradient_D)
    decay_D = centre_D * np.float32(settings.learning_rate * settings.l2)
    return after, np.asarray(new_centre_D - decay_D, np.float32)


def _adam(
    learning_rate: float, l2: float, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    step = int(state["adam_step"]) + 1
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        descent_D = centre_D * np.float32(l2) - gradient_D
        m_D = state["adam_m_D"] * np.float32(BETA_1) + descent_D * np.float32(1.0 - BETA_1)
        v_D = state["adam_v_D"] * np.float32(BETA_2) + np.square(descent_D) * np.float32(1.0 - BETA_2)
        rate = np.float32(learning_rate * math.sqrt(1.0 - BETA_2**step) / (1.0 - BETA_1**step))
        new_centre_D = centre_D - m_D * rate / (np.sqrt(v_D) + np.float32(EPSILON))
    return {"adam_m_D": m_D, "adam_v_D": v_D, "adam_step": np.asarray(step, np.int64)}, np.asarray(
        new_centre_D, np.float32
    )


SPEED = 4.0 / 3.0
"""Greatest speed as a multiple of the learning rate, if the config gives none."""


def fresh_clipup(parameters: int) -> dict[str, np.ndarray]:
    """The state before any step: a velocity of 0; argument as of `fresh_adam`."""
    return {"velocity_D": np.zeros(parameters, np.float32)}


def clipup_step(
    settings: ClipUpStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """Take one step up the gradient estimate: (new state, new centre).

    velocity <- momentum * velocity + learning_rate * g / |g| with g = gradient - l2 * centre, shortened to max_speed if
    it is longer; centre <- centre + velocity. Only the direction of the estimate matters, so the length of a step is
    the same whatever the estimate knows, and at most max_speed. If g is 0, nothing is added to the velocity.

    Source: Toklu, Liskowski and Srivastava 2020 (arXiv:2008.02387); if max_speed is not given, it is learning_rate /
    0.75, as in the experiments of EvoTorch. The weight decay is our addition.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        ascent_D = gradient_D - centre_D * np.float32(settings.l2)
        velocity_D = state["velocity_D"] * np.float32(settings.momentum)
        if length := norm(ascent_D):
            velocity_D = velocity_D + ascent_D * np.float32(settings.learning_rate / length)
        fastest = settings.max_speed or SPEED * settings.learning_rate
        if (speed := norm(velocity_D)) > fastest:
            velocity_D = velocity_D * np.float32(fastest / speed)
        return {"velocity_D": velocity_D}, np.asarray(centre_D + velocity_D, np.float32)


def norm(x_D: np.ndarray) -> float:
    """Euclidean norm; a sum of squares in float64, so that no library for matrices decides about its bits."""
    return math.sqrt(float(np.sum(np.square(x_D, dtype=np.float64))))


def plain_step(
    settings: PlainStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """The centre after one step up the gradient estimate: centre - learning_rate * (l2 * centre - gradient).

    Args:
        gradient_D: estimate of the gradient; it points to higher utility.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        descent_D = centre_D * np.float32(settings.l2) - gradient_D
        return state, np.asarray(centre_D - descent_D * np.float32(settings.learning_rate), np.float32)


StepState = Mapping[str, np.ndarray]


class StepFunctions(NamedTuple):
    """The functions of a kind of step."""

    fresh: Callable[[int], StepState]
    """(number of parameters) -> the state before any step."""
    take: Callable[[Any, StepState, FloatArray, FloatArray], tuple[StepState, FloatArray]]
    """(settings of this kind, state, centre [D], gradient estimate [D]) -> (new state, new centre [D])."""


STEPS = {
    "adam": StepFunctions(fresh_adam, adam_step),
    "adamw": StepFunctions(fresh_adam, adamw_step),
    "plain": StepFunctions(lambda parameters: {}, plain_step),
    "clipup": StepFunctions(fresh_clipup, clipup_step),
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
