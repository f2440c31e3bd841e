"""The error for functions that this compiler does not support; xla computes them instead."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

_UNIFORMS = (
    "draw by JAX's own generator, threefry2x32, or by es_service.protocol.noise.uniforms(key, counters), with the key "
    "of reset and a counter in the state"
)
_ONE_HOT = (
    "instead of array[index] write jax.nn.one_hot(index, len(array)) @ array, or with policy.output = argmax, whose "
    "action is such a vector, action @ array"
)
_UPDATE = "instead of array.at[index].set(x) write jnp.where(jnp.arange(len(array)) == index, x, array)"
_FORMULA = (
    "factor positive definite matrices by jnp.linalg.cholesky, write other small systems out, or solve them by a fixed "
    "number of iterations"
)
_FEWER = "sort fewer numbers in a row; the least and the greatest are jnp.min and jnp.max"
WAYS_ROUND = {
    "gather": _ONE_HOT,
    "dynamic_slice": _ONE_HOT,
    "dynamic_update_slice": _UPDATE,
    "scatter": _UPDATE,
    "scatter-add": _UPDATE.replace(".set(x)", ".add(x)").replace("x, array", "array + x, array"),
    "scatter-mul": _UPDATE.replace(".set(x)", ".multiply(x)").replace("x, array", "array * x, array"),
    "sort": _FEWER,
    "top_k": _FEWER,
    **dict.fromkeys(("lu", "qr", "eigh", "svd"), _FORMULA),
}
"""Primitive that is not supported, or not for arrays as large -> what a task can do instead."""


def way_round(primitive: str) -> str:
    """What a task can do instead of a primitive that is not supported; empty if nothing is known."""
    if primitive.startswith(("random_", "threefry", "rng_")):
        return _UNIFORMS
    return WAYS_ROUND.get(primitive, "")


class UnsupportedError(Exception):
    """A function cannot be compiled; the message names the unsupported part, where it comes from and a way round."""

    def __init__(self, message: str, *, place: str = "", advice: str = "") -> None:
        """`place` is the line of the task that has the unsupported part, and `advice` what it can do instead, if that
        is known."""
        super().__init__(message + (f" (at {place})" if place else "") + (f"; {advice}" if advice else ""))
        self.message, self.place, self.advice = message, place, advice


@contextlib.contextmanager
def refusing() -> Iterator[None]:
    """Context manager that turns exceptions into UnsupportedError, since no rule foresees all that JAX can trace.

    It is only for code whose success depends on the compiled function alone: either every worker falls back to JAX or
    none does.
    """
    try:
        yield
    except (UnsupportedError, MemoryError):
        raise
    except Exception as error:
        raise UnsupportedError(fault(error)) from error


def fault(error: Exception) -> str:
    """Text of an exception that no rule foresaw: not a task that is not supported, but a fault of this compiler."""
    return f"a fault of es-service's compiler, please report it ({type(error).__name__}: {error})"
