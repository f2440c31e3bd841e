"""Adam in NumPy float32, as in the released code of the evolution-strategies papers.

It differs from that of optax: epsilon is added to sqrt(v) *before* the bias correction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from es_service.config.parts import AdamStep, AdamWStep
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
