"""The one error of this compiler that is not a fault: what it cannot compile, xla computes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


class UnsupportedError(Exception):
    """The function uses what this compiler cannot compile; the message names it and where it comes from."""


@contextlib.contextmanager
def refusing() -> Iterator[None]:
    """Whatever goes wrong in here is an UnsupportedError: no rule foresees everything that JAX can trace.

    Only for what depends on the function alone. Who may fall back to JAX must do so on every worker, or on none.
    """
    try:
        yield
    except (UnsupportedError, MemoryError):
        raise
    except Exception as error:
        raise UnsupportedError(f"{type(error).__name__}: {error}") from error
