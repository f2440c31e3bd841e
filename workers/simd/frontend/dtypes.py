"""The JAX dtypes that are supported, and the dtypes of the graph nodes that represent them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from workers.simd.graph.unsupported import UnsupportedError, way_round


@functools.cache
def graph_dtype(dtype: Any) -> str:
    """Dtype of the graph nodes that represent values of a JAX dtype: "f", "i" or "b".

    float32, int32, uint32 and bool are supported. uint8, which JAX uses to count bits, is accepted as well;
    `check_bytes` ensures that it is only converted and moved.

    Raises:
        UnsupportedError: the dtype is any other.
    """
    match str(dtype):
        case "float32":
            return "f"
        case "int32" | "uint32" | "uint8":
            return "i"
        case "bool":
            return "b"
    advice = way_round("random_bits") if str(dtype).startswith("key<") else ""
    raise UnsupportedError(f"values of type {dtype}: simd supports float32, int32, uint32 and bool", advice=advice)


BYTES = {"convert_element_type", "population_count", "broadcast_in_dim", "reshape", "squeeze", "slice", "transpose",
         "concatenate", "stack", "copy", "jit"}  # fmt: skip
"""Primitives that may have uint8 inputs or outputs, because none of them can overflow."""


def check_bytes(equation: Any) -> None:
    """Raise UnsupportedError if an equation computes with uint8."""
    atoms = (*equation.invars, *equation.outvars)
    if equation.primitive.name not in BYTES and any(atom.aval.dtype == np.uint8 for atom in atoms):
        raise UnsupportedError(f"{equation.primitive.name} of uint8")


def dtype_in(equation: Any, position: int = 0) -> str:
    """Name of the JAX dtype of one input of an equation."""
    return str(equation.invars[position].aval.dtype)
