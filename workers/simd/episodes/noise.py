"""Code of the noise, at some three numbers a nanosecond: that of `es_service.protocol.noise`, word for word."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, normal_integers
from workers.simd.backend.code import Code, Values, module
from workers.simd.backend.emit import inline
from workers.simd.frontend.digest import jaxpr_digest
from workers.simd.frontend.trace import trace_jaxpr

UNROLLED = 4
"""Vectors made at once."""


def _jaxpr() -> ClosedJaxpr:
    """k of (key, coordinate)."""
    word = jax.ShapeDtypeStruct((), jnp.uint32)
    key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
    return jax.make_jaxpr(lambda key, at: normal_integers(jnp, key, at))(key, word)


def definition() -> str:
    """A text that changes with the generator: what was compiled for another is not used."""
    return f"{jaxpr_digest(_jaxpr())} {NORMAL_STD}"


def noise_of(code: Code, key: Values, coordinate: str, *, halved: bool) -> str:
    """k of vectors of key words and coordinates, as integers; or j, where k = 2 j + 1."""
    graph, _, (output,) = trace_jaxpr(_jaxpr())
    if halved:
        output = graph.op("ashr", graph.op("isub", output, graph.i(1)), graph.i(1))
    given = {graph.input("i", place): name for place, name in enumerate([*key, coordinate])}
    return inline(code, graph, [output], given)[0]


def load_key(code: Code, keys: str, pair: str) -> Values:
    """The words of key number `pair`, each in all lanes."""
    words = [code.load("i32", keys, code.index((pair, KEY_WORDS), (word, 1))) for word in range(KEY_WORDS)]
    return [code.splat(word, "i") for word in words]


def keys_of_members(code: Code, keys: str) -> Values:
    """The words of the keys of as many members as there are lanes, neighbours having that of their pair."""
    words = []
    for word in range(KEY_WORDS):
        vector = "poison"
        for lane in range(code.width):
            one = code.load("i32", keys, lane // 2 * KEY_WORDS + word)
            vector = code.value(f"insertelement {code.vector['i']} {vector}, i32 {one}, i64 {lane}")
        words.append(vector)
    return words


def lanes(code: Code) -> str:
    """0, 1, 2, ... as a constant vector."""
    return f"<{', '.join(f'i32 {lane}' for lane in range(code.width))}>"


def fill_function(vectors: int, singles: int, width: int) -> Code:
    """`void fill(ptr keys, ptr places, ptr noise)`: j of each pair of a block of members, as bytes.

    noise is [pair, vector, lane] of the vectors, each along coordinates, of which `places` has the first; behind it
    [single, member] of the single coordinates, whose places follow, the members of a pair having the same.
    """
    code = Code("fill", ["ptr noalias %keys", "ptr noalias %places", "ptr noalias %noise"], width)
    bytes_ = f"<{width} x i8>"

    def pair(number: str, _: Values) -> Values:
        key = load_key(code, "%keys", number)

        def vector(at: str, _: Values) -> Values:
            start = code.splat(code.load("i32", "%places", at), "i")
            coordinate = code.value(f"add {code.vector['i']} {start}, {lanes(code)}")
            keep(noise_of(code, key, coordinate, halved=True), code.index((number, vectors), (at, 1)))
            return []

        code.loop(vectors, vector)
        return []

    def keep(j: str, at: str) -> None:
        code.store(bytes_, code.value(f"trunc {code.vector['i']} {j} to {bytes_}"), "%noise", at)

    if vectors:
        code.loop(width // 2, pair)
    key = keys_of_members(code, "%keys")

    def single(number: str, _: Values) -> Values:
        coordinate = code.splat(code.load("i32", "%places", code.index((number, 1), (vectors, 1))), "i")
        keep(noise_of(code, key, coordinate, halved=True), code.index((number, 1), (width // 2 * vectors, 1)))
        return []

    code.loop(singles, single)
    return code


def gradient_module(width: int) -> str:
    """LLVM IR of `void kernel(ptr weights, ptr keys, i64 pairs, ptr sums, i64 groups)`.

    sums, groups of UNROLLED vectors, become the sum over pairs of weight * noise, one pair after the other, in units of
    weight x standard normal.
    """
    parameters = ["ptr noalias %weights", "ptr noalias %keys", "i64 %pairs", "ptr noalias %sums", "i64 %groups"]
    code = Code("inside", parameters, width)
    floats = code.vector["f"]

    def group(number: str, _: Values) -> Values:
        first = code.value(f"trunc i64 {code.index((number, UNROLLED * width))} to i32")
        start = code.value(f"add {code.vector['i']} {code.splat(first, 'i')}, {lanes(code)}")
        coordinates = [
            code.value(f"add {code.vector['i']} {start}, splat (i32 {vector * width})") for vector in range(UNROLLED)
        ]

        def add(pair: str, sums: Values) -> Values:
            key = load_key(code, "%keys", pair)
            weight = code.splat(code.load("float", "%weights", pair))
            found = []
            for coordinate, one in zip(coordinates, sums, strict=True):
                k = noise_of(code, key, coordinate, halved=False)
                found.append(code.fma(weight, code.value(f"sitofp {code.vector['i']} {k} to {floats}"), one))
            return found

        scale = code.splat(_float(np.float32(1.0 / NORMAL_STD)))
        for vector, one in enumerate(code.loop("%pairs", add, [(floats, "zeroinitializer")] * UNROLLED)):
            scaled = code.value(f"fmul {floats} {one}, {scale}")
            code.store(floats, scaled, "%sums", code.index((number, UNROLLED), (vector, 1)))
        return []

    code.loop("%groups", group)
    return module([code])


def _float(value: np.float32) -> str:
    """A float32 as LLVM writes it."""
    return f"0x{np.float64(value).view(np.uint64):016X}"
