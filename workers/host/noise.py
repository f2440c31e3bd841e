"""Parameter noise and gradients in NumPy. Axes: P pairs, D policy parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from es_service.protocol.low_rank import noise_integers
from es_service.protocol.messages import SIGNS, FloatArray, WorkerSpec
from es_service.protocol.noise import NORMAL_STD

_SIGNS_S = np.asarray(SIGNS, np.float32)


def members(spec: WorkerSpec, centre_D: FloatArray, unit: Any, noise_keys_P_4: Any) -> FloatArray:
    """Parameters of the members of pairs, [P, S, D]: centre + sign * unit * noise."""
    noise_P_D = noise_integers(spec.policy, spec.noise_rank, noise_keys_P_4)
    return centre_D + np.multiply.outer(noise_P_D, np.float32(unit) * _SIGNS_S).swapaxes(1, 2)


def gradient_summer(spec: WorkerSpec) -> Callable[[Any, Any], FloatArray]:
    """See `ChunkFunctions.gradient_sum`."""

    def gradient_sum(weights_P: Any, noise_keys_P_4: Any) -> FloatArray:
        sum_D = np.zeros(spec.policy.parameters, np.float32)
        for weight, key in zip(weights_P, noise_keys_P_4, strict=True):
            sum_D += weight * noise_integers(spec.policy, spec.noise_rank, key)
        return sum_D * np.float32(1.0 / NORMAL_STD)

    return gradient_sum
