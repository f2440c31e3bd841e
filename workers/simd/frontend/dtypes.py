"""JAX's types, and the kinds of nodes that stand for values of them."""

from __future__ import annotations

from typing import Any

from workers.simd.graph.unsupported import UnsupportedError


def graph_dtype(dtype: Any) -> str:
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
