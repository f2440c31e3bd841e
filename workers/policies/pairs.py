"""Perturbed policies of all members of a block, or on a GPU of a population: a step of all of them at a time.

**Noise of each parameter.** The weights of member s of pair p are centre + sign(s) * unit * noise(p). The product of
the centre's weights is one matrix product for all members, and the noise of a pair, a byte for each weight, is read
once for both of its members. This is the same policy as that of weights added first, but its sums are rounded
differently.

**Noise of low rank.** A member's layer is x (W +- e A^T B) = x W +- e (x A^T) B: one product with the centre's weights
for all members, and two thin ones for each. The weights of a member are never made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import SIGNS, PolicySpec
from es_service.protocol.policy_spec import layers_of_noise, product_unit
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


class LowRankLayer(NamedTuple):
    """Weights of a layer of all members."""

    centre_I_J: Any
    left_P_R_I: Any
    """Noise integers of A, of each pair."""
    right_P_R_J: Any
    """Noise integers of B, of each pair."""


def act_low_rank(policy: PolicySpec, rank: int, centre_D: Any, unit: Any, drawn_P_N: Any) -> Any:
    """Function (memory_M_H, observation_M_O) -> (outputs_M_A, memory_M_H), as `act` of every member.

    Args:
        centre_D: parameters of the centre.
        unit: sigma / NORMAL_STD.
        drawn_P_N: noise integers of each pair, `protocol.low_rank.numbers` of them, as float32. The two members of a
            pair are neighbours.
    """
    layers = [
        (
            LowRankLayer(weights, drawn_P_N[:, noise.left], drawn_P_N[:, noise.right]),
            None if noise.bias is None else (biases, drawn_P_N[:, noise.bias]),
        )
        for (weights, biases), noise in zip(split_layers(policy, centre_D), layers_of_noise(policy, rank), strict=True)
    ]
    step_S = unit * SIGNS_S

    def dense(x_M_I: Any, layer: LowRankLayer, biases: Any) -> Any:
        x_P_S_I = x_M_I.reshape(-1, 2, x_M_I.shape[-1])
        thin_P_S_R = jnp.einsum("psi,pri->psr", x_P_S_I, layer.left_P_R_I) * product_unit(rank)
        moved_P_S_J = jnp.einsum("psr,prj->psj", thin_P_S_R, layer.right_P_R_J)
        shared_M_J = x_M_I @ layer.centre_I_J
        if biases is not None:
            shared_M_J, moved_P_S_J = shared_M_J + biases[0], moved_P_S_J + biases[1][:, None, :]
        return shared_M_J + (step_S[:, None] * moved_P_S_J).reshape(shared_M_J.shape)

    return lambda memory_M_H, observation_M_O: act(jnp, policy, layers, memory_M_H, observation_M_O, dense)
