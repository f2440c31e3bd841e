"""Elementary functions: the errors their docstrings state, against float64, and what they do at the edges."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from workers.simd.episodes.kernel import compile_kernel

INF, NAN = math.inf, math.nan
TINY = float(np.finfo(np.float32).tiny)


def compiled(function: Callable, arguments: int = 1) -> Callable[..., np.ndarray]:
    return compile_kernel(function, *[jax.ShapeDtypeStruct((), jnp.float32)] * arguments)


def ulps(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Distance from the exact value in units in the last place of float32; denormal results count as zero."""
    with np.errstate(all="ignore"):
        rounded = exact.astype(np.float32)
        unit = np.spacing(np.maximum(np.abs(rounded), np.float32(TINY))).astype(np.float64)
        return np.abs(found.astype(np.float64) - exact) / unit


def spread(low: float, high: float, count: int = 200_000) -> np.ndarray:
    """Numbers between two bounds: evenly, and around zero of all magnitudes."""
    rng = np.random.default_rng(0)
    even = rng.uniform(low, high, count)
    small = np.exp(rng.uniform(math.log(1e-30), math.log(max(abs(low), abs(high))), count))
    small = np.clip(small * rng.choice([-1, 1], count), low, high)
    return np.concatenate([even, small]).astype(np.float32)


CASES: dict[str, tuple[Callable, Callable, float, float, float]] = {
    "exp": (jnp.exp, np.exp, -86.5, 88.72, 2.0),
    "expm1": (jnp.expm1, np.expm1, -86.5, 88.72, 3.0),
    "log": (jnp.log, np.log, TINY, 3e38, 2.0),
    "log1p": (jnp.log1p, np.log1p, -0.999999, 1e30, 3.0),
    "tanh": (jnp.tanh, np.tanh, -20.0, 20.0, 6.0),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + np.exp(-x)), -86.0, 80.0, 4.0),
    "asin": (jnp.arcsin, np.arcsin, -1.0, 1.0, 3.0),
    "acos": (jnp.arccos, np.arccos, -1.0, 1.0, 3.0),
    "atan": (jnp.arctan, np.arctan, -1e30, 1e30, 3.0),
    "rsqrt": (jax.lax.rsqrt, lambda x: 1 / np.sqrt(x), TINY, 3e38, 2.0),
    "exp2": (jnp.exp2, np.exp2, -125.0, 127.99, 2.0),
}
"""Name -> (ours, exact, from, to, ulp)."""


@pytest.mark.parametrize("name", CASES)
def test_errors_are_as_stated(name: str) -> None:
    ours, exact, low, high, most = CASES[name]
    x = spread(low, high)
    x = x[(x >= np.float32(low)) & (x <= np.float32(high)) & (np.abs(x) >= TINY)]
    error = ulps(compiled(ours)(x), exact(x.astype(np.float64)))
    assert error.max() <= most, (error.max(), x[error.argmax()])


@pytest.mark.parametrize(("ours", "exact"), [(jnp.sin, np.sin), (jnp.cos, np.cos)])
def test_sine_and_cosine_are_as_stated(ours: Callable, exact: Callable) -> None:
    run = compiled(ours)
    near = spread(-100.0, 100.0)
    wanted = exact(near.astype(np.float64))
    error = np.minimum(ulps(run(near), wanted) / 2.0, np.abs(run(near) - wanted) / 1e-7)
    assert error.max() <= 1.0, near[error.argmax()]
    far = spread(-1e5, 1e5)
    assert np.abs(run(far) - exact(far.astype(np.float64))).max() <= 1e-7
    assert np.isnan(run(np.array([2e6, -1e30, INF, -INF, NAN], np.float32))).all()


def test_tangent_is_as_stated() -> None:
    x = spread(-100.0, 100.0)
    x = x[np.abs(np.cos(x.astype(np.float64))) > 1e-2]
    assert ulps(compiled(jnp.tan)(x), np.tan(x.astype(np.float64))).max() <= 5.0


def test_atan2_is_as_stated_in_all_quadrants() -> None:
    rng = np.random.default_rng(1)
    y, x = (spread(-1e3, 1e3)[rng.permutation(400_000)] for _ in range(2))
    error = ulps(compiled(jnp.arctan2, 2)(y, x), np.arctan2(y.astype(np.float64), x.astype(np.float64)))
    usable = np.abs(y.astype(np.float64) / np.where(x == 0, 1, x)) > 1e-30
    assert error[usable].max() <= 3.0


def test_atan2_at_the_edges_is_as_in_ieee_754() -> None:
    numbers = np.array([0.0, -0.0, 1.0, -1.0, INF, -INF, NAN], np.float32)
    y, x = (side.reshape(-1) for side in np.meshgrid(numbers, numbers))
    found, wanted = compiled(jnp.arctan2, 2)(y, x), np.arctan2(y, x)
    np.testing.assert_allclose(found, wanted, rtol=2e-7)
    np.testing.assert_array_equal(
        np.signbit(found), np.signbit(wanted) & ~np.isnan(wanted) | np.signbit(found) & np.isnan(found)
    )


def test_powers_are_as_stated() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.01, 20.0, 100_000).astype(np.float32), rng.uniform(-8, 8, 100_000).astype(np.float32)
    exact = x.astype(np.float64) ** y.astype(np.float64)
    allowed = 3.0 + 2.0 * np.abs(y * np.log(x))
    assert (ulps(compiled(jnp.power, 2)(x, y), exact) / allowed).max() <= 1.0
    for exponent in (0.5, 2.0, 3.0, -1.0, -2.0, 0.0, 7.0):
        found = compiled(lambda x, exponent=exponent: jax.lax.pow(x, jnp.float32(exponent)))(x)
        assert ulps(found, x.astype(np.float64) ** exponent).max() <= max(1.0, abs(exponent))


@pytest.mark.parametrize("y", [2.0, 3.0, 0.5, 0.0, -1.0, 1.7, -3.0, INF, -INF, NAN])
def test_powers_at_the_edges_are_as_numpys(y: float) -> None:
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0, INF, NAN], np.float32)
    with np.errstate(all="ignore"):
        wanted = np.power(x, np.float32(y))
    found = compiled(jnp.power, 2)(x, np.full_like(x, y))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


EDGES: list[tuple[Callable, list[float], list[float]]] = [
    (jnp.exp, [INF, -INF, NAN, 89.0, -87.0, 0.0], [INF, 0.0, NAN, INF, 0.0, 1.0]),
    (jnp.exp2, [INF, -INF, NAN, 128.0, -126.0, 0.0, 10.0, -125.0], [INF, 0.0, NAN, INF, 0.0, 1.0, 1024.0, 2.0**-125]),
    (jnp.expm1, [INF, -INF, NAN, 89.0, -87.0, 0.0], [INF, -1.0, NAN, INF, -1.0, 0.0]),
    (jnp.log, [INF, 0.0, -0.0, -1.0, NAN, 1.0], [INF, -INF, -INF, NAN, NAN, 0.0]),
    (jnp.log1p, [INF, -INF, -1.0, -2.0, NAN, 0.0], [INF, NAN, -INF, NAN, NAN, 0.0]),
    (jnp.tanh, [INF, -INF, NAN, 0.0, 50.0], [1.0, -1.0, NAN, 0.0, 1.0]),
    (jax.nn.sigmoid, [INF, -INF, NAN, 0.0], [1.0, 0.0, NAN, 0.5]),
    (jnp.arcsin, [1.5, -1.5, NAN, 1.0, 0.0], [NAN, NAN, NAN, math.pi / 2, 0.0]),
    (jnp.arccos, [1.5, -1.5, NAN, 1.0, -1.0, 0.0], [NAN, NAN, NAN, 0.0, math.pi, math.pi / 2]),
    (jnp.arctan, [INF, -INF, NAN, 0.0], [math.pi / 2, -math.pi / 2, NAN, 0.0]),
    (jax.lax.erf_inv, [1.0, -1.0, 1.5, -INF, NAN, 0.0, -0.0], [INF, -INF, NAN, NAN, NAN, 0.0, -0.0]),
    (jnp.sqrt, [-1.0, 0.0, INF, NAN, 1e-40], [NAN, 0.0, INF, NAN, 0.0]),
]


@pytest.mark.parametrize("case", EDGES, ids=lambda case: case[0].__name__)
def test_edges(case: tuple[Callable, list[float], list[float]]) -> None:
    function, x, wanted = case
    found = compiled(function)(np.array(x, np.float32))
    np.testing.assert_allclose(found, np.array(wanted, np.float32), rtol=2e-7, atol=0)


def test_conversion_to_integers_is_jaxs() -> None:
    x = np.array([0.0, -0.0, 1.9, -1.9, 2e9, 3e9, -3e9, INF, -INF, NAN, 2147483520.0], np.float32)
    found = compiled(lambda x: x.astype(jnp.int32))(x)
    np.testing.assert_array_equal(found, np.asarray(jnp.asarray(x).astype(jnp.int32)))


def test_the_inverse_of_erf_and_so_normal_numbers_are_within_2_ulp_of_jaxs() -> None:
    """Their distance from the exact value is greater near -1 and 1, where 1 - x^2 is rounded."""
    x = np.concatenate([spread(-1.0, 1.0), 1.0 - np.exp(spread(-17.0, -1.0))]).astype(np.float32)
    x = x[np.abs(x) < 1.0]
    found, wanted = (np.asarray(f(x)) for f in (compiled(jax.lax.erf_inv), jax.jit(jax.lax.erf_inv)))
    assert ulps(found, wanted.astype(np.float64)).max() <= 2.0
    keys = np.random.default_rng(3).integers(0, 2**32, (2000, 2), dtype=np.uint32)
    normal = lambda key: jax.random.normal(key, (50,))  # noqa: E731
    found = compile_kernel(normal, jax.ShapeDtypeStruct((2,), jnp.uint32))(keys)
    wanted = np.asarray(jax.jit(jax.vmap(normal))(keys))
    assert ulps(found, wanted.astype(np.float64)).max() <= 2.0
    assert (found == wanted).mean() > 0.999
