"""Parameter noise and gradients in NumPy. Axes: P pairs, D policy parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from es_service.protocol.messages import SIGNS, FloatArray
from es_service.protocol.noise import NORMAL_STD, normals

_SIGNS_S = np.asarray(SIGNS, np.float32)


def members(centre_D: FloatArray, unit: Any, noise_keys_P_4: Any) -> FloatArray:
    """Parameters of the members of pairs, [P, S, D]: centre + sign * unit * noise."""
    noise_P_D = _integers(noise_keys_P_4, centre_D.size)
    return centre_D + np.multiply.outer(noise_P_D, np.float32(unit) * _SIGNS_S).swapaxes(1, 2)


def gradient_summer(parameters: int) -> Callable[[Any, Any], FloatArray]:
    """See `ChunkFunctions.gradient_sum`."""

    def gradient_sum(weights_P: Any, noise_keys_P_4: Any) -> FloatArray:
        sum_D = np.zeros(parameters, np.float32)
        for weight, key in zip(weights_P, noise_keys_P_4, strict=True):
            sum_D += weight * _integers(key, parameters)
        return sum_D * np.float32(1.0 / NORMAL_STD)

    return gradient_sum


def _integers(keys: Any, parameters: int) -> FloatArray:
    """`normal_integers` of streams at all coordinates, as float32 [..., D]."""
    noise = normals(keys, parameters)
    noise *= np.float32(NORMAL_STD)
    return np.rint(noise, out=noise)
