"""Code of the policy: actions of a block of members from their observations, one member per lane.

A block has as many members as a vector has lanes; neighbouring lanes are the + and - members of a pair. A member's
weights, centre +- unit k, are computed where they are used. The centre is shared by all members and stays in cache; the
noise k = 2 j + 1 takes one byte j per weight. In float32, with fused products:

hidden layers: a vector holds several outputs of one member. The members of a pair share their bytes; the weight of + is
    (centre + unit) + 2 unit j, and that of - is 2 centre minus that weight, its mirror image up to a rounding.
last layer: it has few outputs, so a vector holds one output of several members, each with its own byte and with the
    sign of its unit: (centre +- unit) +- 2 unit j.

Every output is one sum in the order of the inputs, starting with the bias, whatever the width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from workers.simd.backend.emit import inline
from workers.simd.backend.function_builder import FunctionBuilder, Values
from workers.simd.episodes.layout import Layer, Network, sums_at_once
from workers.simd.graph import elementary
from workers.simd.graph.folding import FoldingGraph

OUTPUTS_AT_ONCE = 4
"""Most outputs of the last layer that are computed in one loop over its inputs."""


class View(NamedTuple):
    """Array of members' floats in memory; element (member, input) is at member * by_member + input * by_input."""

    pointer: str
    by_member: int
    by_input: int


def policy_function(network: Network, *, noisy: bool) -> FunctionBuilder:
    """Function `void policy(ptr x, ptr alive, ptr centre[, ptr noise, float unit], ptr hidden, ptr action)`.

    x is [input, lane] and action [output, lane]. `alive` has a word for each lane; hidden layers are not computed for a
    group of neighbouring lanes that are all 0. centre is an array of `Network.pack`, noise one of
    `noise.fill_function`, and hidden is memory for `network.hidden_vectors` vectors.
    """
    width = network.width
    parameters = ["ptr noalias %x", "ptr noalias %alive", "ptr noalias %centre"]
    parameters += ["ptr noalias %noise", "float %unit"] if noisy else []
    builder = FunctionBuilder("policy", [*parameters, "ptr noalias %hidden", "ptr noalias %action"], width)
    buffers = [builder.at("%hidden", half * network.hidden_vectors // 2, builder.llvm_types["f"]) for half in range(2)]
    view = View("%x", 1, width)
    for number, layer in enumerate(network.hidden):
        out = View(buffers[number % 2], layer.tiles * layer.tile * width, 1)
        if noisy:
            _noisy(builder, network, layer, view, out)
        else:
            _shared(builder, layer, view, out)
        view = out
    seen = "%x"
    if network.hidden:
        seen = buffers[len(network.hidden) % 2]
        _transpose(builder, view, network.inputs, seen)
    for first in range(0, network.outputs, OUTPUTS_AT_ONCE):
        _last(builder, network, seen, range(first, min(first + OUTPUTS_AT_ONCE, network.outputs)), noisy=noisy)
    return builder


def _shared(builder: FunctionBuilder, layer: Layer, x: View, out: View) -> None:
    """Write out = tanh(centre x), for several members at a time."""
    floats = builder.llvm_types["f"]
    members = min(builder.width, sums_at_once(builder.width) // layer.tile)
    assert builder.width % members == 0

    def tile(first: str, number: str) -> Values:
        weights = builder.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))

        def centre(row: str | int) -> Values:
            at = builder.index((weights, 1), (row, layer.tile))
            return [builder.load(floats, "%centre", builder.index((at, 1), (v, 1))) for v in range(layer.tile)]

        def add(row: str, sums: Values) -> Values:
            vectors, found = centre(row), []
            for member in range(members):
                seen = _seen(builder, x, first, member, row)
                mine = sums[member * layer.tile : (member + 1) * layer.tile]
                found += [builder.fma(seen, vector, one) for vector, one in zip(vectors, mine, strict=True)]
            return found

        sums = builder.loop(layer.inputs, add, [(floats, one) for one in centre(layer.inputs) * members])
        for member in range(members):
            _put(builder, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(builder, layer, members, tile)


def _noisy(builder: FunctionBuilder, network: Network, layer: Layer, x: View, out: View) -> None:
    """Write out = tanh((centre +- unit k) x), for several pairs at a time.

    The weights of - come from an addition, because the multipliers are the bottleneck.
    """
    floats = builder.llvm_types["f"]
    pairs = min(builder.width // 2, max(1, sums_at_once(builder.width) // (2 * layer.tile)))
    assert builder.width % (2 * pairs) == 0
    unit, twice = _units(builder)

    def tile(first: str, number: str) -> Values:
        weights = builder.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))
        first_pair = builder.value(f"lshr i64 {first}, 1")

        def member_weights(row: str | int, v: int) -> list[tuple[str, str]]:
            """Weights (of +, of -) of each pair for input `row` and vector `v` of the tile."""
            at = builder.index((weights, 1), (row, layer.tile), (v, 1))
            centre = builder.load(floats, "%centre", at)
            moved, doubled = (builder.value(f"fadd {floats} {centre}, {one}") for one in (unit, centre))
            found = []
            for pair in range(pairs):
                place = builder.index((first_pair, network.vectors), (pair * network.vectors, 1), (at, 1))
                plus = builder.fma(_noise(builder, "%noise", place), twice, moved)
                found.append((plus, builder.value(f"fsub {floats} {doubled}, {plus}")))
            return found

        def add(row: str, sums: Values) -> Values:
            seen = [_seen(builder, x, first, member, row) for member in range(2 * pairs)]
            found = list(sums)
            for v in range(layer.tile):
                for pair, of_signs in enumerate(member_weights(row, v)):
                    for sign, weight in enumerate(of_signs):
                        place = (2 * pair + sign) * layer.tile + v
                        found[place] = builder.fma(seen[2 * pair + sign], weight, sums[place])
            return found

        biases = [""] * (2 * pairs * layer.tile)
        for v in range(layer.tile):
            for pair, of_signs in enumerate(member_weights(layer.inputs, v)):
                for sign, weight in enumerate(of_signs):
                    biases[(2 * pair + sign) * layer.tile + v] = weight
        sums = builder.loop(layer.inputs, add, [(floats, one) for one in biases])
        for member in range(2 * pairs):
            _put(builder, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(builder, layer, 2 * pairs, tile)


def _by_members(builder: FunctionBuilder, layer: Layer, members: int, tile: Callable[[str, str], Values]) -> None:
    """Write `tile(first member, number of the tile)` for each group of members of which at least one is alive."""

    def block(number: str, _: Values) -> Values:
        first = builder.index((number, members))
        builder.when(
            _any_alive(builder, first, members), lambda: builder.loop(layer.tiles, lambda t, _: tile(first, t))
        )
        return []

    builder.loop(builder.width // members, block)


def _last(builder: FunctionBuilder, network: Network, x: str, outputs: range, *, noisy: bool) -> None:
    """Write action = tanh(weights x) for some outputs; the lanes of a vector are members."""
    floats, count = builder.llvm_types["f"], network.outputs
    singles = builder.at("%centre", network.vectors * builder.width, "float")

    def centre(row: str | int) -> Values:
        return [
            builder.splat(builder.load("float", singles, builder.index((row, count), (output, 1))))
            for output in outputs
        ]

    weights = centre
    if noisy:
        noise = builder.at("%noise", network.vectors * (builder.width // 2) * builder.width, "i8")
        unit, twice = (_by_sign(builder, one) for one in _units(builder))

        def weights(row: str | int) -> Values:
            js = [_noise(builder, noise, builder.index((row, count), (output, 1))) for output in outputs]
            moved = [builder.value(f"fadd {floats} {one}, {unit}") for one in centre(row)]
            return [builder.fma(j, twice, one) for j, one in zip(js, moved, strict=True)]

    def add(row: str, sums: Values) -> Values:
        seen = builder.load(floats, x, row)
        return [builder.fma(seen, weight, one) for weight, one in zip(weights(row), sums, strict=True)]

    sums = builder.loop(network.inputs, add, [(floats, one) for one in weights(network.inputs)])
    for output, value in zip(outputs, _tanh(builder, sums), strict=True):
        builder.store(floats, value, "%action", output)


def _transpose(builder: FunctionBuilder, x: View, inputs: int, to: str) -> None:
    """Write the members' inputs x to `to` as [input, lane], in squares of as many inputs as lanes."""
    floats, width = builder.llvm_types["f"], builder.width

    def square(number: str, _: Values) -> Values:
        rows = [
            builder.load(floats, x.pointer, builder.index((number, 1), (member * x.by_member // width, 1)))
            for member in range(width)
        ]
        half = 1
        while half < width:  # swap the off-diagonal blocks of one, two, four ... rows and columns
            for row in range(width):
                if not row & half:
                    rows[row], rows[row + half] = _swapped(builder, rows[row], rows[row + half], half)
            half *= 2
        for row, value in enumerate(rows):
            builder.store(floats, value, to, builder.index((number, width), (row, 1)))
        return []

    builder.loop(-(-inputs // width), square)


def _swapped(builder: FunctionBuilder, upper: str, lower: str, half: int) -> tuple[str, str]:
    """Two rows, after exchanging the odd blocks of `half` columns of the upper with the even blocks of the lower."""
    floats, width = builder.llvm_types["f"], builder.width
    even = [lane if not lane & half else width + lane - half for lane in range(width)]
    odd = [lane + half if not lane & half else width + lane for lane in range(width)]
    masks = (", ".join(f"i32 {place}" for place in places) for places in (even, odd))
    first, second = (
        builder.value(f"shufflevector {floats} {upper}, {floats} {lower}, <{width} x i32> <{mask}>") for mask in masks
    )
    return first, second


def _units(builder: FunctionBuilder) -> tuple[str, str]:
    """Vectors of unit and of 2 unit; unit k is the first plus j times the second."""
    return builder.splat("%unit"), builder.splat(builder.value("fadd float %unit, %unit"))


def _by_sign(builder: FunctionBuilder, value: str) -> str:
    """Vector with the sign flipped in the lanes of - members."""
    signs = ", ".join(f"float {-1.0 if lane % 2 else 1.0}" for lane in range(builder.width))
    return builder.value(f"fmul {builder.llvm_types['f']} {value}, <{signs}>")


def _noise(builder: FunctionBuilder, noise: str, vector: str) -> str:
    """Vector of noise j, as floats, of a vector of weights."""
    llvm_type = f"<{builder.width} x i8>"
    words = builder.value(f"sext {llvm_type} {builder.load(llvm_type, noise, vector)} to {builder.llvm_types['i']}")
    return builder.value(f"sitofp {builder.llvm_types['i']} {words} to {builder.llvm_types['f']}")


def _seen(builder: FunctionBuilder, x: View, first: str, member: int, row: str) -> str:
    """Vector with a member's value of input `row` in all lanes."""
    index = builder.index((first, x.by_member), (member * x.by_member, 1), (row, x.by_input))
    return builder.splat(builder.load("float", x.pointer, index))


def _put(
    builder: FunctionBuilder, layer: Layer, out: View, first: str, member: int, tile: str, sums: Sequence[str]
) -> None:
    """Store tanh of a member's sums in `out`."""
    vectors = layer.tiles * layer.tile
    for v, value in enumerate(_tanh(builder, sums)):
        place = builder.index((first, vectors), (tile, layer.tile), (member * vectors + v, 1))
        builder.store(builder.llvm_types["f"], value, out.pointer, place)


def _any_alive(builder: FunctionBuilder, first: str, members: int) -> str:
    """An i1 that is true if any of some members, from `first` on, is alive."""
    return builder.any(
        builder.value(f"load <{members} x i32>, ptr {builder.at('%alive', first, 'i32')}, align 4"), members
    )


def _tanh(builder: FunctionBuilder, values: Sequence[str]) -> Values:
    """Vectors of tanh of each vector."""
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(len(values))]
    outputs = [elementary.tanh(graph, node) for node in nodes]
    return inline(builder, graph, outputs, dict(zip(nodes, values, strict=True)))
