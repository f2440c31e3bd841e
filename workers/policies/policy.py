"""A policy: hidden layers, perhaps a memory, and a last layer, whose parameters are one flat vector.

This module imports only NumPy, so that the driver can make the first centre and users can run a policy without JAX.
Functions that also run inside compiled rollouts take the array namespace as `xp`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from es_service.protocol.messages import FloatArray
from es_service.protocol.noise import Domain, normals, stream_keys
from es_service.protocol.policy_spec import Activation, PolicySpec
from workers.policies.recurrent import Dense, dense, next_memory

INITIAL_COLUMN_NORMS = {"unit_columns": (1.0, 0.01), "small_columns": (0.01, 0.01)}
"""(column norm of hidden layers, column norm of the output layer) for each value of `policy.init`.

Sources: unit_columns, OpenAI ES and deep-neuroevolution; small_columns, the released ME-ES code.
"""

Layers = list[tuple[Any, Any]]
"""(weights [in, out], biases [out] or None) of each layer."""


def split_layers(spec: PolicySpec, parameters_D: Any) -> Layers:
    """Layers of a policy as views of its flat vector: (weights [in, out], biases [out] or None) per layer."""
    layers, start = [], 0
    for inputs, outputs in spec.layers:
        end = start + inputs * outputs
        biases = parameters_D[end : end + outputs] if spec.bias else None
        layers.append((parameters_D[start:end].reshape(inputs, outputs), biases))
        start = end + outputs * spec.bias
    return layers


def initial_memory(xp: Any, spec: PolicySpec, *axes: int) -> Any:
    """Memory at the start of an episode, zeros [..., H] with the given leading axes; None for a policy without one."""
    return xp.zeros((*axes, spec.memory), np.float32) if spec.memory else None


def act(
    xp: Any, spec: PolicySpec, layers: Layers, memory_H: Any, observation_O: Any, dense: Dense = dense
) -> tuple[Any, Any]:
    """Results of one step of a policy.

    Args:
        memory_H: the memory before the step; None for a policy without one.
        observation_O: a normalised observation.
        dense: function of a layer before its activation.

    Returns:
        (outputs of the last layer, of which `workers.policies.outputs` makes an action; the memory after the step)
    """
    hidden = spec.layers[: len(spec.widths) - 2]
    x = observation_O
    for weights, biases in layers[: len(hidden)]:
        x = activated(xp, spec.activation, dense(x, weights, biases))
    if spec.memory:
        gates, candidate = layers[len(hidden) : -1]
        memory_H = x = next_memory(xp, gates, candidate, memory_H, x, dense)
    x = dense(x, *layers[-1])
    return xp.tanh(x) if spec.output == "tanh" else x, memory_H


def activated(xp: Any, activation: Activation, x: Any) -> Any:
    """The function after a hidden layer: tanh, or relu, max(x, 0)."""
    return xp.tanh(x) if activation == "tanh" else xp.maximum(x, np.float32(0.0))


def normalise(xp: Any, observation_O: Any, mean_O: Any, std_O: Any, clip: float | None) -> Any:
    """Normalised observation: (observation - mean) / std, clipped to [-clip, clip] unless `clip` is None."""
    x = (observation_O - mean_O) / std_O
    return x if clip is None else xp.clip(x, np.float32(-clip), np.float32(clip))


def initial_parameters(spec: PolicySpec, init: str, seed: int, centre: int = 0) -> FloatArray:
    """Initial parameters of a centre: Gaussian weights, scaled so that the column of each output has a set norm.

    Biases are 0. The layers of a recurrent cell are hidden layers.

    Args:
        init: a key of INITIAL_COLUMN_NORMS.
        centre: number of the centre within the run; each centre draws from its own stream.
    """
    hidden_norm, output_norm = INITIAL_COLUMN_NORMS[init]
    key = stream_keys(seed, Domain.INITIALISATION, 0, centre)
    parameters_D = normals(key, spec.parameters)
    for layer, (weights, biases) in enumerate(split_layers(spec, parameters_D)):
        norm = output_norm if layer == len(spec.layers) - 1 else hidden_norm
        weights *= np.float32(norm) / np.sqrt(np.sum(np.square(weights), axis=0, keepdims=True))
        if biases is not None:
            biases[:] = 0.0
    return parameters_D
