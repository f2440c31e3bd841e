"""The table of primitives, and what its rules share."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Nodes = NDArray[np.int64]
"""Numbers of nodes, in the shape of the array they stand for."""
Rule = Callable[..., Any]
PRIMITIVES: dict[str, Rule] = {}
"""Name of JAX's primitive -> its rule."""


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


def primitive(*names: str) -> Callable[[Rule], Rule]:
    """Enter a rule under the names of primitives."""

    def enter(rule: Rule) -> Rule:
        PRIMITIVES.update(dict.fromkeys(names, rule))
        return rule

    return enter


def kind_of(dtype: Any) -> str:
    """Kind of node that holds values of a dtype. Raises UnsupportedError for any but float32, int32, uint32 and bool.

    And uint8, in which JAX counts bits: `check_bytes` sees that it is only converted and moved.
    """
    match str(dtype):
        case "float32":
            return "f"
        case "int32" | "uint32" | "uint8":
            return "i"
        case "bool":
            return "b"
    raise UnsupportedError(f"values of type {dtype}: only float32, int32, uint32 and bool are compiled")


BYTES = {"convert_element_type", "population_count", "broadcast_in_dim", "reshape", "squeeze", "slice", "transpose",
         "concatenate", "stack", "copy", "jit"}  # fmt: skip
"""Primitives that may have uint8 in or out: nothing in them wraps around."""


def check_bytes(equation: Any) -> None:
    """Raise UnsupportedError for arithmetic of uint8."""
    dtypes = {str(atom.aval.dtype) for atom in (*equation.invars, *equation.outvars)}
    if "uint8" in dtypes and equation.primitive.name not in BYTES:
        raise UnsupportedError(f"{equation.primitive.name} of uint8")


def dtype_in(equation: Any, position: int = 0) -> str:
    """Name of the dtype of one of an equation's inputs."""
    return str(equation.invars[position].aval.dtype)
