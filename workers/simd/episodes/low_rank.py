"""Code of policies whose noise has low rank (`protocol/policy_spec.py`), for a block of members, two of each pair.

All members share the weights of the centre. What a member has of its own is in the beginning of each sum:

    bias +- unit k, then + t_r B[r] for each r,    t_r = (+- unit / (NORMAL_STD sqrt(rank))) * sum of x A[r]

in the order of the ranks, with fused products. The sums of x A are in the order of the inputs, a member in each lane;
so the outputs of a hidden layer are exchanged to [input, lane] for the next one.

A gradient is the sum of weighted noise over a block of pairs:

    weight (i, j)   scale * sum over pairs and ranks of (w A[r, i]) B[r, j]
    bias (j)        scale * sum over pairs of w k[j]

with fused products, pairs and ranks in their order, and w A rounded. The scale makes noise integers standard normal.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, Domain, normal_integers, stream_keys
from es_service.protocol.policy_spec import PolicySpec, layers_of_noise, numbers, product_unit
from workers.compiling import Compilable
from workers.simd.backend.function_builder import FunctionBuilder, Names, module
from workers.simd.backend.native import Native, aligned, load_compiled, require, require_same
from workers.simd.backend.target import Target, host_target
from workers.simd.episodes.hidden import Layer
from workers.simd.episodes.noise_kernels import (
    UNROLLED,
    by_sign,
    definition,
    float_constant,
    lanes,
    load_key,
    noise_of,
    noise_of_weights,
)
from workers.simd.graph.operations import compute


class BlockNoise(NamedTuple):
    """The noise of a block of members in memory: an array of `noise.fill_function`.

    Its vectors are those of hidden layers: for each tile of outputs the rows of B and then the biases. Its single
    numbers are A of every layer, by inputs and then ranks, and B and the biases of the last layer, by outputs.
    """

    rank: int
    bias: bool
    first: tuple[int, ...]
    """Number of the first vector of each hidden layer."""
    left: tuple[int, ...]
    """Number of the first single number of A of each layer."""
    right: int
    """Number of the first single number of B of the last layer, which the biases follow."""
    vectors: int
    places: NDArray[np.uint32]
    """Coordinates: of the first lanes of the vectors, then of the single numbers."""

    def block_bytes(self, width: int) -> int:
        """Number of bytes of the noise of a block of members, as many as a vector has lanes."""
        return (self.vectors * (width // 2) + len(self.places) - self.vectors) * width

    def singles(self, builder: FunctionBuilder) -> str:
        """Pointer to the single numbers, [number, lane]."""
        return builder.at("%noise", self.vectors * (builder.width // 2) * builder.width, "i8")


def plan_noise(
    spec: PolicySpec, rank: int, inputs_O: NDArray[np.intp], hidden: Sequence[Layer], width: int
) -> BlockNoise:
    """Lay out the noise of a policy whose hidden layers have this layout, in vectors of `width` lanes.

    Args:
        inputs_O: inputs of the first layer that are computed.
    """
    vectors: list[int] = []
    singles: list[NDArray[np.uint32]] = []
    first, left, rows = [], [], inputs_O
    *below, last = noise = layers_of_noise(spec, rank)
    for layer, layer_noise in zip(hidden, below, strict=True):
        first.append(len(vectors))
        starts = [row[0] for row in (*layer_noise.right, *([] if layer_noise.bias is None else [layer_noise.bias]))]
        for tile in range(0, layer.tiles * layer.tile, layer.tile):
            vectors += [int(start) + (tile + v) * width for start in starts for v in range(layer.tile)]
    for layer_noise in noise:
        left.append(sum(map(len, singles)))
        singles.append(layer_noise.left[:, rows].T.reshape(-1))
        rows = np.arange(layer_noise.right.shape[1])
    right = sum(map(len, singles))
    singles += [last.right.reshape(-1), *([] if last.bias is None else [last.bias])]
    places = np.concatenate([np.array(vectors, np.uint32), *singles])
    return BlockNoise(rank, spec.bias, tuple(first), tuple(left), right, len(vectors), places)


def thin_sums(builder: FunctionBuilder, noise: BlockNoise, layer: int, inputs: int, x: str) -> Names:
    """The vectors t of each rank, a member in each lane, of layer number `layer` with inputs x [input, lane]."""
    floats, rank, singles = builder.llvm_types["f"], noise.rank, noise.singles(builder)
    unit = builder.value(f"fmul float %unit, {float_constant(product_unit(rank))}")

    def add(row: str, sums: Names) -> Names:
        seen = builder.load(floats, x, row)
        places = [builder.index((row, rank), (noise.left[layer] + r, 1)) for r in range(rank)]
        return [
            builder.fma(seen, _integer(builder, singles, place), total)
            for place, total in zip(places, sums, strict=True)
        ]

    sums = builder.loop(inputs, add, [(floats, "zeroinitializer")] * rank)
    signed = by_sign(builder, builder.splat(unit))
    return [builder.value(f"fmul {floats} {total}, {signed}") for total in sums]


def begins_of_hidden(
    builder: FunctionBuilder, noise: BlockNoise, layer: Layer, number: int, thin: str
) -> Callable[[str, str, Names], Names]:
    """Function (first member, tile, the centre's biases of each member and vector of the tile) -> first values of the
    sums of these members, for hidden layer `number`.

    Args:
        thin: the vectors of `thin_sums` in memory.
    """
    plus = builder.splat("%unit")
    minus = builder.splat(builder.value("fneg float %unit"))
    rows = noise.rank + noise.bias

    def begins(first: str, tile: str, biases: Names) -> Names:
        first_pair, sums = builder.value(f"lshr i64 {first}, 1"), list(biases)
        for pair in range(len(biases) // layer.tile // 2):
            start = builder.index((first_pair, noise.vectors), (pair * noise.vectors + noise.first[number], 1))
            start = builder.index((start, 1), (tile, rows * layer.tile))
            vectors = [
                [
                    _integer(builder, "%noise", builder.index((start, 1), (row * layer.tile + v, 1)))
                    for row in range(rows)
                ]
                for v in range(layer.tile)
            ]
            for member, unit in ((2 * pair, plus), (2 * pair + 1, minus)):
                at = [builder.index((first, 1), (r * builder.width + member, 1)) for r in range(noise.rank)]
                factors = [builder.splat(builder.load("float", thin, place)) for place in at]
                for v in range(layer.tile):
                    place = member * layer.tile + v
                    sums[place] = _moved(builder, noise, sums[place], vectors[v], unit, factors)
        return sums

    return begins


def begins_of_last(
    builder: FunctionBuilder, noise: BlockNoise, outputs: range, count: int, biases: Names, thin: Names
) -> Names:
    """First values of the sums of some outputs of the last layer, a member in each lane.

    Args:
        count: how many outputs the layer has.
        biases: those of the centre for these outputs.
        thin: the vectors of `thin_sums`.
    """
    singles, unit = noise.singles(builder), by_sign(builder, builder.splat("%unit"))
    sums = []
    for output, bias in zip(outputs, biases, strict=True):
        rows = [noise.right + row * count + output for row in range(noise.rank + noise.bias)]
        sums.append(_moved(builder, noise, bias, [_integer(builder, singles, row) for row in rows], unit, thin))
    return sums


def _moved(builder: FunctionBuilder, noise: BlockNoise, value: str, rows: Names, unit: str, factors: Names) -> str:
    """A sum before the inputs: the centre's bias, and what a member adds to it.

    Args:
        rows: vectors of the noise of this output: B of each rank, and that of the bias.
    """
    if noise.bias:
        value = builder.fma(rows[noise.rank], unit, value)
    for row, factor in zip(rows, factors, strict=False):
        value = builder.fma(row, factor, value)
    return value


def _integer(builder: FunctionBuilder, bytes_: str, vector: str | int) -> str:
    """Vector of noise integers k = 2 j + 1, as floats, of a vector of bytes j."""
    one, two = (builder.splat(float_constant(np.float32(value))) for value in (1.0, 2.0))
    return builder.fma(noise_of_weights(builder, bytes_, vector), two, one)


TABLE = 6
"""Numbers of a layer in the table of the kernel."""


def make_low_rank_gradient_sum(policy: PolicySpec, rank: int, target: Target | None = None) -> Compilable:
    """Sum of weighted noise, with the interface of `workers.xla.make_low_rank_gradient_sum`; compiled here."""
    target = target or host_target()
    group = UNROLLED * target.width
    drawn = -(-numbers(policy, rank) // target.width)
    table, count = layer_table(policy, rank), policy.parameters
    of_products = np.float32(product_unit(rank) / NORMAL_STD)
    signature = [*[ctypes.c_void_p] * 5, *[ctypes.c_int64] * 4, ctypes.c_float]

    def function(native: Native):
        call = native.function(*signature)

        def gradient_sum(weights_P: NDArray[np.float32], noise_keys_P: NDArray[np.uint32]) -> NDArray[np.float32]:
            weights_P, keys_P = np.ascontiguousarray(weights_P, np.float32), np.ascontiguousarray(noise_keys_P)
            pairs = len(weights_P)
            require(keys_P.dtype == np.uint32 and keys_P.shape == (pairs, KEY_WORDS), "a key for each weight")
            # A group of vectors that begins at the last output of a row reads and writes what follows it.
            rows = aligned((pairs * drawn * target.width + group,)).view(np.float32)
            sums = aligned((count + group,)).view(np.float32)
            call(weights_P, keys_P, rows, table, sums, pairs, drawn, rank, len(table), of_products)
            return sums[:count]

        return gradient_sum

    name, text = f"gradient of low rank {definition()}", lambda: gradient_module(target)
    checked = lambda native: check_low_rank_gradient(function(native), policy, rank)  # noqa: E731
    gradient_sum = function(load_compiled(name, text, target, check=checked))
    return Compilable(gradient_sum, lambda *_: None)


def layer_table(policy: PolicySpec, rank: int) -> NDArray[np.int64]:
    """Of each layer: first coordinates of A, of B and of the biases (-1 if there are none), the numbers of its inputs
    and outputs, and the place of its first weight among the parameters."""
    ends = accumulate((inputs + policy.bias) * outputs for inputs, outputs in policy.layers)
    rows = [
        (left[0, 0], right[0, 0], -1 if bias is None else bias[0], left.shape[1], right.shape[1], start)
        for (left, right, bias), start in zip(layers_of_noise(policy, rank), [0, *ends], strict=False)
    ]
    return np.array(rows, np.int64)


def gradient_module(target: Target) -> str:
    """LLVM IR of `void kernel(ptr weights, ptr keys, ptr rows, ptr table, ptr sums, i64 pairs, i64 drawn, i64 rank,
    i64 layers, float of_products)`.

    rows has room for `drawn` vectors of noise of each pair and sums for the parameters, both for a group of vectors
    more. The sums are written in their order: what a group writes beyond the end of its row is written again.
    """
    pointers = [f"ptr noalias %{name}" for name in ("weights", "keys", "rows", "table", "sums")]
    integers = [f"i64 %{name}" for name in ("pairs", "drawn", "rank", "layers")]
    builder = FunctionBuilder("inside", [*pointers, *integers, "float %of_products"], target)
    width, floats, group = target.width, builder.llvm_types["f"], UNROLLED * target.width
    of_products = builder.splat("%of_products")
    of_numbers = builder.splat(float_constant(np.float32(1.0 / NORMAL_STD)))
    stride = builder.index(("%drawn", width))

    def draw(pair: str, _: Names) -> Names:
        key, first = load_key(builder, "%keys", pair), builder.value(f"mul i64 {pair}, %drawn")

        def vector(at: str, _: Names) -> Names:
            start = builder.splat(builder.value(f"trunc i64 {builder.index((at, width))} to i32"), "i")
            coordinate = builder.value(f"add {builder.llvm_types['i']} {start}, {lanes(builder)}")
            k = noise_of(builder, key, coordinate, halved=False)
            value = builder.value(f"sitofp {builder.llvm_types['i']} {k} to {floats}")
            builder.store(floats, value, "%rows", builder.index((first, 1), (at, 1)))
            return []

        builder.loop("%drawn", vector)
        return []

    def group_at(pointer: str, place: str) -> list[str]:
        """Addresses of the vectors of a group, whose first number is at a place."""
        return [builder.at(pointer, builder.index((place, 1), (v * width, 1)), "float") for v in range(UNROLLED)]

    def added(factor: str, place: str, sums: Names) -> Names:
        vectors = [builder.value(f"load {floats}, ptr {at}, align 4") for at in group_at("%rows", place)]
        return [builder.fma(builder.splat(factor), vector, total) for vector, total in zip(vectors, sums, strict=True)]

    def write(scale: str, sums: Names, place: str) -> None:
        for at, total in zip(group_at("%sums", place), sums, strict=True):
            builder.do(f"store {floats} {builder.value(f'fmul {floats} {total}, {scale}')}, ptr {at}, align 4")

    zeros = [(floats, "zeroinitializer")] * UNROLLED

    def layer(number: str, _: Names) -> Names:
        left, right, bias, inputs, outputs, start = (
            builder.load("i64", "%table", builder.index((number, TABLE), (place, 1))) for place in range(TABLE)
        )
        groups = builder.value(f"udiv i64 {builder.index((outputs, 1), (group - 1, 1))}, {group}")

        def row(i: str, _: Names) -> Names:
            first = builder.index((start, 1), (builder.value(f"mul i64 {i}, {outputs}"), 1))

            def block(j: str, _: Names) -> Names:
                def add_pair(pair: str, sums: Names) -> Names:
                    weight = builder.load("float", "%weights", pair)
                    of_pair = builder.value(f"mul i64 {pair}, {stride}")

                    def add_rank(r: str, sums: Names) -> Names:
                        at_left, at_right = (builder.value(f"mul i64 {r}, {size}") for size in (inputs, outputs))
                        a = builder.load("float", "%rows", builder.index((of_pair, 1), (left, 1), (at_left, 1), (i, 1)))
                        place = builder.index((of_pair, 1), (right, 1), (at_right, 1), (j, group))
                        return added(builder.value(f"fmul float {weight}, {a}"), place, sums)

                    return builder.loop("%rank", add_rank, [(floats, total) for total in sums])

                write(of_products, builder.loop("%pairs", add_pair, zeros), builder.index((first, 1), (j, group)))
                return []

            builder.loop(groups, block)
            return []

        def biases() -> None:
            first = builder.index((start, 1), (builder.value(f"mul i64 {inputs}, {outputs}"), 1))

            def block(j: str, _: Names) -> Names:
                def add_pair(pair: str, sums: Names) -> Names:
                    of_pair = builder.value(f"mul i64 {pair}, {stride}")
                    place = builder.index((of_pair, 1), (bias, 1), (j, group))
                    return added(builder.load("float", "%weights", pair), place, sums)

                write(of_numbers, builder.loop("%pairs", add_pair, zeros), builder.index((first, 1), (j, group)))
                return []

            builder.loop(groups, block)

        builder.loop(inputs, row)
        builder.when(builder.value(f"icmp sge i64 {bias}, 0"), biases)
        return []

    builder.loop("%pairs", draw)
    builder.loop("%layers", layer)
    return module([builder])


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
