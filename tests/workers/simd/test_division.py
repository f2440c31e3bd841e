"""Remainders and whole quotients: the bits of xla at every width, over the stated range, and NaN beyond it."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.workers.simd.rollouts import every_target
from workers.simd.backend.target import Target
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.graph import elementary

INF, NAN = math.inf, math.nan
EDGES = np.array([0.0, -0.0, 1.0, -1.0, 2.5, -0.1, 5.0, 2.0**24, 2e-30, -2e-30, 1e14, 3e38, INF, -INF, NAN], np.float32)
INTEGERS = np.array([0, 1, -1, 2, -2, 7, -7, 12345, 2**31 - 1, -(2**31), 1 - 2**31], np.int32)


def pairs(values: np.ndarray) -> list[np.ndarray]:
    """Each with each."""
    return [side.reshape(-1) for side in np.meshgrid(values, values)]


def quotients(count: int = 200_000) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) of all sizes within the range, a third of them multiples but for rounding, a third next to those."""
    rng = np.random.default_rng(0)
    y = (rng.uniform(1, 2, count) * 2.0 ** rng.uniform(-99, 70, count) * rng.choice([-1, 1], count)).astype(np.float32)
    times = np.exp2(rng.uniform(-3, 47.9, count))
    x = (y * np.where(np.arange(count) % 3 > 0, np.rint(times), times)).astype(np.float32)
    x[2::3] = np.nextafter(x[2::3], np.float32(0.0))
    return x, y


def angles(count: int = 100_000) -> np.ndarray:
    return np.random.default_rng(1).normal(0.0, 50.0, count).astype(np.float32)


def assert_same_bits(found: np.ndarray, wanted: np.ndarray) -> None:
    """Signs of zeros too; a NaN is as good as another."""
    is_number = ~np.isnan(wanted)
    np.testing.assert_array_equal(np.isnan(found), ~is_number)
    np.testing.assert_array_equal(found[is_number].view(np.int32), wanted[is_number].view(np.int32))


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_a_remainder_has_the_bits_of_xla_s_and_numpy_s(target: Target) -> None:
    f = jax.ShapeDtypeStruct((), jnp.float32)
    kernel = compile_kernel(lambda x, y: (lax.rem(x, y), jnp.mod(x, y)), f, f, target=target)
    edges = pairs(EDGES)
    with np.errstate(all="ignore"):
        size, step = np.abs(edges).astype(np.float64)
        in_range = ~(size / step > elementary.QUOTIENT_LIMIT) | np.isinf(size) | (step == 0)
    for x, y in (quotients(), [side[in_range] for side in edges]):
        rest, modulo = kernel(x, y)
        for found, function in ((rest, lax.rem), (modulo, jnp.mod)):
            assert_same_bits(found, np.asarray(jax.jit(function)(x, y)))
        with np.errstate(all="ignore"):
            assert_same_bits(rest, np.fmod(x, y))


def test_beyond_its_range_a_remainder_is_not_a_number() -> None:
    kernel = compile_kernel(lax.rem, *[jax.ShapeDtypeStruct((), jnp.float32)] * 2)
    y = np.array([1.0, -0.1, 3e7, 9e-31, 1e-36], np.float32)
    x = np.array([3e14, -1e14, 1e22, 1.0, 1e-35], np.float32)
    assert np.isnan(kernel(x, y)).all()
    last = np.float32(elementary.QUOTIENT_LIMIT)
    assert kernel(np.array([last, np.nextafter(last, np.float32(INF))]), np.ones(2, np.float32))[0] == 0.0
    small = np.array([1e-31, -1e-31], np.float32)
    np.testing.assert_array_equal(kernel(small, np.full(2, 5e-31, np.float32)), small)


@pytest.mark.parametrize("divisor", [2 * math.pi, 1.0, 0.25, -3.0, 1e-3])
def test_wrapping_by_a_constant_has_the_bits_of_xla_s(divisor: float) -> None:
    def wrapped(x):
        return (x + 0.5) % divisor - 0.5, x // divisor, jnp.fmod(x, divisor), lax.round(x * divisor)

    x = np.concatenate([angles(), np.float32(divisor) * np.arange(-40, 40, dtype=np.float32) / 2])
    kernel = compile_kernel(wrapped, jax.ShapeDtypeStruct((), jnp.float32))
    for found, wanted in zip(kernel(x), jax.jit(wrapped)(x), strict=True):
        assert_same_bits(found, np.asarray(wanted))


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("dtype", ["int32", "uint32"])
def test_integers_are_divided_as_by_xla_where_processors_would_stop_too(target: Target, dtype: str) -> None:
    def function(a, b):
        constants = np.array([0, 1, -1, 7, -(2**31)], np.int32).view(dtype)
        by_constants = [divide(a, by) for divide in (lax.div, lax.rem) for by in constants]
        return lax.div(a, b), lax.rem(a, b), a // b, a % b, *by_constants

    rng = np.random.default_rng(2)
    random = [rng.integers(0, 2**32, 1000, dtype=np.uint32) >> rng.integers(0, 31, 1000, np.uint32) for _ in range(2)]
    edges = pairs(INTEGERS)
    of = jax.ShapeDtypeStruct((), dtype)
    kernel = compile_kernel(function, of, of, target=target)
    a, b = (np.concatenate([one.view(dtype), other.view(dtype)]) for one, other in zip(edges, random, strict=True))
    for found, wanted in zip(kernel(a, b), jax.jit(jax.vmap(function))(a, b), strict=True):
        np.testing.assert_array_equal(found, np.asarray(wanted))


def test_constants_are_divided_while_compiling_as_xla_divides_them() -> None:
    a, b = pairs(INTEGERS)

    def function(x):
        return x + lax.div(jnp.array(a), jnp.array(b)), x + lax.rem(jnp.array(a), jnp.array(b))

    kernel = compile_kernel(function, jax.ShapeDtypeStruct((a.size,), jnp.int32))
    quotient, rest = kernel(np.zeros((1, a.size), np.int32))
    # XLA gets them as arguments: of constants, the least integer by -1 ends its process.
    np.testing.assert_array_equal(quotient[0], np.asarray(jax.jit(lax.div)(a, b)))
    np.testing.assert_array_equal(rest[0], np.asarray(jax.jit(lax.rem)(a, b)))
