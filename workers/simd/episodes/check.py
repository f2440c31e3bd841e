"""A comparison of new machine code with its reference in NumPy, which a worker makes before it uses the code.

Tests compare the code of our machines with the reference implementations. A worker may run on a processor, or with a
version of LLVM, that we have never seen: there the reset and one step of a few episodes must have the bits that NumPy
gives them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from es_service.protocol.low_rank import layers_of_noise, numbers, product_unit
from es_service.protocol.messages import PolicySpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from workers.simd.backend.words import Words, aligned, pack
from workers.simd.episodes import reference
from workers.simd.episodes.compiled import EpisodeKernel
from workers.simd.episodes.kernel import Kernel
from workers.simd.episodes.program import EpisodeProgram
from workers.simd.graph.graph import Graph
from workers.simd.graph.operations import compute
from workers.simd.graph.reference import evaluate

LANES = 16
UNIT = float(np.float32(0.1 / NORMAL_STD))


class WrongCodeError(Exception):
    """Machine code does not compute what it should; the message says what to do."""


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
    require_same(_by_lane(results), as_words(evaluate(graph, outputs, np.ascontiguousarray(given_L.T))), what)


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
        weights_of = reference.per_lane(memory)
    elif noise_keys_P is not None and not spec.noise_rank:
        weights_of = reference.perturbed(parameters_L_D[0], np.float32(UNIT), noise_keys_P)
        weights = kernel.network.pack(parameters_L_D[0])
    else:
        weights, weights_of = kernel.network.pack(parameters_L_D[0]), reference.shared(parameters_L_D[0], LANES)

    moved = {}
    if noise_keys_P is not None and spec.noise_rank:
        moved["moved"] = reference.low_rank(spec.policy, spec.noise_rank, np.float32(UNIT), noise_keys_P)
    carries, go = kernel.started(weights, UNIT, mean_O, std_O, noise_keys_P, keys_L, keys_L)
    carry_L = _by_lane(carries)
    go(1)
    (normalised_observation, _, seen), (advance, _, after) = program.graphs()
    statistics = [np.broadcast_to(x[:, inputs_O], (LANES, len(inputs_O))).T.view(np.uint32) for x in (mean_O, std_O)]
    x_I_L = np.stack(evaluate(normalised_observation, seen, np.concatenate([carry_L, *statistics])))
    action_A_L = reference.policy(spec.policy, inputs_O, x_I_L, weights_of, **moved)
    words = np.concatenate([carry_L, statistics[0], x_I_L.view(np.uint32), action_A_L.view(np.uint32), keys_L.T])
    require_same(_by_lane(carries), as_words(evaluate(advance, after, words)), f"a step of {spec.environment}")


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


def check_low_rank_gradient(gradient_sum: Callable[..., np.ndarray], policy: PolicySpec, rank: int) -> None:
    """Raise WrongCodeError unless a sum of noise of low rank over a few pairs has the bits of its definition."""
    keys_P = stream_keys(0, Domain.PARAMETER_NOISE, 0, np.arange(3))
    weights_P = np.random.default_rng(0).normal(size=3).astype(np.float32)
    coordinates_N = np.arange(numbers(policy, rank), dtype=np.uint32)
    k_P_N = np.stack([normal_integers(np, key, coordinates_N) for key in keys_P]).astype(np.float32)
    wanted: list[np.ndarray] = []
    for left_R_I, right_R_J, bias_J in layers_of_noise(policy, rank):
        shape = left_R_I.shape[1], right_R_J.shape[1]
        sums_I_J, sums_J = np.zeros(shape, np.float32), np.zeros(shape[1], np.float32)
        for weight, k_N in zip(weights_P, k_P_N, strict=True):
            for left_I, right_J in zip(left_R_I, right_R_J, strict=True):
                weighted_I = compute("mul", [np.full_like(k_N[left_I], weight), k_N[left_I]])
                sums_I_J = compute("fma", [*np.broadcast_arrays(weighted_I[:, None], k_N[right_J]), sums_I_J])
            if bias_J is not None:
                sums_J = compute("fma", [np.full(shape[1], weight), k_N[bias_J], sums_J])
        of_products = np.float32(product_unit(rank) / NORMAL_STD)
        wanted.append(compute("mul", [sums_I_J, np.full_like(sums_I_J, of_products)]).reshape(-1))
        wanted += [] if bias_J is None else [compute("mul", [sums_J, np.full_like(sums_J, 1.0 / NORMAL_STD)])]
    require_same(gradient_sum(weights_P, keys_P), np.concatenate(wanted), "a gradient of low rank")


def require_same(found: np.ndarray, wanted: np.ndarray, what: str, where: str = "this processor") -> None:
    """Raise WrongCodeError unless two arrays have the same bits; all NaN count as the same.

    Args:
        what: what the arrays are, for the message.
        where: what the code is for.
    """
    found, wanted = (np.ascontiguousarray(x).view(np.uint32) for x in (found, wanted))
    nan = np.isnan(found.view(np.float32)) & np.isnan(wanted.view(np.float32))
    differing = np.count_nonzero((found != wanted) & ~nan)
    if differing:
        raise WrongCodeError(
            f"simd's machine code for {where} is wrong: {differing:,} of {found.size:,} words of {what} differ "
            "from their definition. Please report this with the output of es-service doctor; until it is mended, set "
            "compute.rollout to xla"
        )


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


def as_words(values: list[np.ndarray]) -> np.ndarray:
    """Values of outputs as words; a bool is 0 or 1."""
    return np.stack([x.astype(np.uint32) if x.dtype == bool else x.view(np.uint32) for x in values])
