"""Ways in which a GPU can compute the perturbed policies of a whole population, one step of all members at a time.

The weights of member s of pair p are centre + sign(s) * unit * noise(p). A way prepares what it needs of these once per
episode, and then computes the outputs [M, A] of observations [M, O], with M = 2 P members, those of a pair in a row.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import SIGNS, PolicySpec
from workers.policy import act, activated, split_layers

SIGNS_S = np.asarray(SIGNS, np.float32)


class Way(NamedTuple):
    """How policies are computed."""

    prepare: Callable[[PolicySpec, Any, Any, Any], Any]
    """Function (policy, centre_D, unit, noise_P_D as int32) -> what `outputs` needs."""
    outputs: Callable[[PolicySpec, Any, Any], Any]
    """Function (policy, prepared, observation_M_O) -> outputs [M, A] of the last layer."""


def _members(policy: PolicySpec, centre_D: Any, unit: Any, noise_P_D: Any) -> Any:
    parameters_P_S_D = centre_D + SIGNS_S[:, None] * (unit * noise_P_D.astype(jnp.float32))[:, None, :]
    return jax.vmap(lambda parameters_D: split_layers(policy, parameters_D))(
        parameters_P_S_D.reshape(-1, noise_P_D.shape[1])
    )


def _of_members(policy: PolicySpec, layers: Any, observation_M_O: Any) -> Any:
    return jax.vmap(lambda layer, x: act(jnp, policy, layer, None, x)[0])(layers, observation_M_O)


def _pairs(convert: Callable[[Any], Any]) -> Callable[[PolicySpec, Any, Any, Any], Any]:
    """The centre's layers, and the noise of each pair by layer: weights as `convert` makes them, biases as float32."""

    def prepare(policy: PolicySpec, centre_D: Any, unit: Any, noise_P_D: Any) -> Any:
        noise = jax.vmap(lambda noise_D: split_layers(policy, noise_D))(noise_P_D)
        kept = [(convert(k), None if b is None else b.astype(jnp.float32)) for k, b in noise]
        return split_layers(policy, centre_D), kept, unit * SIGNS_S

    return prepare


def _with_pairs(product: Callable[[Any, Any], Any]) -> Callable[[PolicySpec, Any, Any], Any]:
    """Outputs whose layers are the centre's product plus sign * unit * `product` (x_P_S_I, noise of the layer)."""

    def outputs(policy: PolicySpec, prepared: Any, observation_M_O: Any) -> Any:
        centre, noise, step_S = prepared
        x = observation_M_O
        for index, ((weights, biases), (k, k_bias)) in enumerate(zip(centre, noise, strict=True)):
            shared_M_J = x @ weights + (0.0 if biases is None else biases)
            own_P_S_J = product(x.reshape(-1, 2, x.shape[-1]), k) + (0.0 if k_bias is None else k_bias[:, None, :])
            x = shared_M_J + (step_S[:, None] * own_P_S_J).reshape(shared_M_J.shape)
            if index < len(centre) - 1:
                x = activated(jnp, policy.activation, x)
        return jnp.tanh(x) if policy.output == "tanh" else x

    return outputs


def _float_product(x_P_S_I: Any, k_P_I_J: Any) -> Any:
    return jnp.einsum("psi,pij->psj", x_P_S_I, k_P_I_J)


def _three_parts(x: Any) -> Any:
    """x as a sum of three bfloat16, along a new axis before the last."""
    parts, rest = [], x
    for _ in range(3):
        parts.append(rest.astype(jnp.bfloat16))
        rest = rest - parts[-1].astype(jnp.float32)
    return jnp.stack(parts, axis=-2)


def _bfloat_product(x_P_S_I: Any, k_P_I_J: Any) -> Any:
    """Noise integers have at most 8 bits, so that a bfloat16 is exact; products of two are exact in float32."""
    x_P_C_I = _three_parts(x_P_S_I).reshape(len(x_P_S_I), 6, -1)
    y_P_C_J = jnp.einsum("pci,pij->pcj", x_P_C_I, k_P_I_J, preferred_element_type=jnp.float32)
    return y_P_C_J.reshape(len(x_P_S_I), 2, 3, -1).sum(axis=2)


def _byte(k: Any) -> Any:
    """Noise integers, which are odd, as (k - 1) / 2, which is a byte."""
    return ((k - 1) // 2).astype(jnp.int8)


def _byte_product(x_P_S_I: Any, j_P_I_J: Any) -> Any:
    j = j_P_I_J.astype(jnp.float32)
    sums = [jnp.sum(x_P_S_I[:, s, :, None] * j, axis=1) for s in range(2)]
    return 2.0 * jnp.stack(sums, axis=1) + jnp.sum(x_P_S_I, axis=-1, keepdims=True)


def _rank_one(k_P_I_J: Any) -> Any:
    return k_P_I_J[:, :, 0].astype(jnp.float32), k_P_I_J[:, 0, :].astype(jnp.float32)


def _rank_one_product(x_P_S_I: Any, factors: Any) -> Any:
    a_P_I, b_P_J = factors
    return jnp.sum(x_P_S_I * a_P_I[:, None, :], axis=-1, keepdims=True) * b_P_J[:, None, :]


WAYS = {
    "members": Way(_members, _of_members),
    "pairs_float32": Way(_pairs(lambda k: k.astype(jnp.float32)), _with_pairs(_float_product)),
    "pairs_bfloat16": Way(_pairs(lambda k: k.astype(jnp.bfloat16)), _with_pairs(_bfloat_product)),
    "pairs_bytes": Way(_pairs(_byte), _with_pairs(_byte_product)),
    "rank_one": Way(_pairs(_rank_one), _with_pairs(_rank_one_product)),
}
"""`members` has the rounded weights of each member, as the CPU's rollouts. Those of pairs compute the centre's product
for all members at once and read the noise of a pair once for both; they round differently. `rank_one` is another search
distribution, and here only to know what it would cost."""
