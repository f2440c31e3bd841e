"""Code of policies whose noise has low rank (`es_service.protocol.low_rank`), for a block of members, two of each pair.

All members share the weights of the centre. What a member has of its own is in the beginning of each sum:

    bias +- unit k, then + t_r B[r] for each r,    t_r = (+- unit / (NORMAL_STD sqrt(rank))) * sum of x A[r]

in the order of the ranks, with fused products. The sums of x A are in the order of the inputs, a member in each lane;
so the outputs of a hidden layer are exchanged to [input, lane] for the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.low_rank import layers_of_noise, product_unit
from es_service.protocol.policy_spec import PolicySpec
from workers.simd.backend.function_builder import FunctionBuilder, Values
from workers.simd.episodes.layout import Layer
from workers.simd.episodes.noise import by_sign, float_constant, noise_of_weights


class LowRankNoise(NamedTuple):
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
    """Number of vectors of a pair."""
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
) -> LowRankNoise:
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
    return LowRankNoise(rank, spec.bias, tuple(first), tuple(left), right, len(vectors), places)


def thin_sums(builder: FunctionBuilder, noise: LowRankNoise, layer: int, inputs: int, x: str) -> Values:
    """The vectors t of each rank, a member in each lane, of layer number `layer` with inputs x [input, lane]."""
    floats, rank, singles = builder.llvm_types["f"], noise.rank, noise.singles(builder)
    unit = builder.value(f"fmul float %unit, {float_constant(product_unit(rank))}")

    def add(row: str, sums: Values) -> Values:
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
    builder: FunctionBuilder, noise: LowRankNoise, layer: Layer, number: int, thin: str
) -> Callable[[str, str, Values], Values]:
    """Function (first member, tile, the centre's biases of each member and vector of the tile) -> first values of the
    sums of these members, for hidden layer `number`.

    Args:
        thin: the vectors of `thin_sums` in memory.
    """
    plus = builder.splat("%unit")
    minus = builder.splat(builder.value("fneg float %unit"))
    rows = noise.rank + noise.bias

    def begins(first: str, tile: str, biases: Values) -> Values:
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
    builder: FunctionBuilder, noise: LowRankNoise, outputs: range, count: int, biases: Values, thin: Values
) -> Values:
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


def _moved(builder: FunctionBuilder, noise: LowRankNoise, value: str, rows: Values, unit: str, factors: Values) -> str:
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
