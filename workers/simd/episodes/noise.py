"""Code of the noise generator: the words of `es_service.protocol.noise`, at about three numbers per nanosecond."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, normal_integers
from workers.simd.backend.emit import inline
from workers.simd.backend.function_builder import FunctionBuilder, Values, module
from workers.simd.backend.target import Target
from workers.simd.frontend.trace import jaxpr_digest, trace_jaxpr

UNROLLED = 4
"""Number of vectors of noise that are made in one trip of the gradient's loop."""


def _jaxpr() -> ClosedJaxpr:
    """Jaxpr of the noise k as a function of (key, coordinate)."""
    word = jax.ShapeDtypeStruct((), jnp.uint32)
    key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
    return jax.make_jaxpr(lambda key, at: normal_integers(jnp, key, at))(key, word)


def definition() -> str:
    """Text that identifies the noise generator, so that code compiled with another generator is not used."""
    return f"{jaxpr_digest(_jaxpr())} {NORMAL_STD}"


def noise_of(builder: FunctionBuilder, key: Values, coordinate: str, *, halved: bool) -> str:
    """Vector of integer noise k for vectors of key words and coordinates; if `halved`, of j in k = 2 j + 1."""
    graph, _, (output,) = trace_jaxpr(_jaxpr())
    if halved:
        output = graph.op("ashr", graph.op("isub", output, graph.i(1)), graph.i(1))
    given = {graph.input("i", place): name for place, name in enumerate([*key, coordinate])}
    return inline(builder, graph, [output], given)[0]


def load_key(builder: FunctionBuilder, keys: str, pair: str) -> Values:
    """Words of key number `pair`, as vectors with the word in all lanes."""
    words = [builder.load("i32", keys, builder.index((pair, KEY_WORDS), (word, 1))) for word in range(KEY_WORDS)]
    return [builder.splat(word, "i") for word in words]


def keys_of_members(builder: FunctionBuilder, keys: str) -> Values:
    """Words of the keys of as many members as there are lanes; the two members of a pair have the same key."""
    words = []
    for word in range(KEY_WORDS):
        vector = "poison"
        for lane in range(builder.width):
            key_word = builder.load("i32", keys, lane // 2 * KEY_WORDS + word)
            vector = builder.value(f"insertelement {builder.llvm_types['i']} {vector}, i32 {key_word}, i64 {lane}")
        words.append(vector)
    return words


def lanes(builder: FunctionBuilder) -> str:
    """Constant vector 0, 1, 2, ..., one number per lane."""
    return f"<{', '.join(f'i32 {lane}' for lane in range(builder.width))}>"


def noise_of_weights(builder: FunctionBuilder, noise: str, vector: str | int) -> str:
    """Vector of noise j, as floats, of a vector of weights."""
    llvm_type = f"<{builder.width} x i8>"
    words = builder.value(f"sext {llvm_type} {builder.load(llvm_type, noise, vector)} to {builder.llvm_types['i']}")
    return builder.value(f"sitofp {builder.llvm_types['i']} {words} to {builder.llvm_types['f']}")


def by_sign(builder: FunctionBuilder, value: str) -> str:
    """Vector with the sign flipped in the lanes of - members."""
    signs = ", ".join(f"float {-1.0 if lane % 2 else 1.0}" for lane in range(builder.width))
    return builder.value(f"fmul {builder.llvm_types['f']} {value}, <{signs}>")


def fill_function(vectors: int, singles: int, target: Target) -> FunctionBuilder:
    """Function `void fill(ptr keys, ptr places, ptr noise)`, which writes the bytes j of all pairs of a block.

    noise begins with [pair, vector, lane] for the vectors of weights, whose lanes are successive coordinates from the
    vector's entry in `places` on. [single, member] for the single weights follows; the remaining entries of `places`
    are their coordinates, and both members of a pair have the same noise.
    """
    builder = FunctionBuilder("fill", ["ptr noalias %keys", "ptr noalias %places", "ptr noalias %noise"], target)
    width = target.width
    bytes_ = f"<{width} x i8>"

    def pair(number: str, _: Values) -> Values:
        key = load_key(builder, "%keys", number)

        def vector(at: str, _: Values) -> Values:
            start = builder.splat(builder.load("i32", "%places", at), "i")
            coordinate = builder.value(f"add {builder.llvm_types['i']} {start}, {lanes(builder)}")
            keep(noise_of(builder, key, coordinate, halved=True), builder.index((number, vectors), (at, 1)))
            return []

        builder.loop(vectors, vector)
        return []

    def keep(j: str, at: str) -> None:
        builder.store(bytes_, builder.value(f"trunc {builder.llvm_types['i']} {j} to {bytes_}"), "%noise", at)

    if vectors:
        builder.loop(width // 2, pair)
    key = keys_of_members(builder, "%keys")

    def single(number: str, _: Values) -> Values:
        coordinate = builder.splat(builder.load("i32", "%places", builder.index((number, 1), (vectors, 1))), "i")
        keep(noise_of(builder, key, coordinate, halved=True), builder.index((number, 1), (width // 2 * vectors, 1)))
        return []

    builder.loop(singles, single)
    return builder


def gradient_module(target: Target) -> str:
    """LLVM IR of `void kernel(ptr weights, ptr keys, i64 pairs, ptr sums, i64 groups)`, the sum of weighted noise.

    sums has groups of UNROLLED vectors. They become the sum over pairs of weight * standard normal noise; pairs are
    added in their order.
    """
    parameters = ["ptr noalias %weights", "ptr noalias %keys", "i64 %pairs", "ptr noalias %sums", "i64 %groups"]
    builder = FunctionBuilder("inside", parameters, target)
    width, floats = target.width, builder.llvm_types["f"]

    def group(number: str, _: Values) -> Values:
        first = builder.value(f"trunc i64 {builder.index((number, UNROLLED * width))} to i32")
        start = builder.value(f"add {builder.llvm_types['i']} {builder.splat(first, 'i')}, {lanes(builder)}")
        coordinates = [
            builder.value(f"add {builder.llvm_types['i']} {start}, splat (i32 {vector * width})")
            for vector in range(UNROLLED)
        ]

        def add(pair: str, sums: Values) -> Values:
            key = load_key(builder, "%keys", pair)
            weight = builder.splat(builder.load("float", "%weights", pair))
            new_sums = []
            for coordinate, total in zip(coordinates, sums, strict=True):
                k = noise_of(builder, key, coordinate, halved=False)
                new_sums.append(
                    builder.fma(weight, builder.value(f"sitofp {builder.llvm_types['i']} {k} to {floats}"), total)
                )
            return new_sums

        scale = builder.splat(float_constant(np.float32(1.0 / NORMAL_STD)))
        for vector, total in enumerate(builder.loop("%pairs", add, [(floats, "zeroinitializer")] * UNROLLED)):
            scaled = builder.value(f"fmul {floats} {total}, {scale}")
            builder.store(floats, scaled, "%sums", builder.index((number, UNROLLED), (vector, 1)))
        return []

    builder.loop("%groups", group)
    return module([builder])


def float_constant(value: np.float32) -> str:
    """A float32 in LLVM's notation."""
    return f"0x{np.float64(value).view(np.uint64):016X}"
