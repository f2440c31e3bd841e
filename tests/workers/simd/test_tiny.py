"""Results near the least normal float: which of them are zeros, on x86-64 and on 64-bit Arm.

On both, an operation rounds its exact result to 24 bits, and what is below 2^-126 is a zero. x86-64 compares after
rounding and Arm before, so they differ for results from 2^-126 - 2^-151 to 2^-126, which x86-64 rounds up.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.workers.simd.rollouts import every_target
from workers.simd.backend.target import ISAS, Target
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.graph.operations import compute

LEAST, HALF_UNIT = Fraction(2) ** -126, Fraction(2) ** -151
NEAR = 2000


def near_the_edge() -> tuple[dict[str, list[np.ndarray]], dict[str, list[Fraction]]]:
    """(arguments, exact results) of operations whose results are within a few units in the last place of 2^-126."""
    rng = np.random.default_rng(0)

    def off(x: np.ndarray, most: int) -> np.ndarray:
        return (x.astype(np.float32).view(np.int32) + rng.integers(-most, most + 1, NEAR).astype(np.int32)).view("f4")

    a = (rng.uniform(1, 2, NEAR) * 2.0**-40).astype(np.float32) * rng.choice([-1, 1], NEAR).astype(np.float32)
    mul = [a, off(2.0**-126 / np.abs(a.astype(float)), 2)]
    b = rng.uniform(1, 2, NEAR).astype(np.float32) * np.float32(2.0**90)
    div = [off(b * np.float32(2.0**-126 * 2.0**10), 2), b * np.float32(2.0**10)]
    factors = rng.uniform(1, 2, (2, NEAR)) * np.stack([np.full(NEAR, 2.0**-75), 2.0 ** -rng.integers(73, 80, NEAR)])
    factors[0] *= rng.choice([-1, 1], NEAR)
    fma = [*factors.astype(np.float32), np.maximum(off(np.full(NEAR, 2.0**-126), 1), np.float32(2.0**-126))]
    exact: dict[str, Callable[..., Fraction]] = {
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "fma": lambda a, b, c: a * b + c,
    }
    arguments = {"mul": mul, "div": div, "fma": fma}
    return arguments, {
        name: [exact[name](*map(Fraction, map(float, one))) for one in zip(*of, strict=True)]
        for name, of in arguments.items()
    }


def is_zero(exact: Fraction, architecture: str) -> bool:
    """The rule of this module's first lines; a half is rounded to the even 2^-126."""
    return abs(exact) < (LEAST - HALF_UNIT if architecture == "x86_64" else LEAST)


def function(a, b, c, d, e, f, g):
    return a * b, c / d, e * f + g


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_what_counts_as_zero_is_what_the_architecture_says(target: Target) -> None:
    arguments, exact = near_the_edge()
    given = [one for of in arguments.values() for one in of]
    kernel = compile_kernel(function, *[jax.ShapeDtypeStruct((), jnp.float32)] * 7, target=target)
    found = dict(zip(arguments, kernel(*given), strict=True))
    architecture = ISAS[target.isa].architecture
    for name, result in found.items():
        zeros = np.array([is_zero(one, architecture) for one in exact[name]])
        assert zeros.any()
        np.testing.assert_array_equal(result == 0, zeros)
        differ = [LEAST - HALF_UNIT <= abs(one) < LEAST for one in exact[name]]
        reference = compute(name, arguments[name])
        assert any(differ) or name == "div", "a quotient of floats is never so near"
        np.testing.assert_array_equal(result[~np.array(differ)], reference[~np.array(differ)])
        if architecture == "x86_64":
            np.testing.assert_array_equal(result, reference)
        else:
            np.testing.assert_array_equal(result[differ], 0)
            np.testing.assert_array_equal(np.abs(reference[differ]), np.float32(2.0**-126))
