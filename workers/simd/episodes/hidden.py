"""Code of the hidden layers of a policy, for a block of members: f(weights x), one member per lane.

f is `Layer.activation`. A vector holds several outputs of one member. Every output is one sum in the order of the
inputs, starting with the bias (0 without biases), whatever the width and wherever the weights are from:

shared: from the centre, for all members.
perturbed: the weights of + are (centre + unit) + 2 unit j, and those of - are 2 centre minus that weight, its mirror
    image up to a rounding. The members of a pair share the bytes j of their noise k = 2 j + 1. The weights of + are
    computed in each step or, if the network is small (`Network.keeps_weights`), once per episode by `keep_function`.
per_lane: from the parameters of each member.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.policy_spec import Activation, PolicyOutput, PolicySpec
from workers.simd.backend.emit import inline
from workers.simd.backend.function_builder import FunctionBuilder, Names
from workers.simd.backend.native import ALIGNMENT, aligned
from workers.simd.backend.target import Target
from workers.simd.episodes.noise_kernels import noise_of_weights
from workers.simd.frontend.primitives.elementwise import extreme_of
from workers.simd.graph import elementary
from workers.simd.graph.folding import FoldingGraph

# Layout of a policy's weights in memory, for the code that `network.py` makes.

KEPT_BYTES = 1 << 18
"""Most bytes of the weights that are kept for a block of members; they are read in each step and must stay in L2."""


class Layer(NamedTuple):
    """Layout of a hidden layer's weights: tiles of outputs, in each the inputs and then the biases, in each outputs."""

    inputs: int
    outputs: int
    tiles: int
    tile: int
    """Vectors of outputs in a tile, which are summed at the same time."""
    first: int
    """Number of the layer's first vector of weights."""
    activation: Activation
    bias: bool


class Network(NamedTuple):
    """A policy's layers and the place of each weight in the flat vector of parameters.

    The weights of hidden layers are vectors. Only the place of a vector's first lane is kept, and the other lanes
    follow it. (Lanes beyond the end of a row hold weights of the next row; they are never used.) The weights of the
    last layer are single numbers, ordered by inputs with the biases last, and for each input by outputs.
    """

    hidden: tuple[Layer, ...]
    inputs: int
    outputs: int
    vectors: int
    """Number of vectors of weights of all hidden layers."""
    places: NDArray[np.uint32]
    """Places in the flat vector of parameters: of the vectors, then of the single weights."""
    target: Target
    """Target of the code, whose vectors these are."""
    output: PolicyOutput
    """Function of the last layer's sums; all but `tanh` are computed elsewhere."""
    bias: bool

    @property
    def width(self) -> int:
        """Lanes of a vector."""
        return self.target.width

    @property
    def hidden_vectors(self) -> int:
        """Number of vectors that hold the outputs of two layers, for as many members as there are lanes."""
        return 2 * self.width * max((layer.tiles * layer.tile for layer in self.hidden), default=0)

    @property
    def rows(self) -> int:
        """Number of vectors that hold all weights."""
        return self.vectors - -(len(self.places) - self.vectors) // self.width

    @property
    def noise_bytes(self) -> int:
        """Number of bytes of the noise of a block of members."""
        return self._pair_weights + (len(self.places) - self.vectors) * self.width

    @property
    def keeps_weights(self) -> bool:
        """Whether the hidden layers' weights of a block's + members are made once per episode, and not in each step."""
        return 0 < 4 * self._pair_weights <= KEPT_BYTES

    @property
    def kept_at(self) -> int:
        """Byte of the noise's memory at which these weights begin, as float32 [pair, vector, lane]."""
        return -(-self.noise_bytes // ALIGNMENT) * ALIGNMENT

    @property
    def block_bytes(self) -> int:
        """Number of bytes of the noise of a block of members and of the weights that are kept."""
        return self.kept_at + 4 * self._pair_weights * self.keeps_weights

    @property
    def _pair_weights(self) -> int:
        """Number of weights in vectors of a block's pairs, one for each pair."""
        return self.width // 2 * self.vectors * self.width

    def pack(self, parameters_D: NDArray[np.float32]) -> NDArray[np.float32]:
        """Array [rows, width] of the vectors of weights, followed by the single weights."""
        padded_D = np.concatenate([parameters_D, np.zeros(self.width, np.float32)])
        of_vectors, single = self.places[: self.vectors], self.places[self.vectors :]
        weights = aligned((self.rows, self.width)).view(np.float32)
        weights[: self.vectors] = padded_D[of_vectors[:, None] + np.arange(self.width, dtype=np.uint32)]
        weights.reshape(-1)[self.vectors * self.width :][: len(single)] = padded_D[single]
        return weights

    def room_for_weights(self, policies: int, parameters: int) -> tuple[NDArray[np.float32], NDArray[np.uint64]]:
        """Room for policies of kernels with own weights: (their parameters [N, D], the address of each one's).

        The array must live as long as the addresses are used.
        """
        # Rows begin at whole vectors, and a vector that begins in the last row ends in this memory.
        stride = (parameters // self.width + 2) * self.width
        rows = aligned((policies, stride)).view(np.float32)
        return rows[:, :parameters], rows.ctypes.data + np.arange(len(rows), dtype=np.uint64) * np.uint64(
            rows.strides[0]
        )


def plan(spec: PolicySpec, inputs_O: NDArray[np.intp], target: Target) -> Network:
    """Lay out a policy's weights.

    Args:
        spec: the policy, without a memory. Without biases, their places are those of other weights, and never used.
        inputs_O: inputs of the first layer that are computed; others are always zero.
        target: what the code is for.
    """
    layers, places, coordinate, width = [], [], 0, target.width
    # With noise, four pairs are computed at a time. They share what is made of the centre, so few vectors of many pairs
    # cost less than many vectors of few. Tiles are powers of 2, so that the members that fit divide the width.
    most = max(1, target.sums_at_once // 8)
    rows, (*hidden, (inputs, outputs)) = inputs_O.tolist(), spec.layers
    for given, wanted in hidden:
        vectors = -(-wanted // width)
        tile = max(size for size in (1, 2) if size <= most and vectors % size == 0)
        layers.append(Layer(len(rows), wanted, vectors // tile, tile, len(places), spec.activation, spec.bias))
        for first in range(0, vectors, tile):
            for row in [*rows, given if spec.bias else 0]:
                places += [coordinate + row * wanted + (first + v) * width for v in range(tile)]
        coordinate += (given + spec.bias) * wanted
        rows = list(range(wanted))
    vectors = len(places)
    places += [
        coordinate + row * outputs + output for row in [*rows, inputs if spec.bias else 0] for output in range(outputs)
    ]
    kept = np.array(places, np.uint32)
    return Network(tuple(layers), len(rows), outputs, vectors, kept, target, spec.output, spec.bias)


class View(NamedTuple):
    """Array of members' floats in memory; element (member, input) is at member * by_member + input * by_input."""

    pointer: str
    by_member: int
    by_input: int


def shared(
    builder: FunctionBuilder,
    layer: Layer,
    x: View,
    out: View,
    begins: Callable[[str, str, Names], Names] = lambda first, tile, biases: biases,
) -> None:
    """Write out = f(centre x), for several members at a time.

    Args:
        begins: function (first member, tile, biases) -> first values of the sums of these members.
    """
    floats = builder.llvm_types["f"]
    members = min(builder.width, builder.target.sums_at_once // layer.tile)
    assert builder.width % members == 0

    def tile(first: str, number: str) -> Names:
        weights = builder.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))

        def centre(row: str | int) -> Names:
            at = builder.index((weights, 1), (row, layer.tile))
            return [builder.load(floats, "%centre", builder.index((at, 1), (v, 1))) for v in range(layer.tile)]

        def add(row: str, sums: Names) -> Names:
            vectors, new_sums = centre(row), []
            for member in range(members):
                seen = _seen(builder, x, first, member, row)
                mine = sums[member * layer.tile : (member + 1) * layer.tile]
                new_sums += [builder.fma(seen, vector, total) for vector, total in zip(vectors, mine, strict=True)]
            return new_sums

        biases = first_sums(layer.bias, centre(layer.inputs) * members)
        sums = builder.loop(layer.inputs, add, [(floats, init) for init in begins(first, number, biases)])
        for member in range(members):
            _put(builder, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(builder, layer, members, tile)


def perturbed(builder: FunctionBuilder, network: Network, layer: Layer, x: View, out: View) -> None:
    """Write out = f((centre +- unit k) x), for several pairs at a time.

    The weights of - come from an addition, because the multipliers are the bottleneck.
    """
    floats = builder.llvm_types["f"]
    pairs = min(builder.width // 2, max(1, builder.target.sums_at_once // (2 * layer.tile)))
    assert builder.width % (2 * pairs) == 0
    kept = builder.at("%noise", network.kept_at, "i8")

    def tile(first: str, number: str) -> Names:
        weights = builder.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))
        first_pair = builder.value(f"lshr i64 {first}, 1")

        def member_weights(row: str | int, v: int) -> list[tuple[str, str]]:
            """Weights (of +, of -) of each pair for input `row` and vector `v` of the tile."""
            at = builder.index((weights, 1), (row, layer.tile), (v, 1))
            places = [
                builder.index((first_pair, network.vectors), (pair * network.vectors, 1), (at, 1))
                for pair in range(pairs)
            ]
            centre = builder.load(floats, "%centre", at)
            doubled = builder.value(f"fadd {floats} {centre}, {centre}")
            if network.keeps_weights:
                of_plus = [builder.load(floats, kept, place) for place in places]
            else:
                of_plus = _weights_of_plus(builder, centre, places)
            return [(plus, builder.value(f"fsub {floats} {doubled}, {plus}")) for plus in of_plus]

        def add(row: str, sums: Names) -> Names:
            seen = [_seen(builder, x, first, member, row) for member in range(2 * pairs)]
            new_sums = list(sums)
            for v in range(layer.tile):
                for pair, of_signs in enumerate(member_weights(row, v)):
                    for sign, weight in enumerate(of_signs):
                        place = (2 * pair + sign) * layer.tile + v
                        new_sums[place] = builder.fma(seen[2 * pair + sign], weight, sums[place])
            return new_sums

        biases = [""] * (2 * pairs * layer.tile)
        for v in range(layer.tile):
            for pair, of_signs in enumerate(member_weights(layer.inputs, v)):
                for sign, weight in enumerate(of_signs):
                    biases[(2 * pair + sign) * layer.tile + v] = weight
        sums = builder.loop(layer.inputs, add, [(floats, init) for init in first_sums(layer.bias, biases)])
        for member in range(2 * pairs):
            _put(builder, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(builder, layer, 2 * pairs, tile)


def keep_function(network: Network) -> FunctionBuilder:
    """Function `void keep(ptr centre, ptr noise, float unit)`, which writes the weights of a block's + members behind
    their noise."""
    builder = FunctionBuilder("keep", ["ptr noalias %centre", "ptr noalias %noise", "float %unit"], network.target)
    floats = builder.llvm_types["f"]
    kept = builder.at("%noise", network.kept_at, "i8")

    def vector(at: str, _: Names) -> Names:
        centre = builder.load(floats, "%centre", at)
        places = [builder.index((at, 1), (pair * network.vectors, 1)) for pair in range(network.width // 2)]
        for place, plus in zip(places, _weights_of_plus(builder, centre, places), strict=True):
            builder.store(floats, plus, kept, place)
        return []

    builder.loop(network.vectors, vector)
    return builder


def _weights_of_plus(builder: FunctionBuilder, centre: str, places: Sequence[str]) -> Names:
    """Vectors of weights of + members, from a vector of the centre's weights and the places of the pairs' noise."""
    unit, twice = units(builder)
    moved = builder.value(f"fadd {builder.llvm_types['f']} {centre}, {unit}")
    return [builder.fma(noise_of_weights(builder, "%noise", place), twice, moved) for place in places]


def per_lane(builder: FunctionBuilder, layer: Layer, x: View, out: View) -> None:
    """Write out = f(weights x) with the parameters of each member, whose addresses are in `%weights`.

    A weight is used once per call, so memory is the bottleneck. A tile is therefore as wide as the registers allow,
    which reads the weights in the order in which they are stored.
    """
    floats, most = builder.llvm_types["f"], builder.target.sums_at_once
    tiles = max(count for count in (1, 2, 4, 8) if layer.tiles % count == 0 and count * layer.tile <= most)
    wide = layer._replace(tile=tiles * layer.tile, tiles=layer.tiles // tiles)
    members = min(builder.width, most // wide.tile)
    assert builder.width % members == 0

    def tile(first: str, number: str) -> Names:
        places = builder.index((number, (layer.inputs + 1) * wide.tile), (layer.first, 1))
        addresses = [
            builder.load("i64", "%weights", builder.index((first, 1), (member, 1))) for member in range(members)
        ]
        pointers = [builder.value(f"inttoptr i64 {address} to ptr") for address in addresses]

        def weights(row: str | int) -> list[Names]:
            """Vectors of the tile for input `row`, of each member; they follow each other in memory."""
            place = builder.load("i32", "%places", builder.index((places, 1), (row, layer.tile)))
            start = builder.value(f"zext i32 {place} to i64")
            ends = [builder.index((start, 1), (v * builder.width, 1)) for v in range(wide.tile)]
            return [
                [builder.value(f"load {floats}, ptr {builder.at(pointer, end, 'float')}, align 4") for end in ends]
                for pointer in pointers
            ]

        def add(row: str, sums: Names) -> Names:
            new_sums = []
            for member, vectors in enumerate(weights(row)):
                seen = _seen(builder, x, first, member, row)
                mine = sums[member * wide.tile : (member + 1) * wide.tile]
                new_sums += [builder.fma(seen, vector, total) for vector, total in zip(vectors, mine, strict=True)]
            return new_sums

        biases = [vector for vectors in weights(layer.inputs) for vector in vectors]
        sums = builder.loop(layer.inputs, add, [(floats, init) for init in first_sums(layer.bias, biases)])
        for member in range(members):
            _put(builder, wide, out, first, member, number, sums[member * wide.tile : (member + 1) * wide.tile])
        return []

    _by_members(builder, wide, members, tile)


def _by_members(builder: FunctionBuilder, layer: Layer, members: int, tile: Callable[[str, str], Names]) -> None:
    """Write `tile(first member, number of the tile)` for each group of members of which at least one is alive."""

    def block(number: str, _: Names) -> Names:
        first = builder.index((number, members))
        alive = builder.value(f"load <{members} x i32>, ptr {builder.at('%alive', first, 'i32')}, align 4")
        builder.when(builder.any(alive, members), lambda: builder.loop(layer.tiles, lambda t, _: tile(first, t)))
        return []

    builder.loop(builder.width // members, block)


def units(builder: FunctionBuilder) -> tuple[str, str]:
    """Vectors of unit and of 2 unit; unit k is the first plus j times the second."""
    return builder.splat("%unit"), builder.splat(builder.value("fadd float %unit, %unit"))


def _seen(builder: FunctionBuilder, x: View, first: str, member: int, row: str) -> str:
    """Vector with a member's value of input `row` in all lanes."""
    index = builder.index((first, x.by_member), (member * x.by_member, 1), (row, x.by_input))
    return builder.splat(builder.load("float", x.pointer, index))


def _put(
    builder: FunctionBuilder, layer: Layer, out: View, first: str, member: int, tile: str, sums: Sequence[str]
) -> None:
    """Store f of a member's sums in `out`."""
    vectors = layer.tiles * layer.tile
    for v, value in enumerate(activated(builder, layer.activation, sums)):
        place = builder.index((first, vectors), (tile, layer.tile), (member * vectors + v, 1))
        builder.store(builder.llvm_types["f"], value, out.pointer, place)


def first_sums(bias: bool, biases: Names) -> Names:
    """The vectors with which sums begin: the biases, or 0."""
    return biases if bias else ["zeroinitializer"] * len(biases)


def activated(builder: FunctionBuilder, activation: Activation, values: Sequence[str]) -> Names:
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(len(values))]
    outputs = [activated_node(graph, activation, node) for node in nodes]
    return inline(builder, graph, outputs, dict(zip(nodes, values, strict=True)))


def activated_node(graph: FoldingGraph, activation: Activation, node: int) -> int:
    """Node of the activation of a node: tanh, or the greater of it and 0, or NaN."""
    return (
        elementary.tanh(graph, node)
        if activation == "tanh"
        else extreme_of(graph, "max", "float32")(node, graph.f(0.0))
    )
