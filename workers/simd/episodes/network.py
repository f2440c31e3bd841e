"""Code of the policy: actions of a block of members from their observations, one member per lane.

A block has as many members as a vector has lanes. Their weights are those of the centre, or the centre's with noise, or
each member has parameters of its own. With noise, neighbouring lanes are the + and - members of a pair, and a member's
weights, centre +- unit k, are computed where they are used: the centre is shared by all members and stays in cache, and
the noise k = 2 j + 1 takes one byte j per weight.

`hidden.py` has the hidden layers. The last layer has few outputs, so a vector holds one output of several members:
with noise each with its own byte and with the sign of its unit, (centre +- unit) +- 2 unit j. In float32, with fused
products, every output is one sum in the order of the inputs, starting with the bias, whatever the width.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from workers.simd.backend.function_builder import FunctionBuilder, Names
from workers.simd.episodes.hidden import Network, View, activated, first_sums, per_lane, perturbed, shared, units
from workers.simd.episodes.low_rank import BlockNoise, begins_of_hidden, begins_of_last, thin_sums
from workers.simd.episodes.noise_kernels import by_sign, noise_of_weights

Weights = Literal["shared", "perturbed", "per_lane"]
"""Where the weights of a member are from; see `hidden.py`."""
OUTPUTS_AT_ONCE = 4
"""Most outputs of the last layer that are computed in one loop over its inputs."""


def policy_function(network: Network, weights: Weights, low_rank: BlockNoise | None = None) -> FunctionBuilder:
    """Function `void policy(ptr x, ptr alive, ..., ptr hidden, ptr action)`, with between them

        shared                          ptr centre
        perturbed, or with low_rank     ptr centre, ptr noise, float unit
        per_lane                        ptr weights, ptr places, ptr singles

    x is [input, lane] and action [output, lane]. `alive` has a word for each lane; hidden layers are not computed for a
    group of neighbouring lanes that are all 0. centre is an array of `Network.pack`, noise one of
    `noise.fill_function`, and hidden is memory for `network.hidden_vectors` vectors and one more for each rank. weights
    has for each lane the address of its parameters, in memory that goes on for at least a vector behind them; places is
    `Network.places`, and singles an array of `singles_function`.

    Args:
        low_rank: the noise of members that share the weights of the centre; None if they have none of this kind.
    """
    width = network.width
    noisy = ["noise"] * (weights == "perturbed" or low_rank is not None)
    given = ["weights", "places", "singles"] if weights == "per_lane" else ["centre", *noisy]
    parameters = [*(f"ptr noalias %{name}" for name in ("x", "alive", *given)), *["float %unit"] * len(noisy)]
    builder = FunctionBuilder("policy", [*parameters, "ptr noalias %hidden", "ptr noalias %action"], network.target)
    buffers = [builder.at("%hidden", half * network.hidden_vectors // 2, builder.llvm_types["f"]) for half in range(3)]
    *_, room_of_thin = buffers
    view = View("%x", 1, width)
    for number, layer in enumerate(network.hidden):
        out = View(buffers[0 if low_rank else number % 2], layer.tiles * layer.tile * width, 1)
        if low_rank:
            thin = thin_sums(builder, low_rank, number, layer.inputs, view.pointer)
            for rank, value in enumerate(thin):
                builder.store(builder.llvm_types["f"], value, room_of_thin, rank)
            shared(builder, layer, view, out, begins_of_hidden(builder, low_rank, layer, number, room_of_thin))
            _transpose(builder, out, layer.outputs, buffers[1])
            out = View(buffers[1], 1, width)
        elif weights == "shared":
            shared(builder, layer, view, out)
        elif weights == "perturbed":
            perturbed(builder, network, layer, view, out)
        else:
            per_lane(builder, layer, view, out)
        view = out
    seen = view.pointer
    if network.hidden and not low_rank:
        seen = buffers[len(network.hidden) % 2]
        _transpose(builder, view, network.inputs, seen)

    def begins(outputs: range, biases: Names) -> Names:
        return begins_of_last(builder, low_rank, outputs, network.outputs, biases, thin) if low_rank else biases

    thin = thin_sums(builder, low_rank, len(network.hidden), network.inputs, seen) if low_rank else []
    for first in range(0, network.outputs, OUTPUTS_AT_ONCE):
        outputs = range(first, min(first + OUTPUTS_AT_ONCE, network.outputs))
        _last(builder, network, seen, outputs, weights, begins)
    return builder


def singles_function(network: Network) -> FunctionBuilder:
    """Function `void singles(ptr weights, ptr places, ptr singles)`, which writes the single weights as [single, lane].

    The arguments are as in `policy_function`.
    """
    builder = FunctionBuilder(
        "singles", [f"ptr noalias %{name}" for name in ("weights", "places", "singles")], network.target
    )
    floats = builder.llvm_types["f"]

    def single(number: str, _: Names) -> Names:
        place = builder.load("i32", "%places", builder.index((number, 1), (network.vectors, 1)))
        place, vector = builder.value(f"zext i32 {place} to i64"), "poison"
        for lane in range(network.width):
            pointer = builder.value(f"inttoptr i64 {builder.load('i64', '%weights', lane)} to ptr")
            weight = builder.load("float", pointer, place)
            vector = builder.value(f"insertelement {floats} {vector}, float {weight}, i64 {lane}")
        builder.store(floats, vector, "%singles", number)
        return []

    builder.loop(len(network.places) - network.vectors, single)
    return builder


def _last(
    builder: FunctionBuilder,
    network: Network,
    x: str,
    outputs: range,
    weights: Weights,
    begins: Callable[[range, Names], Names],
) -> None:
    """Write action = f(weights x) for some outputs, with f = tanh or none; the lanes of a vector are members.

    Args:
        begins: function (outputs, their biases) -> first values of their sums.
    """
    floats, count = builder.llvm_types["f"], network.outputs
    singles = "" if weights == "per_lane" else builder.at("%centre", network.vectors * builder.width, "float")

    def centre(row: str | int) -> Names:
        return [
            builder.splat(builder.load("float", singles, builder.index((row, count), (output, 1))))
            for output in outputs
        ]

    def per_lane_weights(row: str | int) -> Names:
        return [builder.load(floats, "%singles", builder.index((row, count), (output, 1))) for output in outputs]

    of_row = per_lane_weights if weights == "per_lane" else centre
    if weights == "perturbed":
        noise = builder.at("%noise", network.vectors * (builder.width // 2) * builder.width, "i8")
        unit, twice = (by_sign(builder, vector) for vector in units(builder))

        def of_row(row: str | int) -> Names:
            js = [noise_of_weights(builder, noise, builder.index((row, count), (output, 1))) for output in outputs]
            moved = [builder.value(f"fadd {floats} {weight}, {unit}") for weight in centre(row)]
            return [builder.fma(j, twice, weight) for j, weight in zip(js, moved, strict=True)]

    def add(row: str, sums: Names) -> Names:
        seen = builder.load(floats, x, row)
        return [builder.fma(seen, weight, total) for weight, total in zip(of_row(row), sums, strict=True)]

    biases = begins(outputs, first_sums(network.bias, of_row(network.inputs)))
    sums = builder.loop(network.inputs, add, [(floats, init) for init in biases])
    sums = activated(builder, "tanh", sums) if network.output == "tanh" else sums
    for output, value in zip(outputs, sums, strict=True):
        builder.store(floats, value, "%action", output)


def _transpose(builder: FunctionBuilder, x: View, inputs: int, to: str) -> None:
    """Write the members' inputs x to `to` as [input, lane], in squares of as many inputs as lanes."""
    floats, width = builder.llvm_types["f"], builder.width

    def square(number: str, _: Names) -> Names:
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
