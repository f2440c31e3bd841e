"""The error for functions that this compiler does not support; xla computes them instead."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


class UnsupportedError(Exception):
    """A function cannot be compiled; the message names the unsupported part and where it comes from."""

    def __init__(self, message: str, place: str = "") -> None:
        """`place` is the line of the task that has the unsupported part, if that is known."""
        super().__init__(f"{message} (at {place})" if place else message)
        self.place = place


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
