"""The policy: a tanh multilayer perceptron whose parameters are one flat vector.

This module imports only NumPy, so that the driver can make the first centre and users can run a policy without JAX.
Functions that also run inside compiled rollouts take the array namespace as `xp`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from es_service.protocol.messages import FloatArray, PolicyShape
from es_service.protocol.noise import Domain, normals, stream_keys

INITIAL_COLUMN_NORMS = {"unit_columns": (1.0, 0.01), "small_columns": (0.01, 0.01)}
"""(column norm of hidden layers, column norm of the output layer) for each value of `policy.init`.

Sources: unit_columns, OpenAI ES and deep-neuroevolution; small_columns, the released ME-ES code.
"""

Layers = list[tuple[Any, Any]]
"""(weights [in, out], biases [out]) of each layer."""


def split_layers(shape: PolicyShape, parameters_D: Any) -> Layers:
    """Layers of a policy as views of its flat vector: (weights [in, out], biases [out]) per layer."""
    layers, start = [], 0
    for inputs, outputs in shape.layers:
        biases = start + inputs * outputs
        layers.append((parameters_D[start:biases].reshape(inputs, outputs), parameters_D[biases : biases + outputs]))
        start = biases + outputs
    return layers


def act(xp: Any, layers: Layers, observation_O: Any) -> Any:
    """Action in [-1, 1] for one normalised observation, with tanh after every layer including the output."""
    x = observation_O
    for weights, biases in layers:
        x = xp.tanh(x @ weights + biases)
    return x


def normalise(xp: Any, observation_O: Any, mean_O: Any, std_O: Any, clip: float | None) -> Any:
    """Normalised observation: (observation - mean) / std, clipped to [-clip, clip] unless `clip` is None."""
    x = (observation_O - mean_O) / std_O
    return x if clip is None else xp.clip(x, np.float32(-clip), np.float32(clip))


def initial_parameters(shape: PolicyShape, init: str, seed: int, centre: int = 0) -> FloatArray:
    """Initial parameters of a centre: Gaussian weights, scaled so that the column of each output has a set norm.

    Biases are 0.

    Args:
        init: a key of INITIAL_COLUMN_NORMS.
        centre: number of the centre within the run; each centre draws from its own stream.
    """
    hidden_norm, output_norm = INITIAL_COLUMN_NORMS[init]
    key = stream_keys(seed, Domain.INITIALISATION, 0, centre)
    parameters_D = normals(key, shape.parameters)
    for layer, (weights, biases) in enumerate(split_layers(shape, parameters_D)):
        norm = output_norm if layer == len(shape.layers) - 1 else hidden_norm
        weights *= np.float32(norm) / np.sqrt(np.sum(np.square(weights), axis=0, keepdims=True))
        biases[:] = 0.0
    return parameters_D
