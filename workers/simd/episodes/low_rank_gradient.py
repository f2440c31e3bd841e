"""Code of the sum of weighted noise of low rank over a block of pairs.

    weight (i, j)   scale * sum over pairs and ranks of (w A[r, i]) B[r, j]
    bias (j)        scale * sum over pairs of w k[j]

with fused products, pairs and ranks in their order, and w A rounded. The scale makes noise integers standard normal.
"""

from __future__ import annotations

import ctypes
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.low_rank import layers_of_noise, numbers, product_unit
from es_service.protocol.noise import KEY_WORDS, NORMAL_STD
from es_service.protocol.policy_spec import PolicySpec
from workers.compilable import Compilable
from workers.simd.backend.function_builder import FunctionBuilder, Values, module
from workers.simd.backend.native import Native, load_compiled
from workers.simd.backend.target import Target, host_target
from workers.simd.backend.words import aligned, require
from workers.simd.episodes.check import check_low_rank_gradient
from workers.simd.episodes.noise import UNROLLED, definition, float_constant, lanes, load_key, noise_of

TABLE = 6
"""Numbers of a layer in the table of the kernel."""


def make_low_rank_gradient_sum(policy: PolicySpec, rank: int, target: Target | None = None) -> Compilable:
    """Sum of weighted noise, with the interface of `workers.rollout.make_low_rank_gradient_sum`; compiled here."""
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

    def draw(pair: str, _: Values) -> Values:
        key, first = load_key(builder, "%keys", pair), builder.value(f"mul i64 {pair}, %drawn")

        def vector(at: str, _: Values) -> Values:
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

    def added(factor: str, place: str, sums: Values) -> Values:
        vectors = [builder.value(f"load {floats}, ptr {at}, align 4") for at in group_at("%rows", place)]
        return [builder.fma(builder.splat(factor), vector, total) for vector, total in zip(vectors, sums, strict=True)]

    def write(scale: str, sums: Values, place: str) -> None:
        for at, total in zip(group_at("%sums", place), sums, strict=True):
            builder.do(f"store {floats} {builder.value(f'fmul {floats} {total}, {scale}')}, ptr {at}, align 4")

    zeros = [(floats, "zeroinitializer")] * UNROLLED

    def layer(number: str, _: Values) -> Values:
        left, right, bias, inputs, outputs, start = (
            builder.load("i64", "%table", builder.index((number, TABLE), (place, 1))) for place in range(TABLE)
        )
        groups = builder.value(f"udiv i64 {builder.index((outputs, 1), (group - 1, 1))}, {group}")

        def row(i: str, _: Values) -> Values:
            first = builder.index((start, 1), (builder.value(f"mul i64 {i}, {outputs}"), 1))

            def block(j: str, _: Values) -> Values:
                def add_pair(pair: str, sums: Values) -> Values:
                    weight = builder.load("float", "%weights", pair)
                    of_pair = builder.value(f"mul i64 {pair}, {stride}")

                    def add_rank(r: str, sums: Values) -> Values:
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

            def block(j: str, _: Values) -> Values:
                def add_pair(pair: str, sums: Values) -> Values:
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
