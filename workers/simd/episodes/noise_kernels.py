"""Code of the noise generator: the words of `es_service.protocol.noise`, at about three numbers per nanosecond."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, Domain, normal_integers, stream_keys
from es_service.protocol.policies import FloatArray, IsoLine, Recipes, recipes_of
from workers.simd.backend.emit import inline
from workers.simd.backend.function_builder import FunctionBuilder, Names, module
from workers.simd.backend.native import Native, load_compiled, require, require_same
from workers.simd.backend.target import Target, host_target
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


def noise_of(builder: FunctionBuilder, key: Names, coordinate: str, *, halved: bool) -> str:
    """Vector of integer noise k for vectors of key words and coordinates; if `halved`, of j in k = 2 j + 1."""
    graph, _, (output,) = trace_jaxpr(_jaxpr())
    if halved:
        output = graph.op("ashr", graph.op("isub", output, graph.i(1)), graph.i(1))
    given = {graph.input("i", place): name for place, name in enumerate([*key, coordinate])}
    return inline(builder, graph, [output], given)[0]


def load_key(builder: FunctionBuilder, keys: str, pair: str) -> Names:
    """Words of key number `pair`, as vectors with the word in all lanes."""
    words = [builder.load("i32", keys, builder.index((pair, KEY_WORDS), (word, 1))) for word in range(KEY_WORDS)]
    return [builder.splat(word, "i") for word in words]


def keys_of_members(builder: FunctionBuilder, keys: str) -> Names:
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

    def pair(number: str, _: Names) -> Names:
        key = load_key(builder, "%keys", number)

        def vector(at: str, _: Names) -> Names:
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

    def single(number: str, _: Names) -> Names:
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

    def group(number: str, _: Names) -> Names:
        first = builder.value(f"trunc i64 {builder.index((number, UNROLLED * width))} to i32")
        start = builder.value(f"add {builder.llvm_types['i']} {builder.splat(first, 'i')}, {lanes(builder)}")
        coordinates = [
            builder.value(f"add {builder.llvm_types['i']} {start}, splat (i32 {vector * width})")
            for vector in range(UNROLLED)
        ]

        def add(pair: str, sums: Names) -> Names:
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


# Code that makes policies of recipes: the iso+line variation with the bits of `es_service.protocol.policies`.
#
# Its operations are those of the definition, one by one, and it does not treat denormal numbers as zeros, which NumPy
# does not either.


@cache
def make_variation(target: Target | None = None) -> Callable[..., FloatArray]:
    """Function of recipes that returns their policies, as `Recipes.made`, in a given array [N, D] or a new one; several
    threads may call it."""
    target = target or host_target()
    signature = [*[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 3, *[ctypes.c_float] * 2]

    def function(native: Native) -> Callable[..., FloatArray]:
        call = native.function(*signature)

        def made(recipes: Recipes, out_N_D: FloatArray | None = None) -> FloatArray:
            parents = [np.ascontiguousarray(parent_D, np.float32) for parent_D in recipes.parents]
            size, (parent_N_2, key_N_4) = parents[0].size, (recipes.parent_N_2, np.ascontiguousarray(recipes.key_N_4))
            policy_N_D = np.empty((len(recipes), size), np.float32) if out_N_D is None else out_N_D
            require(policy_N_D.shape == (len(recipes), size), "there must be room for each policy")
            if size < target.width:
                policy_N_D[...] = recipes.made()
                return policy_N_D
            require(policy_N_D.dtype == np.float32 and policy_N_D.strides[1] == 4, "parameters must follow each other")
            require(
                all(parent_D.size == size for parent_D in parents)
                and 0 <= parent_N_2.min() <= parent_N_2.max() < len(parents)
                and parent_N_2.shape == (len(recipes), 2)
                and key_N_4.dtype == np.uint32
                and key_N_4.shape == (len(recipes), KEY_WORDS),
                "recipes must have keys, and parents of one size",
            )
            address = np.array([parent_D.__array_interface__["data"][0] for parent_D in parents], np.uint64)
            x_N, y_N = np.ascontiguousarray(address[parent_N_2.T])
            row_bytes = np.uint64(policy_N_D.strides[0])
            out_N = policy_N_D.ctypes.data + np.arange(len(recipes), dtype=np.uint64) * row_bytes
            sigmas = (np.float32(sigma) for sigma in recipes.rule)
            call(key_N_4, x_N, y_N, out_N, len(recipes), size, -(-size // target.width), *sigmas)
            return policy_N_D

        return made

    name, text = f"variation {definition()}", lambda: variation_module(target)
    return function(load_compiled(name, text, target, check=lambda native: check_variation(function(native))))


def variation_module(target: Target) -> str:
    """LLVM IR of `void kernel(ptr keys, ptr x, ptr y, ptr out, i64 policies, i64 parameters, i64 vectors, float iso,
    float line)`, which writes the parameters of policies.

    x, y and out have the address of each policy's parents and of its own parameters, of which there are at least as
    many as a vector has lanes. The last vector ends with the last parameter, and so may begin in the one before.
    """
    pointers = [f"ptr noalias %{name}" for name in ("keys", "x", "y", "out")]
    integers = [f"i64 %{name}" for name in ("policies", "parameters", "vectors")]
    builder = FunctionBuilder("inside", [*pointers, *integers, "float %iso", "float %line"], target)
    width = target.width
    floats, integer = builder.llvm_types["f"], builder.llvm_types["i"]
    std, last = builder.splat(float_constant(np.float32(NORMAL_STD))), builder.value(f"sub i64 %parameters, {width}")
    iso = builder.splat("%iso")
    end = builder.splat(builder.value("trunc i64 %parameters to i32"), "i")

    def variate(key: Names, coordinate: str) -> str:
        k = noise_of(builder, key, coordinate, halved=False)
        return builder.value(f"fdiv {floats} {builder.value(f'sitofp {integer} {k} to {floats}')}, {std}")

    def policy(number: str, _: Names) -> Names:
        key = load_key(builder, "%keys", number)
        x, y, out = (
            builder.value(f"inttoptr i64 {builder.load('i64', f'%{name}', number)} to ptr")
            for name in ("x", "y", "out")
        )
        line = builder.value(f"fmul {floats} {builder.splat('%line')}, {variate(key, end)}")

        def vector(at: str, _: Names) -> Names:
            start = builder.index((at, width))
            is_last = builder.value(f"icmp sgt i64 {start}, {last}")
            start = builder.value(f"select i1 {is_last}, i64 {last}, i64 {start}")
            first = builder.splat(builder.value(f"trunc i64 {start} to i32"), "i")
            noise = variate(key, builder.value(f"add {integer} {first}, {lanes(builder)}"))
            seen_x, seen_y = (
                builder.value(f"load {floats}, ptr {builder.at(parent, start, 'float')}, align 4") for parent in (x, y)
            )
            moved = builder.value(f"fadd {floats} {builder.value(f'fmul {floats} {iso}, {noise}')}, {seen_x}")
            between = builder.value(f"fsub {floats} {seen_y}, {seen_x}")
            whole = builder.value(f"fadd {floats} {moved}, {builder.value(f'fmul {floats} {line}, {between}')}")
            builder.do(f"store {floats} {whole}, ptr {builder.at(out, start, 'float')}, align 4")
            return []

        builder.loop("%vectors", vector)
        return []

    builder.loop("%policies", policy)
    return module([builder], exact=True)


def check_variation(made: Callable[[Recipes], FloatArray]) -> None:
    """Raise WrongCodeError unless a few policies have the bits of their definition."""
    rng = np.random.default_rng(0)
    for size in (16, 16 * 7 + 5):
        parents = list(rng.normal(size=(3, size)).astype(np.float32))
        keys = stream_keys(0, Domain.VARIATION, 0, np.arange(4))
        recipes = recipes_of(IsoLine(0.3, 0.6), parents, np.array([[0, 1], [2, 0], [1, 1], [2, 1]]), keys)
        require_same(made(recipes), recipes.made(), "a policy made of its parents")
