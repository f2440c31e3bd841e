"""Code of the policy: what each lane's member does with what it sees, for a block of as many members as vectors have
lanes, two by two the + and - of a pair.

A member's weights are made where they are used: centre +- unit k. The centre is shared by all members and stays in
cache; the noise k = 2 j + 1 is a byte j a weight. In float32, with fused products:

hidden layers: vectors go along outputs, member by member. A pair shares its bytes; the weight of + is
    (centre + unit) + 2 unit j, that of - is 2 centre less it: its mirror image up to a rounding.
last layer: few outputs, so vectors go along members, each with a byte, and a unit of its sign:
    (centre +- unit) +- 2 unit j.

Every output is one sum in the order of the inputs, beginning with the bias, whatever the width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from workers.simd.backend.code import Code, Values
from workers.simd.backend.emit import inline
from workers.simd.episodes.layout import Layer, Network, sums_at_once
from workers.simd.graph import elementary
from workers.simd.graph.folding import FoldingGraph

OUTPUTS_AT_ONCE = 4
"""Of the last layer."""


class View(NamedTuple):
    """Floats of members: element (member, input) is at member * by_member + input * by_input."""

    pointer: str
    by_member: int
    by_input: int


def policy_function(network: Network, *, noisy: bool) -> Code:
    """`void policy(ptr x, ptr alive, ptr centre[, ptr noise, float unit], ptr hidden, ptr action)`.

    x and action are [input, lane] and [output, lane]; `alive` a word for each lane: hidden layers of neighbours who are
    all dead are not computed. centre is as `Network.pack` makes it; noise as `noise.fill_function` does; hidden is room
    for `network.hidden_vectors`.
    """
    width = network.width
    parameters = ["ptr noalias %x", "ptr noalias %alive", "ptr noalias %centre"]
    parameters += ["ptr noalias %noise", "float %unit"] if noisy else []
    code = Code("policy", [*parameters, "ptr noalias %hidden", "ptr noalias %action"], width)
    buffers = [code.at("%hidden", half * network.hidden_vectors // 2, code.vector["f"]) for half in range(2)]
    view = View("%x", 1, width)
    for number, layer in enumerate(network.hidden):
        out = View(buffers[number % 2], layer.tiles * layer.tile * width, 1)
        if noisy:
            _noisy(code, network, layer, view, out)
        else:
            _shared(code, layer, view, out)
        view = out
    seen = "%x"
    if network.hidden:
        seen = buffers[len(network.hidden) % 2]
        _transpose(code, view, network.inputs, seen)
    for first in range(0, network.outputs, OUTPUTS_AT_ONCE):
        _last(code, network, seen, range(first, min(first + OUTPUTS_AT_ONCE, network.outputs)), noisy=noisy)
    return code


def _shared(code: Code, layer: Layer, x: View, out: View) -> None:
    """out = tanh(centre x), for some members at once."""
    floats = code.vector["f"]
    members = min(code.width, sums_at_once(code.width) // layer.tile)
    assert code.width % members == 0

    def tile(first: str, number: str) -> Values:
        weights = code.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))

        def centre(row: str | int) -> Values:
            at = code.index((weights, 1), (row, layer.tile))
            return [code.load(floats, "%centre", code.index((at, 1), (v, 1))) for v in range(layer.tile)]

        def add(row: str, sums: Values) -> Values:
            vectors, found = centre(row), []
            for member in range(members):
                seen = _seen(code, x, first, member, row)
                mine = sums[member * layer.tile : (member + 1) * layer.tile]
                found += [code.fma(seen, vector, one) for vector, one in zip(vectors, mine, strict=True)]
            return found

        sums = code.loop(layer.inputs, add, [(floats, one) for one in centre(layer.inputs) * members])
        for member in range(members):
            _put(code, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(code, layer, members, tile)


def _noisy(code: Code, network: Network, layer: Layer, x: View, out: View) -> None:
    """out = tanh((centre +- unit k) x), for some pairs at once. Additions are what the multipliers leave time for."""
    floats = code.vector["f"]
    pairs = min(code.width // 2, max(1, sums_at_once(code.width) // (2 * layer.tile)))
    assert code.width % (2 * pairs) == 0
    unit, twice = _units(code)

    def tile(first: str, number: str) -> Values:
        weights = code.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))
        first_pair = code.value(f"lshr i64 {first}, 1")

        def member_weights(row: str | int, v: int) -> list[tuple[str, str]]:
            """Of each pair, those of + and -."""
            at = code.index((weights, 1), (row, layer.tile), (v, 1))
            centre = code.load(floats, "%centre", at)
            moved, doubled = (code.value(f"fadd {floats} {centre}, {one}") for one in (unit, centre))
            found = []
            for pair in range(pairs):
                place = code.index((first_pair, network.vectors), (pair * network.vectors, 1), (at, 1))
                plus = code.fma(_noise(code, "%noise", place), twice, moved)
                found.append((plus, code.value(f"fsub {floats} {doubled}, {plus}")))
            return found

        def add(row: str, sums: Values) -> Values:
            seen = [_seen(code, x, first, member, row) for member in range(2 * pairs)]
            found = list(sums)
            for v in range(layer.tile):
                for pair, of_signs in enumerate(member_weights(row, v)):
                    for sign, weight in enumerate(of_signs):
                        place = (2 * pair + sign) * layer.tile + v
                        found[place] = code.fma(seen[2 * pair + sign], weight, sums[place])
            return found

        biases = [""] * (2 * pairs * layer.tile)
        for v in range(layer.tile):
            for pair, of_signs in enumerate(member_weights(layer.inputs, v)):
                for sign, weight in enumerate(of_signs):
                    biases[(2 * pair + sign) * layer.tile + v] = weight
        sums = code.loop(layer.inputs, add, [(floats, one) for one in biases])
        for member in range(2 * pairs):
            _put(code, layer, out, first, member, number, sums[member * layer.tile : (member + 1) * layer.tile])
        return []

    _by_members(code, layer, 2 * pairs, tile)


def _by_members(code: Code, layer: Layer, members: int, tile: Callable[[str, str], Values]) -> None:
    """`tile(first member, number of the tile)` of neighbours of whom one is alive."""

    def block(number: str, _: Values) -> Values:
        first = code.index((number, members))
        code.when(_any_alive(code, first, members), lambda: code.loop(layer.tiles, lambda t, _: tile(first, t)))
        return []

    code.loop(code.width // members, block)


def _last(code: Code, network: Network, x: str, outputs: range, *, noisy: bool) -> None:
    """action = tanh(weights x) of some outputs; vectors go along members."""
    floats, count = code.vector["f"], network.outputs
    singles = code.at("%centre", network.vectors * code.width, "float")

    def centre(row: str | int) -> Values:
        return [code.splat(code.load("float", singles, code.index((row, count), (output, 1)))) for output in outputs]

    weights = centre
    if noisy:
        noise = code.at("%noise", network.vectors * (code.width // 2) * code.width, "i8")
        unit, twice = (_by_sign(code, one) for one in _units(code))

        def weights(row: str | int) -> Values:
            js = [_noise(code, noise, code.index((row, count), (output, 1))) for output in outputs]
            moved = [code.value(f"fadd {floats} {one}, {unit}") for one in centre(row)]
            return [code.fma(j, twice, one) for j, one in zip(js, moved, strict=True)]

    def add(row: str, sums: Values) -> Values:
        seen = code.load(floats, x, row)
        return [code.fma(seen, weight, one) for weight, one in zip(weights(row), sums, strict=True)]

    sums = code.loop(network.inputs, add, [(floats, one) for one in weights(network.inputs)])
    for output, value in zip(outputs, _tanh(code, sums), strict=True):
        code.store(floats, value, "%action", output)


def _transpose(code: Code, x: View, inputs: int, to: str) -> None:
    """to = what members give the inputs, [input, lane]; a square of as many inputs as lanes after the other."""
    floats, width = code.vector["f"], code.width

    def square(number: str, _: Values) -> Values:
        rows = [
            code.load(floats, x.pointer, code.index((number, 1), (member * x.by_member // width, 1)))
            for member in range(width)
        ]
        half = 1
        while half < width:  # swap the blocks beside the diagonal, of one, two, four ... rows and columns
            for row in range(width):
                if not row & half:
                    rows[row], rows[row + half] = _swapped(code, rows[row], rows[row + half], half)
            half *= 2
        for row, value in enumerate(rows):
            code.store(floats, value, to, code.index((number, width), (row, 1)))
        return []

    code.loop(-(-inputs // width), square)


def _swapped(code: Code, upper: str, lower: str, half: int) -> tuple[str, str]:
    """Two rows after the exchange of the upper's odd blocks of `half` columns with the lower's even ones."""
    floats, width = code.vector["f"], code.width
    even = [lane if not lane & half else width + lane - half for lane in range(width)]
    odd = [lane + half if not lane & half else width + lane for lane in range(width)]
    masks = (", ".join(f"i32 {place}" for place in places) for places in (even, odd))
    first, second = (
        code.value(f"shufflevector {floats} {upper}, {floats} {lower}, <{width} x i32> <{mask}>") for mask in masks
    )
    return first, second


def _units(code: Code) -> tuple[str, str]:
    """unit and 2 unit in all lanes: unit k is j times the second plus the first."""
    return code.splat("%unit"), code.splat(code.value("fadd float %unit, %unit"))


def _by_sign(code: Code, value: str) -> str:
    """Minus the value in the lanes of members whose sign is -."""
    signs = ", ".join(f"float {-1.0 if lane % 2 else 1.0}" for lane in range(code.width))
    return code.value(f"fmul {code.vector['f']} {value}, <{signs}>")


def _noise(code: Code, noise: str, vector: str) -> str:
    """j of a vector of weights."""
    kind = f"<{code.width} x i8>"
    words = code.value(f"sext {kind} {code.load(kind, noise, vector)} to {code.vector['i']}")
    return code.value(f"sitofp {code.vector['i']} {words} to {code.vector['f']}")


def _seen(code: Code, x: View, first: str, member: int, row: str) -> str:
    """What a member gives an input, in all lanes."""
    index = code.index((first, x.by_member), (member * x.by_member, 1), (row, x.by_input))
    return code.splat(code.load("float", x.pointer, index))


def _put(code: Code, layer: Layer, out: View, first: str, member: int, tile: str, sums: Sequence[str]) -> None:
    """Store tanh of a member's sums."""
    vectors = layer.tiles * layer.tile
    for v, value in enumerate(_tanh(code, sums)):
        place = code.index((first, vectors), (tile, layer.tile), (member * vectors + v, 1))
        code.store(code.vector["f"], value, out.pointer, place)


def _any_alive(code: Code, first: str, members: int) -> str:
    return code.any(code.value(f"load <{members} x i32>, ptr {code.at('%alive', first, 'i32')}, align 4"), members)


def _tanh(code: Code, values: Sequence[str]) -> Values:
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(len(values))]
    outputs = [elementary.tanh(graph, node) for node in nodes]
    return inline(code, graph, outputs, dict(zip(nodes, values, strict=True)))
