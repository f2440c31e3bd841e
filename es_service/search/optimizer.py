"""Steps up a gradient estimate, in NumPy float32: Adam as in the released code of the evolution-strategies papers, and
a plain step.

This Adam differs from that of optax: epsilon is added to sqrt(v) *before* the bias correction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from es_service.protocol.messages import FloatArray

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Adam:
    """Optimiser state of one centre. D: policy parameters."""

    m_D: FloatArray
    """Running mean of the descent direction."""
    v_D: FloatArray
    """Running mean of its square."""
    step: int
    """Number of updates made."""


def fresh_adam(parameters: int) -> Adam:
    """The optimiser state before any update: both moments are 0.

    Args:
        parameters: D, the number of policy parameters.
    """
    return Adam(np.zeros(parameters, np.float32), np.zeros(parameters, np.float32), 0)


def adam_ascent(
    adam: Adam, centre_D: FloatArray, gradient_D: FloatArray, *, learning_rate: float, l2: float
) -> tuple[Adam, FloatArray]:
    """Take one step up the gradient estimate: (new optimiser state, new centre).

    The weight penalty is part of the direction in which Adam descends: -gradient + l2 * centre. The new centre is the
    old one minus learning_rate * sqrt(1 - b2^t) / (1 - b1^t) * m / (sqrt(v) + eps), with t counted from 1.

    Args:
        gradient_D: estimate of the gradient; it points to higher utility.
        learning_rate: step size, in parameter units.
        l2: weight of the penalty.

    Source: released code of deep-neuroevolution and ME-ES (optimizers.py); constants 0.9, 0.999, 1e-8.
    """
    step = adam.step + 1
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        descent_D = centre_D * np.float32(l2) - gradient_D
        m_D = adam.m_D * np.float32(BETA_1) + descent_D * np.float32(1.0 - BETA_1)
        v_D = adam.v_D * np.float32(BETA_2) + np.square(descent_D) * np.float32(1.0 - BETA_2)
        rate = np.float32(learning_rate * math.sqrt(1.0 - BETA_2**step) / (1.0 - BETA_1**step))
        new_centre_D = centre_D - m_D * rate / (np.sqrt(v_D) + np.float32(EPSILON))
    return Adam(_float32(m_D), _float32(v_D), step), _float32(new_centre_D)


def plain_ascent(centre_D: FloatArray, gradient_D: FloatArray, *, learning_rate: float, l2: float) -> FloatArray:
    """The centre after one step up the gradient estimate: centre - learning_rate * (l2 * centre - gradient).

    Args:
        gradient_D: estimate of the gradient; it points to higher utility.
        learning_rate: factor of the step.
        l2: weight of the penalty.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        descent_D = centre_D * np.float32(l2) - gradient_D
        return _float32(centre_D - descent_D * np.float32(learning_rate))


def _float32(x: np.ndarray) -> FloatArray:
    """The same array, typed as float32: it already is float32, but NumPy's type stubs do not show this."""
    return x.astype(np.float32, copy=False)
