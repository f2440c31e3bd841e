"""Perturbed policies whose noise has low rank: a step of all members of a block at a time.

A member's layer is x (W +- e A^T B) = x W +- e (x A^T) B: one product with the centre's weights for all members, and
two thin ones for each. The weights of a member are never made.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from es_service.protocol.low_rank import layers_of_noise, product_unit
from es_service.protocol.messages import PolicySpec
from workers.policies.pairs import SIGNS_S
from workers.policies.policy import act, split_layers


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
