"""The policy in NumPy with the bits of its code: a weight is formed and a sum is rounded as `hidden.py` describes.

Axes: L lanes, D parameters, P pairs, I inputs, A actions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.low_rank import layers_of_noise, numbers, product_unit
from es_service.protocol.noise import normal_integers
from es_service.protocol.policy_spec import Activation, PolicySpec
from workers.simd.episodes.hidden import activated_node
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.operations import compute
from workers.simd.graph.reference import evaluate

Floats = NDArray[np.float32]
WeightsOf = Callable[[NDArray[np.intp], bool], Floats]
"""Function (places in the flat vector of parameters [K], whether they are in the last layer) -> weights [K, L]."""

Moved = Callable[[int, NDArray[np.intp], Floats, Floats], Floats]
"""Function (number of the layer, its inputs that are computed, their values, sums [K, L]) -> sums [K, L]."""


def policy(
    spec: PolicySpec,
    inputs_O: NDArray[np.intp],
    x_I_L: Floats,
    weights_of: WeightsOf,
    moved: Moved = lambda layer, rows, x_I_L, sums: sums,
) -> Floats:
    """Outputs of the last layer, [A, L], of each lane.

    Args:
        inputs_O: inputs of the first layer that are computed; others are always zero.
        x_I_L: those inputs.
        moved: what changes the sums of a layer before its inputs.
    """
    seen, rows, start = x_I_L, inputs_O, 0
    for number, (inputs, outputs) in enumerate(spec.layers, 1):
        last = number == len(spec.layers)
        if spec.bias:
            sums = weights_of(start + inputs * outputs + np.arange(outputs), last)
        else:
            sums = np.zeros((outputs, x_I_L.shape[1]), np.float32)
        sums = moved(number - 1, rows, seen, sums)
        for row, x_L in zip(rows, seen, strict=True):
            weights = weights_of(start + row * outputs + np.arange(outputs), last)
            sums = compute("fma", [np.broadcast_to(x_L, sums.shape), weights, sums])
        if last and spec.output != "tanh":
            return sums
        seen, rows = _activated("tanh" if last else spec.activation, sums), np.arange(outputs)
        start += (inputs + spec.bias) * outputs
    return seen


def shared(centre_D: Floats, lanes: int) -> WeightsOf:
    """The centre's weights for all lanes."""
    return lambda places, last: np.broadcast_to(centre_D[places][:, None], (len(places), lanes))


def per_lane(parameters_L_D: Floats) -> WeightsOf:
    """Weights of each lane's own parameters."""
    return lambda places, last: parameters_L_D[:, places].T


def perturbed(centre_D: Floats, unit: np.float32, noise_keys_P: Any) -> WeightsOf:
    """The weights of both members of each pair, which are neighbouring lanes."""
    coordinates_D = np.arange(len(centre_D), dtype=np.uint32)
    k_P_D = np.stack([normal_integers(np, key, coordinates_D) for key in noise_keys_P])
    j_P_D = ((k_P_D - 1) >> 1).astype(np.float32)

    def moved(centre: Floats, j: Floats, unit: np.float32) -> Floats:
        """centre + unit k of k = 2 j + 1."""
        shifted = compute("add", [centre, np.full_like(centre, unit)])
        return compute("fma", [j, np.full_like(centre, compute("add", [unit, unit])), shifted])

    def weights_of(places: NDArray[np.intp], last: bool) -> Floats:
        j_P_K = j_P_D[:, places]
        centre_P_K = np.broadcast_to(centre_D[places], j_P_K.shape)
        plus = moved(centre_P_K, j_P_K, unit)
        doubled = compute("add", [centre_P_K, centre_P_K])
        minus = moved(centre_P_K, j_P_K, -unit) if last else compute("sub", [doubled, plus])
        return np.stack([plus, minus], axis=1).reshape(-1, len(places)).T

    return weights_of


def low_rank(spec: PolicySpec, rank: int, unit: np.float32, noise_keys_P: Any) -> Moved:
    """Terms of noise of low rank in the sums of both members of each pair, which share the centre's weights."""
    coordinates_N = np.arange(numbers(spec, rank), dtype=np.uint32)
    k_P_N = np.stack([normal_integers(np, key, coordinates_N) for key in noise_keys_P]).astype(np.float32)
    k_N_L = np.repeat(k_P_N, 2, axis=0).T
    sign_L = np.where(np.arange(k_N_L.shape[1]) % 2, np.float32(-1.0), np.float32(1.0))
    unit_L = sign_L * unit
    thin_unit_L = compute("mul", [unit_L, np.full_like(unit_L, product_unit(rank))])
    layers = layers_of_noise(spec, rank)

    def moved(layer: int, rows: NDArray[np.intp], x_I_L: Floats, sums: Floats) -> Floats:
        left_R_I, right_R_K, bias_K = layers[layer]
        if bias_K is not None:
            sums = compute("fma", [k_N_L[bias_K], np.broadcast_to(unit_L, sums.shape), sums])
        for left_I, right_K in zip(left_R_I, right_R_K, strict=True):
            thin_L = np.zeros_like(unit_L)
            for row, x_L in zip(rows, x_I_L, strict=True):
                thin_L = compute("fma", [x_L, k_N_L[left_I[row]], thin_L])
            factor_L = compute("mul", [thin_L, thin_unit_L])
            sums = compute("fma", [k_N_L[right_K], np.broadcast_to(factor_L, sums.shape), sums])
        return sums

    return moved


def _activated(activation: Activation, x: Floats) -> Floats:
    graph = FoldingGraph()
    outputs = [activated_node(graph, activation, graph.input("f", 0))]
    return evaluate(graph, outputs, np.ascontiguousarray(x).view(np.uint32).reshape(1, -1))[0].reshape(x.shape)
