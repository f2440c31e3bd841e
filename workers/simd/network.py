"""Code of the policy: what each lane's member does with what it sees, for a block of as many members as vectors have
lanes, two by two the + and - of a pair.

A member's weights are never made. With noise k = 2 j + 1 (j is a byte) a layer is

    centre x +- 2 unit (j x + (sum of x) / 2)

biases as weights of an input 1. `centre` is shared by all members and stays in cache; j, a byte a weight, is shared by
a pair. Vectors go along outputs; each output is one sum in the order of the inputs, whatever the width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol import PolicyShape
from workers.simd import elementary
from workers.simd.code import Code, Values
from workers.simd.emit import inline
from workers.simd.graph import Graph
from workers.simd.words import aligned


class Layer(NamedTuple):
    """Where a layer's weights are: by tiles of outputs, in each by inputs (and last the biases), in each by outputs."""

    inputs: int
    outputs: int
    tiles: int
    tile: int
    """Vectors of outputs that are summed at once."""
    first: int
    """Number of its first vector of weights."""


class Network(NamedTuple):
    """A policy's layers, and the place in the flat vector of parameters at which each vector of weights starts.

    What a vector has beyond a row's end belongs to the next and is never looked at.
    """

    layers: tuple[Layer, ...]
    starts_V: NDArray[np.uint32]
    width: int

    @property
    def hidden_vectors(self) -> int:
        """Vectors that the outputs of two layers take, of as many members as there are lanes."""
        return 2 * self.width * max(layer.tiles * layer.tile for layer in self.layers)

    def pack(self, parameters_D: NDArray[np.float32]) -> NDArray[np.float32]:
        """The vectors of weights, [V, width]."""
        padded_D = np.concatenate([parameters_D, np.zeros(self.width, np.float32)])
        weights = aligned((self.starts_V.size, self.width)).view(np.float32)
        weights[:] = padded_D[self.starts_V[:, None] + np.arange(self.width, dtype=np.uint32)]
        return weights


def sums_at_once(width: int) -> int:
    """Vectors of sums that fit into registers beside what is added to them: 32 of 512 bits, or 16 of 256."""
    return 16 if width == 16 else 8


def plan(shape: PolicyShape, inputs_O: NDArray[np.intp], width: int) -> Network:
    """Lay out a policy's weights.

    Args:
        inputs_O: the inputs of the first layer that are not always zero.
    """
    layers, starts, coordinate = [], [], 0
    most = sums_at_once(width) // 4  # tiles are powers of 2, so that as many members as fit divide the width
    for number, (inputs, outputs) in enumerate(shape.layers):
        rows = inputs_O.tolist() if number == 0 else list(range(inputs))
        vectors = -(-outputs // width)
        tile = max(size for size in (1, 2, 4) if size <= most and vectors % size == 0)
        layers.append(Layer(len(rows), outputs, vectors // tile, tile, len(starts)))
        for first in range(0, vectors, tile):
            for row in [*rows, inputs]:
                starts += [coordinate + row * outputs + (first + v) * width for v in range(tile)]
        coordinate += (inputs + 1) * outputs
    return Network(tuple(layers), np.array(starts, np.uint32), width)


class View(NamedTuple):
    """Floats of members: element (member, input) is at member * by_member + input * by_input."""

    pointer: str
    by_member: int
    by_input: int


def policy_function(network: Network, *, noisy: bool) -> Code:
    """`void policy(ptr x, ptr alive, ptr centre[, ptr noise, float unit], ptr hidden, ptr action)`.

    x and action are [input, lane] and [output, lane]; `alive` a word for each lane: neighbours who are all dead are not
    computed. centre is as `Network.pack` makes it; noise [pair, vector, lane] of bytes; unit twice that of the noise;
    hidden is room for `network.hidden_vectors`.
    """
    width = network.width
    parameters = ["ptr noalias %x", "ptr noalias %alive", "ptr noalias %centre"]
    parameters += ["ptr noalias %noise", "float %unit"] if noisy else []
    code = Code("policy", [*parameters, "ptr noalias %hidden", "ptr noalias %action"], width)
    buffers = [code.at("%hidden", half * network.hidden_vectors // 2, code.vector["f"]) for half in range(2)]
    view = View("%x", 1, width)
    for number, layer in enumerate(network.layers):
        out = View(buffers[number % 2], layer.tiles * layer.tile * width, 1)
        _shared(code, layer, view, out, last=not noisy)
        if noisy:
            _own(code, network, layer, view, out)
        view = out
    outputs = network.layers[-1].outputs

    def copy(member: str, _: Values) -> Values:
        for output in range(outputs):
            value = code.load("float", view.pointer, code.index((member, view.by_member), (output, 1)))
            code.store("float", value, "%action", code.index((member, 1), (output * width, 1)))
        return []

    code.loop(width, copy)
    return code


def _shared(code: Code, layer: Layer, x: View, out: View, *, last: bool) -> None:
    """out = centre x, for some members at once; if that is all, tanh of it."""
    floats = code.vector["f"]
    members = min(code.width, sums_at_once(code.width) // layer.tile)
    assert code.width % members == 0

    def block(number: str, _: Values) -> Values:
        first = code.index((number, members))
        code.when(_any_alive(code, first, members), lambda: code.loop(layer.tiles, lambda t, _: tile(first, t)))
        return []

    def tile(first: str, number: str) -> Values:
        weights = code.index((number, (layer.inputs + 1) * layer.tile), (layer.first, 1))
        biases = [code.load(floats, "%centre", code.index((weights, 1), (layer.inputs * layer.tile + v, 1)))
                  for v in range(layer.tile)]  # fmt: skip

        def add(row: str, sums: Values) -> Values:
            at = code.index((weights, 1), (row, layer.tile))
            vectors = [code.load(floats, "%centre", code.index((at, 1), (v, 1))) for v in range(layer.tile)]
            found = []
            for member in range(members):
                seen = _seen(code, x, first, member, row)
                mine = sums[member * layer.tile : (member + 1) * layer.tile]
                found += [code.fma(seen, vector, one) for vector, one in zip(vectors, mine, strict=True)]
            return found

        sums = code.loop(layer.inputs, add, [(floats, one) for one in biases * members])
        for member in range(members):
            mine = sums[member * layer.tile : (member + 1) * layer.tile]
            _put(code, layer, out, first, member, number, _tanh(code, mine) if last else mine)
        return []

    code.loop(code.width // members, block)


def _own(code: Code, network: Network, layer: Layer, x: View, out: View) -> None:
    """out = tanh(out +- unit (j x + (sum of x) / 2)), for some pairs at once."""
    floats, size = code.vector["f"], len(network.starts_V)
    pairs = max(1, min(code.width // 2, sums_at_once(code.width) // 2 // (2 * layer.tile)))
    assert code.width % (2 * pairs) == 0
    bytes_ = f"<{code.width} x i8>"
    half, zero = "splat (float 0.5)", "zeroinitializer"

    def noise(index: str) -> str:
        byte = code.load(bytes_, "%noise", index)
        words = code.value(f"sext {bytes_} {byte} to {code.vector['i']}")
        return code.value(f"sitofp {code.vector['i']} {words} to {floats}")

    def block(number: str, _: Values) -> Values:
        first = code.index((number, pairs))
        member = code.index((first, 2))
        code.when(
            _any_alive(code, member, 2 * pairs),
            lambda: code.loop(layer.tiles, lambda t, _: tile(first, member, t)),
        )
        return []

    def tile(first: str, member: str, number: str) -> Values:
        weights = [
            code.index((first, size), (number, (layer.inputs + 1) * layer.tile), (pair * size + layer.first, 1))
            for pair in range(pairs)
        ]
        carries = []
        for pair in range(pairs):
            biases = [
                noise(code.index((weights[pair], 1), (layer.inputs * layer.tile + v, 1))) for v in range(layer.tile)
            ]
            carries += [(floats, one) for one in biases * 2] + [(floats, zero)] * 2
        each = 2 * layer.tile + 2

        def add(row: str, sums: Values) -> Values:
            found = []
            for pair in range(pairs):
                mine = sums[pair * each : (pair + 1) * each]
                at = code.index((weights[pair], 1), (row, layer.tile))
                vectors = [noise(code.index((at, 1), (v, 1))) for v in range(layer.tile)]
                seen = [_seen(code, x, member, 2 * pair + sign, row) for sign in range(2)]
                for sign in range(2):
                    of_sign = mine[sign * layer.tile : (sign + 1) * layer.tile]
                    found += [code.fma(seen[sign], vector, one) for vector, one in zip(vectors, of_sign, strict=True)]
                found += [code.value(f"fadd {floats} {mine[2 * layer.tile + sign]}, {seen[sign]}") for sign in range(2)]
            return found

        sums = code.loop(layer.inputs, add, carries)
        for pair in range(pairs):
            mine = sums[pair * each : (pair + 1) * each]
            for sign in range(2):
                rest = code.fma(half, mine[2 * layer.tile + sign], half)
                unit = code.splat("%unit" if sign == 0 else code.value("fneg float %unit"))
                values = []
                for v, one in enumerate(mine[sign * layer.tile : (sign + 1) * layer.tile]):
                    shared = code.load(floats, *_place(code, layer, out, member, 2 * pair + sign, number, v))
                    values.append(code.fma(unit, code.value(f"fadd {floats} {one}, {rest}"), shared))
                _put(code, layer, out, member, 2 * pair + sign, number, _tanh(code, values))
        return []

    code.loop(code.width // (2 * pairs), block)


def _seen(code: Code, x: View, first: str, member: int, row: str) -> str:
    """What a member gives an input, in all lanes."""
    index = code.index((first, x.by_member), (member * x.by_member, 1), (row, x.by_input))
    return code.splat(code.load("float", x.pointer, index))


def _place(code: Code, layer: Layer, out: View, first: str, member: int, tile: str, vector: int) -> tuple[str, str]:
    """(pointer, number of the vector) of outputs of a member."""
    vectors = layer.tiles * layer.tile
    return out.pointer, code.index((first, vectors), (tile, layer.tile), (member * vectors + vector, 1))


def _put(code: Code, layer: Layer, out: View, first: str, member: int, tile: str, values: Sequence[str]) -> None:
    for vector, value in enumerate(values):
        code.store(code.vector["f"], value, *_place(code, layer, out, first, member, tile, vector))


def _any_alive(code: Code, first: str, members: int) -> str:
    return code.any(code.value(f"load <{members} x i32>, ptr {code.at('%alive', first, 'i32')}, align 4"), members)


def _tanh(code: Code, values: Sequence[str]) -> Values:
    graph = Graph()
    nodes = [graph.input("f", k) for k in range(len(values))]
    outputs = [elementary.tanh(graph, node) for node in nodes]
    return inline(code, graph, outputs, dict(zip(nodes, values, strict=True)))
