"""Rules of JAX's random numbers: its threefry keys, and what is made of them.

A key is a pair of nodes (`Graph.pair`). What splitting, folding and drawing do is taken from JAX's own definition of
the generator, which leaves threefry2x32 alone to be defined here; so bits are JAX's, whatever its settings are. The
settings belong to the hash of a function (`trace.jaxpr_digest`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr
from jax.extend.random import threefry_prng_impl

from workers.simd.frontend.tracer import Nodes, Tracer, graph_dtype, primitive

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA


@primitive("threefry2x32")
def _threefry(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    """Threefry-2x32 with 20 rounds (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011)."""
    key_0, key_1, x, y = np.broadcast_arrays(*arrays)
    parity = t.constants(np.uint32(PARITY))
    keys = (key_0, key_1, t.ops("ixor", t.ops("ixor", key_0, key_1), parity))
    x, y = t.ops("iadd", x, keys[0]), t.ops("iadd", y, keys[1])
    for number in range(5):
        for by in ROTATIONS[number % 2]:
            x = t.ops("iadd", x, y)
            left, right = (t.constants(np.int32(bits)) for bits in (by, 32 - by))
            y = t.ops("ixor", x, t.ops("ior", t.ops("shl", y, left), t.ops("lshr", y, right)))
        x = t.ops("iadd", x, keys[(number + 1) % 3])
        y = t.ops("iadd", y, t.ops("iadd", keys[(number + 2) % 3], t.constants(np.int32(number + 1))))
    return [x, y]


@primitive("iota_2x32_shape")
def _counts(t: Tracer, equation: Any) -> list[Nodes]:
    """The upper and lower words of the number of each element of an array."""
    numbers = np.arange(np.prod(equation.params["shape"]), dtype=np.uint64).reshape(equation.params["shape"])
    return [t.constants(words.astype(np.uint32)) for words in (numbers >> 32, numbers & (2**32 - 1))]


@primitive("random_wrap", "random_unwrap")
def _wrap(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    if equation.primitive.name == "random_unwrap":
        return t.words(x)
    graph_dtype(equation.outvars[0].aval.dtype)  # refuses keys of other generators
    return t.keys(x)


@primitive("random_seed")
def _seed(t: Tracer, equation: Any, seeds: Nodes) -> Nodes:
    graph_dtype(equation.outvars[0].aval.dtype)  # refuses keys of other generators
    return t.keys(*t.closed(_defined("seed", equation.invars[0].aval.dtype, (), seeds.shape), [seeds]))


@primitive("random_split")
def _split(t: Tracer, equation: Any, keys: Nodes) -> Nodes:
    shape = tuple(map(int, equation.params["shape"]))
    return t.keys(*t.closed(_defined("split", np.dtype(np.uint32), (shape,), keys.shape), [t.words(keys)]))


@primitive("random_fold_in")
def _fold_in(t: Tracer, equation: Any, keys: Nodes, numbers: Nodes) -> Nodes:
    keys, numbers = np.broadcast_arrays(keys, numbers)
    closed = _defined("fold_in", equation.invars[1].aval.dtype, (), keys.shape)
    return t.keys(*t.closed(closed, [t.words(keys), numbers]))


@primitive("random_bits")
def _random_bits(t: Tracer, equation: Any, keys: Nodes) -> list[Nodes]:
    width, shape = equation.params["bit_width"], tuple(map(int, equation.params["shape"]))
    closed = _defined("random_bits", np.dtype(np.uint32), (width, shape), keys.shape)
    return t.closed(closed, [t.words(keys)])


def _defined(name: str, dtype: Any, parameters: tuple, shape: tuple[int, ...]) -> ClosedJaxpr:
    """JAX's definition of a function of its threefry generator, of keys with a shape.

    Args:
        dtype: that of the last argument of the function.
        parameters: the constant arguments, which follow those that are arrays.
    """
    return _of_setting(name, dtype, parameters, shape, partitionable())


@functools.cache
def _of_setting(name: str, dtype: Any, parameters: tuple, shape: tuple[int, ...], _: bool) -> ClosedJaxpr:
    of_one: Any = getattr(threefry_prng_impl, name)
    key, number = jax.ShapeDtypeStruct((*shape, 2), jnp.uint32), jax.ShapeDtypeStruct(shape, dtype)
    arguments = {"seed": [number], "fold_in": [key, number]}.get(name, [key])
    function: Callable[..., Any] = lambda *arrays: of_one(*arrays, *parameters)  # noqa: E731
    for _axis in shape:
        function = jax.vmap(function)
    return jax.make_jaxpr(function)(*arguments)


def partitionable() -> bool:
    """JAX's setting that says which of two ways random numbers are made of threefry keys."""
    config: Any = jax.config
    return config.jax_threefry_partitionable
