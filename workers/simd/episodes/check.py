"""A comparison of new machine code with its reference in NumPy, which a worker makes before it uses the code.

Tests compare the code of our machines with the reference implementations. A worker may run on a processor, or with a
version of LLVM, that we have never seen: there the reset and one step of a few episodes must have the bits that NumPy
gives them.

`policy` computes a policy in NumPy with the bits of its code: a weight is formed and a sum is rounded as `hidden.py`
describes. Axes: L lanes, D parameters, P pairs, I inputs, A actions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from es_service.protocol.policy_spec import Activation, PolicySpec, layers_of_noise, numbers, product_unit
from workers.simd.backend.native import Words, aligned, pack, require_same
from workers.simd.episodes.compiled import EpisodeKernel
from workers.simd.episodes.hidden import activated_node
from workers.simd.episodes.kernel import Kernel
from workers.simd.episodes.program import EpisodeProgram
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.graph import Graph
from workers.simd.graph.operations import compute
from workers.simd.graph.schedule import as_words, evaluate

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
    return lambda places, last: np.broadcast_to(centre_D[places][:, None], (len(places), lanes))


def per_lane(parameters_L_D: Floats) -> WeightsOf:
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


LANES = 16
UNIT = float(np.float32(0.1 / NORMAL_STD))


def check_resets(kernel: Kernel, graph: Graph, outputs: list[int], environment: str) -> None:
    """Raise WrongCodeError unless the resets of 16 episodes have the bits of their definition."""
    check_kernel(kernel, graph, outputs, reset_keys(), f"a reset of {environment}")


def check_kernel(kernel: Kernel, graph: Graph, outputs: list[int], given_L: np.ndarray, what: str) -> None:
    """Raise WrongCodeError unless a kernel gives the bits of its definition for the words [lane, word] of 16 lanes.

    Args:
        what: what it computes, for the message.
    """
    words = pack([given_L], kernel.target.width)
    results = aligned((len(words), kernel.words_out, kernel.target.width))
    kernel.run(words, results)
    require_same(_by_lane(results), output_words(evaluate(graph, outputs, np.ascontiguousarray(given_L.T))), what)


def check_episodes(kernel: EpisodeKernel, program: EpisodeProgram) -> None:
    """Raise WrongCodeError unless one step of 16 episodes, after their resets, has the bits of its definition."""
    spec, inputs_O, rng, keys_L = kernel.spec, kernel.inputs_O, np.random.default_rng(0), reset_keys()
    noise_keys_P = stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(LANES // 2)) if kernel.training else None
    lanes_O = (LANES if kernel.per_lane_weights else 1, spec.policy.widths[0])
    mean_O, std_O = np.zeros(lanes_O, np.float32), rng.uniform(0.5, 2.0, lanes_O).astype(np.float32)
    mean_O[:, inputs_O] = rng.normal(0.0, 0.1, (len(mean_O), len(inputs_O)))
    parameters_L_D = _parameters(spec, rng, LANES if kernel.per_lane_weights else 1)
    if kernel.per_lane_weights:
        memory, weights = kernel.network.room_for_weights(LANES, spec.policy.parameters)
        memory[...] = parameters_L_D
        weights_of = per_lane(memory)
    elif noise_keys_P is not None and not spec.noise_rank:
        weights_of = perturbed(parameters_L_D[0], np.float32(UNIT), noise_keys_P)
        weights = kernel.network.pack(parameters_L_D[0])
    else:
        weights, weights_of = kernel.network.pack(parameters_L_D[0]), shared(parameters_L_D[0], LANES)

    moved = {}
    if noise_keys_P is not None and spec.noise_rank:
        moved["moved"] = low_rank(spec.policy, spec.noise_rank, np.float32(UNIT), noise_keys_P)
    carries, go = kernel.started(weights, UNIT, mean_O, std_O, noise_keys_P, keys_L, keys_L)
    carry_L = _by_lane(carries)
    go(1)
    (normalised_observation, _, seen), (advance, _, after) = program.graphs()
    statistics = [np.broadcast_to(x[:, inputs_O], (LANES, len(inputs_O))).T.view(np.uint32) for x in (mean_O, std_O)]
    x_I_L = np.stack(evaluate(normalised_observation, seen, np.concatenate([carry_L, *statistics])))
    action_A_L = policy(spec.policy, inputs_O, x_I_L, weights_of, **moved)
    words = np.concatenate([carry_L, statistics[0], x_I_L.view(np.uint32), action_A_L.view(np.uint32), keys_L.T])
    require_same(_by_lane(carries), output_words(evaluate(advance, after, words)), f"a step of {spec.environment}")


def check_gradient(gradient_sum: Callable[..., np.ndarray], parameters: int) -> None:
    """Raise WrongCodeError unless a gradient sum over a few pairs has the bits of its definition."""
    keys_P = stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(5))
    weights_P = np.random.default_rng(0).normal(size=5).astype(np.float32)
    coordinates_D, sums_D = np.arange(parameters, dtype=np.uint32), np.zeros(parameters, np.float32)
    for weight, key in zip(weights_P, keys_P, strict=True):
        k_D = normal_integers(np, key, coordinates_D).astype(np.float32)
        sums_D = compute("fma", [np.full_like(k_D, weight), k_D, sums_D])
    wanted_D = compute("mul", [sums_D, np.full_like(sums_D, 1.0 / NORMAL_STD)])
    require_same(gradient_sum(weights_P, keys_P)[:parameters], wanted_D, "a gradient")


def reset_keys() -> np.ndarray:
    """Keys of the resets that are compared, [lane, 4]."""
    return stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(LANES))


def _parameters(spec: WorkerSpec, rng: np.random.Generator, rows: int) -> np.ndarray:
    """Parameters [rows, D] with which hidden layers neither sleep nor saturate."""
    scale = 1.0 / np.sqrt(max(spec.policy.widths))
    return rng.normal(0.0, scale, (rows, spec.policy.parameters)).astype(np.float32)


def _by_lane(carries: Words) -> np.ndarray:
    """Words [word, lane] of carries [block, word, lane]."""
    return np.concatenate(list(carries), axis=1)[:, :LANES].copy()


def output_words(values: list[np.ndarray]) -> np.ndarray:
    """Values of outputs as words [output, lane]."""
    return np.stack([as_words(x) for x in values])
