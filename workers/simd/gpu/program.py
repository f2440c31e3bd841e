"""A run's training episodes as PTX: noise, the policy's layers, and control steps, each a kernel of its own.

    fill(keys [pair, 4], places [row, TILE], noises, pairs, threads)      once per episode
    look(carries [word, lane], constants [2 * input], seen [input, lane], lanes, 1)
    layer_1(seen, noises, centre, out, unit, pairs, threads), layer_2 ...
    advance(carries, constants, actions [action, lane], action_keys [4, lane], seen, lanes, 1)

A lane is a member. `advance` moves and looks again.

In the kernel of a layer, a thread has eight outputs of one pair. The weights of a pair are formed anew in each step,
from the centre and a byte of noise, with the rounding that `episodes/hidden.py` and `episodes/network.py` describe; so
outputs have the bits of those on processors. A thread computes both members of its pair, which share the noise.
Neighbouring threads are neighbouring pairs: they read neighbouring words, and the same words of the centre.

Memory:
    seen, out   float32 [input or output, member]; members 2 p and 2 p + 1 are + and - of pair p
    noises      bytes j + 128 of the noise k = 2 j + 1: [row, pair, TILE]
    centre      float32 [row, TILE]
A row is one input, or the bias, of a tile of TILE outputs: rows of a tile are its inputs and then its bias.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import KEY_WORDS, normal_integers
from es_service.protocol.policy_spec import Activation, PolicySpec
from workers.environments import Environment
from workers.episode import episode_steps
from workers.simd.backend.emit import graph_function
from workers.simd.backend.function_builder import FunctionBuilder, Names
from workers.simd.backend.native import words_of
from workers.simd.backend.ptx import EXACT, Pointer, QuickWriter, StepCall, lane_function
from workers.simd.backend.target import Target
from workers.simd.episodes.hidden import activated, units
from workers.simd.frontend.trace import trace_jaxpr

TILE = 8
"""Outputs of a thread, whose noise is one load of 64 bits."""
BIAS_OF_BYTES = 128
"""A byte is j plus this, so that it is not negative."""


class GpuLayer(NamedTuple):
    name: str
    inputs: int
    tiles: int
    rows_of_tile: int
    first: int
    bias: bool
    activation: Activation | None
    is_last: bool


def layers_of(policy: PolicySpec, inputs_O: NDArray[np.intp]) -> tuple[tuple[GpuLayer, ...], NDArray[np.uint32]]:
    """Layers of a policy, and the places [row, TILE] of their weights in the flat vector of parameters.

    Outputs beyond the last one of a layer have the place 0; nobody reads them.

    Args:
        inputs_O: inputs of the first layer that are computed; others are always zero.
    """
    layers, places, start, first, rows = [], [], 0, 0, inputs_O
    for number, (inputs, outputs) in enumerate(policy.layers, 1):
        is_last, tiles, of_tile = number == len(policy.layers), -(-outputs // TILE), len(rows) + policy.bias
        weights = start + rows[:, None] * outputs + np.arange(outputs)
        if policy.bias:
            weights = np.concatenate([weights, start + inputs * outputs + np.arange(outputs)[None]])
        padded = np.pad(weights, ((0, 0), (0, tiles * TILE - outputs)))
        places.append(padded.reshape(of_tile, tiles, TILE).transpose(1, 0, 2).reshape(-1, TILE))
        activation = ("tanh" if policy.output == "tanh" else None) if is_last else policy.activation
        layers.append(GpuLayer(f"layer_{number}", len(rows), tiles, of_tile, first, policy.bias, activation, is_last))
        start, first, rows = start + (inputs + policy.bias) * outputs, first + tiles * of_tile, np.arange(outputs)
    return tuple(layers), np.concatenate(places).astype(np.uint32)


def noise_bytes(key: Any, place_T: Any) -> Any:
    """Two words with the bytes of the noise at the places of a row, from the stream key of a pair."""
    j_T = ((normal_integers(jnp, key, place_T) - 1) >> 1) + BIAS_OF_BYTES
    shifted_T = j_T.astype(jnp.uint32) << (8 * (jnp.arange(TILE, dtype=jnp.uint32) % 4))
    first, second = shifted_T[:4], shifted_T[4:]
    return jnp.stack([half[0] | half[1] | half[2] | half[3] for half in (first, second)])


def fill_function(noise: FunctionBuilder, target: Target) -> FunctionBuilder:
    """Function of the kernel `fill(keys [pair, 4], places [row, TILE], noises, pairs, threads)`.

    Args:
        noise: the function of `noise_bytes`, with all words of a lane in a row.
    """
    pointers = ["ptr noalias %keys", "ptr noalias %places", "ptr noalias %noises"]
    builder = FunctionBuilder("fill_of_lane", [*pointers, "i64 %pairs", "i64 %lanes", "i64 %lane"], target)
    row, pair = _row_and_pair(builder)
    given = [
        builder.at("%keys", builder.index((pair, 4)), "i32"),
        builder.at("%places", builder.index((row, TILE)), "i32"),
        builder.at("%noises", builder.index(("%lane", 2)), "i32"),
    ]
    builder.do(f"call void @{noise.name}({', '.join(f'ptr {pointer}' for pointer in given)})")
    return builder


def layer_function(layer: GpuLayer, target: Target) -> FunctionBuilder:
    """Function of the kernel `NAME(seen, noises, centre, out, unit, pairs, threads)`, of tiles x pairs threads."""
    pointers = [f"ptr noalias %{name}" for name in ("seen", "noises", "centre", "out")]
    numbers = ["float %unit", "i64 %pairs", "i64 %lanes", "i64 %lane"]
    builder = FunctionBuilder(f"{layer.name}_of_lane", [*pointers, *numbers], target)
    floats, (unit, twice) = builder.llvm_types["f"], units(builder)
    minus_unit, minus_twice = (builder.value(f"fneg {floats} {vector}") for vector in (unit, twice))
    tile, pair = _row_and_pair(builder)
    members, member = builder.index(("%pairs", 2)), builder.index((pair, 2))
    first = builder.index((tile, layer.rows_of_tile), (layer.first, 1))
    noises = builder.at("%noises", builder.value(f"add i64 {builder.value(f'mul i64 {first}, %pairs')}, {pair}"), "i64")
    centre, seen = builder.at("%centre", builder.index((first, TILE)), "float"), builder.at("%seen", member, "float")

    def weights_of(row: str | int) -> Names:
        """Weights of both members, [output, sign]."""
        j_T = _noise(builder, builder.at(noises, builder.value(f"mul i64 {row}, %pairs"), "i64"))
        weights = []
        for j, c in zip(j_T, _vector(builder, builder.at(centre, builder.index((row, TILE)), "float"), 4), strict=True):
            plus = builder.fma(j, twice, builder.value(f"fadd {floats} {c}, {unit}"))
            if layer.is_last:
                minus = builder.fma(j, minus_twice, builder.value(f"fadd {floats} {c}, {minus_unit}"))
            else:
                minus = builder.value(f"fsub {floats} {builder.value(f'fadd {floats} {c}, {c}')}, {plus}")
            weights += [plus, minus]
        return weights

    def add(row: str, sums: Names) -> Names:
        x_S = _vector(builder, builder.at(seen, builder.value(f"mul i64 {row}, {members}"), "float"), 2, 1)
        return [builder.fma(x_S[k % 2], w, s) for k, (w, s) in enumerate(zip(weights_of(row), sums, strict=True))]

    begin = weights_of(layer.inputs) if layer.bias else ["zeroinitializer"] * 2 * TILE
    sums = builder.loop(layer.inputs, add, [(floats, init) for init in begin])
    if layer.activation is not None:
        sums = activated(builder, layer.activation, sums)
    out = builder.at("%out", member, "float")
    for k, value in enumerate(sums):
        output = builder.index((tile, TILE), (k // 2, 1))
        builder.store(floats, value, builder.at(out, builder.value(f"mul i64 {output}, {members}"), "float"), k % 2)
    return builder


def _row_and_pair(builder: FunctionBuilder) -> tuple[str, str]:
    """Numbers of a thread's row, or tile, and pair."""
    return builder.value("udiv i64 %lane, %pairs"), builder.value("urem i64 %lane, %pairs")


def _vector(builder: FunctionBuilder, pointer: str, size: int, loads: int = TILE // 4) -> Names:
    """Neighbouring floats in memory, each as a vector of one lane, by loads of `size`."""
    vectors, whole = [], f"<{size} x float>"
    for number in range(loads):
        place = builder.at(pointer, number, whole)
        loaded = builder.value(f"load {whole}, ptr {place}, align {4 * size}")
        shuffle = f"shufflevector {whole} {loaded}, {whole} poison, <1 x i32>"
        vectors += [builder.value(f"{shuffle} <i32 {k}>") for k in range(size)]
    return vectors


def _noise(builder: FunctionBuilder, pointer: str) -> Names:
    """The noise j of a row of a tile as floats: the difference of 2^23 + byte, which needs no conversion, and of 2^23
    plus the bias of bytes. Both are exact."""
    floats, word = builder.llvm_types["f"], builder.value(f"load i64, ptr {pointer}, align 8")
    halves = [builder.value(f"trunc i64 {source} to i32") for source in (word, builder.value(f"lshr i64 {word}, 32"))]
    offset = struct.pack(">d", -(2.0**23 + BIAS_OF_BYTES)).hex().upper()
    j_T = []
    for k in range(TILE):
        shifted = builder.value(f"lshr i32 {halves[k // 4]}, {8 * (k % 4)}")
        byte = builder.value(f"and i32 {shifted}, 255")
        bits = builder.value(f"or i32 {byte}, {0x4B000000}")
        number = builder.value(f"bitcast i32 {bits} to {floats}")
        j_T.append(builder.value(f"fadd {floats} {number}, splat (float 0x{offset})"))
    return j_T


KEY = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)


def function_of(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[tuple[str, Any]],
    out: str,
    target: Target,
    shared: Sequence[str] = (),
    *,
    quick: bool = False,
    lanes_word: int | None = None,
) -> list[FunctionBuilder]:
    """Function `void name(ptr ..., i64 lanes)` of a JAX function, and functions that it calls; it is the last one.

    Args:
        arguments: (pointer, shapes and dtypes) of each of its arguments. A pointer may occur twice.
        out: pointer to the words of the result.
        shared: pointers whose words are neighbours. If all are, there is no parameter `lanes`.
        quick: whether quotients and roots are those of `ptx.QuickWriter`.
        lanes_word: see `trace_jaxpr`.
    """
    closed = jax.make_jaxpr(function)(*(tree for _, tree in arguments))
    graph, _, outputs = trace_jaxpr(closed, lanes_word=lanes_word)
    sources = [(pointer, words_in(tree)) for pointer, tree in arguments]
    apart = sorted({*(pointer for pointer, _ in arguments), out} - set(shared))
    exact = graph_function(name + EXACT * quick, graph, outputs, sources, out, target, apart)
    if not quick:
        return [exact]
    return [exact, graph_function(name, graph, outputs, sources, out, target, apart, QuickWriter)]


def words_in(tree: Any) -> int:
    return sum(map(words_of, jax.tree.leaves(tree)))


def noise_functions(target: Target) -> list[FunctionBuilder]:
    places = jax.ShapeDtypeStruct((TILE,), jnp.uint32)
    given = [("keys", KEY), ("places", places)]
    noise = function_of("noise", noise_bytes, given, "noises", target, ["keys", "places", "noises"])
    return [*noise, fill_function(noise[-1], target)]


def episode_functions(
    environment: Environment, spec: WorkerSpec, inputs_O: np.ndarray, target: Target
) -> list[FunctionBuilder]:
    """Functions of the kernels of a run's training episodes.

    Args:
        inputs_O: indices of the observations that are computed; others are always zero.
    """
    return [
        *noise_functions(target),
        *(layer_function(layer, target) for layer in layers_of(spec.policy, inputs_O)[0]),
        *step_functions(environment, spec, inputs_O, target, quick=True),
    ]


def step_functions(
    environment: Environment, spec: WorkerSpec, inputs_O: np.ndarray, target: Target, *, quick: bool
) -> list[FunctionBuilder]:
    """Functions of the kernels `look` and `advance`, with arguments as `episode_functions` and `function_of`."""
    steps = episode_steps(environment, spec, training=True, inputs_O=inputs_O, finds_faults=False)
    carry = jax.eval_shape(steps.begin, KEY)
    inputs, outputs = (jax.ShapeDtypeStruct((size,), jnp.float32) for size in (len(inputs_O), spec.policy.outputs))
    of_carry, of_constants = ("carries", carry), ("constants", inputs)
    see = function_of(
        "see", steps.normalised_observation, [of_carry, of_constants, of_constants], "seen", target, ["constants"]
    )
    given = [of_carry, of_constants, ("seen", inputs), ("actions", outputs), ("action_keys", KEY)]
    alive = words_in(carry.state)
    move = function_of("move", steps.advance, given, "carries", target, ["constants"], quick=quick, lanes_word=alive)
    carries, constants, seen = Pointer("carries"), Pointer("constants", by_lane=False), Pointer("seen")
    sees = StepCall(see[-1], ("carries", "constants", "seen"))
    moves = StepCall(move[-1], ("carries", "constants", "seen", "actions", "action_keys"))
    of_move = [carries, constants, Pointer("actions"), Pointer("action_keys"), seen]
    return [
        *see,
        *move,
        lane_function("look", [carries, constants, seen], [sees], target),
        lane_function("advance", of_move, [moves, sees], target),
    ]
