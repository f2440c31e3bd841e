"""Partial gradient sums, made where the noise is: sum over a block of pairs of weight x noise, in constant memory."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.noise import NORMAL_STD, normal_integers


def make_gradient_sum(parameters: int) -> Callable:
    """Compile-once sum over one block: f(weights_P, noise_keys_P_4) -> [D], in weight x standard normal units.

    Pairs are added one after another in the order of their ids, so the float32 bits depend on nothing else. Noise is an
    integer; it is scaled to standard normal once, at the end.
    """
    coordinates_D = np.arange(parameters, dtype=np.uint32)

    def gradient_sum(weights_P, noise_keys_P):
        def add_pair(pair, sum_D):
            noise_D = normal_integers(jnp, noise_keys_P[pair], coordinates_D).astype(jnp.float32)
            return sum_D + weights_P[pair] * noise_D

        sum_D = lax.fori_loop(0, weights_P.shape[0], add_pair, jnp.zeros(parameters, jnp.float32))
        return sum_D * np.float32(1.0 / NORMAL_STD)

    return jax.jit(gradient_sum)
