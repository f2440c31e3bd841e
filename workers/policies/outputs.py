"""Actions from the outputs of a policy's last layer.

tanh, linear: the outputs themselves; `tanh` has been applied by the network.
argmax: the action with the greatest output is 1, the first of equal ones, and the others are 0.
categorical: the same, drawn with probabilities that are the softmax of the outputs.
gaussian: tanh of a normal variate, whose mean and log of the standard deviation are the two halves of the outputs.

Only training episodes draw. In evaluations `categorical` takes the most probable action, as `argmax` does, and
`gaussian` the tanh of the mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from es_service.protocol.noise import NORMAL_STD, normal_integers, uniforms
from es_service.protocol.policy_spec import Output

LOG_STD = (-5.0, 2.0)
"""Limits of the log of the standard deviation of `gaussian`. Source: usual in implementations of SAC."""
LEAST_UNIFORM = np.float32(2.0**-25)
"""Replacement of a uniform variate of 0: half of the distance between variates."""


def action(xp: Any, output: Output, outputs: Any) -> Any:
    """Action [..., A] of an evaluation, from the outputs of the last layer [..., A], or [..., 2 A] of `gaussian`."""
    if output in ("argmax", "categorical"):
        return _chosen(xp, outputs)
    if output == "gaussian":
        return xp.tanh(outputs[..., : outputs.shape[-1] // 2])
    return outputs


def drawn_action(xp: Any, output: Output, outputs: Any, key: Any, coordinates_A: Any) -> Any:
    """Action [A] of a step of training, before action noise; without draws it is that of an evaluation.

    Args:
        key: stream key of the episode's action noise.
        coordinates_A: the step's coordinates in that stream, uint32.
    """
    if output == "categorical":
        # The greatest of logits + Gumbel variates has the probabilities of the softmax.
        uniform_A = xp.maximum(uniforms(key, coordinates_A), LEAST_UNIFORM)
        return _chosen(xp, outputs - xp.log(-xp.log(uniform_A)))
    if output == "gaussian":
        half = outputs.shape[-1] // 2
        std_A = xp.exp(xp.clip(outputs[..., half:], *map(np.float32, LOG_STD)))
        normal_A = normal_integers(xp, key, coordinates_A).astype(np.float32) * np.float32(1.0 / NORMAL_STD)
        return xp.tanh(outputs[..., :half] + std_A * normal_A)
    return action(xp, output, outputs)


def _chosen(xp: Any, outputs: Any) -> Any:
    choice = xp.argmax(outputs, axis=-1)[..., None]
    return (choice == np.arange(outputs.shape[-1])).astype(np.float32)
