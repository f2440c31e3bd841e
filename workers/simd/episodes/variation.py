"""Code that makes policies of recipes: the iso+line variation with the bits of `es_service.protocol.recipes`.

Its operations are those of the definition, one by one, and it does not treat denormal numbers as zeros, which NumPy
does not either.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache

import numpy as np

from es_service.protocol.noise import KEY_WORDS, NORMAL_STD, Domain, stream_keys
from es_service.protocol.recipes import FloatArray, IsoLine, Recipes, recipes_of
from workers.simd.backend.function_builder import FunctionBuilder, Values, module
from workers.simd.backend.native import Native, load_compiled, require, require_same
from workers.simd.backend.target import Target, host_target
from workers.simd.episodes.noise import definition, float_constant, lanes, load_key, noise_of


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

    def variate(key: Values, coordinate: str) -> str:
        k = noise_of(builder, key, coordinate, halved=False)
        return builder.value(f"fdiv {floats} {builder.value(f'sitofp {integer} {k} to {floats}')}, {std}")

    def policy(number: str, _: Values) -> Values:
        key = load_key(builder, "%keys", number)
        x, y, out = (
            builder.value(f"inttoptr i64 {builder.load('i64', f'%{name}', number)} to ptr")
            for name in ("x", "y", "out")
        )
        line = builder.value(f"fmul {floats} {builder.splat('%line')}, {variate(key, end)}")

        def vector(at: str, _: Values) -> Values:
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
