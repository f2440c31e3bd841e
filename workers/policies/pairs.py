"""Perturbed policies of a whole population on a GPU: a step of all members at a time.

The weights of member s of pair p are centre + sign(s) * unit * noise(p). The product of the centre's weights is one
matrix product for all members, and the noise of a pair, a byte for each weight, is read once for both of its members.
This is the same policy as that of weights added first, but its sums are rounded differently.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import SIGNS, PolicySpec
from workers.policies.policy import act, split_layers

SIGNS_S = np.asarray(SIGNS, np.float32)


class PairLayer(NamedTuple):
    """Weights of a layer of all members."""

    centre_I_J: Any
    half_noise_P_J_I: Any
    """The noise integers k of `normal_integers`, which are odd, as (k - 1) / 2: bytes, with the inputs last."""


def act_in_pairs(policy: PolicySpec, centre_D: Any, unit: Any, noise_P_D: Any) -> Any:
    """Function (memory_M_H, observation_M_O) -> (outputs_M_A, memory_M_H), as `act` of every member.

    Args:
        centre_D: parameters of the centre.
        unit: sigma / NORMAL_STD.
        noise_P_D: noise integers of each pair, `normal_integers`. The two members of a pair are neighbours.
    """
    noise = jax.vmap(lambda noise_D: split_layers(policy, noise_D))(noise_P_D)
    centre = split_layers(policy, centre_D)
    layers = [
        (
            PairLayer(weights, ((jnp.swapaxes(k_P_I_J, 1, 2) - 1) // 2).astype(jnp.int8)),
            None if biases is None else (biases, k_P_J.astype(jnp.float32)),
        )
        for (weights, biases), (k_P_I_J, k_P_J) in zip(centre, noise, strict=True)
    ]
    step_S_1 = (unit * SIGNS_S)[:, None]

    def dense(x_M_I: Any, layer: Any, biases: Any) -> Any:
        x_P_S_I = x_M_I.reshape(-1, 2, x_M_I.shape[-1])
        half_P_J_I = layer.half_noise_P_J_I.astype(jnp.float32)
        sums = [jnp.sum(x_P_S_I[:, s, None, :] * half_P_J_I, axis=2) for s in range(2)]
        own_P_S_J = 2.0 * jnp.stack(sums, axis=1) + jnp.sum(x_P_S_I, axis=-1, keepdims=True)
        shared_M_J = x_M_I @ layer.centre_I_J
        if biases is not None:
            shared_M_J, own_P_S_J = shared_M_J + biases[0], own_P_S_J + biases[1][:, None, :]
        return shared_M_J + (step_S_1 * own_P_S_J).reshape(shared_M_J.shape)

    return lambda memory_M_H, observation_M_O: act(jnp, policy, layers, memory_M_H, observation_M_O, dense)
