"""The JAX dtypes that are supported, and the dtypes of the graph nodes that represent them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from workers.simd.graph.unsupported import UnsupportedError, way_round


@functools.cache
def graph_dtype(dtype: Any) -> str:
    """Dtype of the graph nodes that represent values of a JAX dtype: "f", "i", "b" or, of JAX's threefry keys, "k".

    Integers of 8 and 16 bits are 32-bit integers of the same value; see `overflows`.

    Raises:
        UnsupportedError: the dtype is any other.
    """
    match str(dtype):
        case "float32":
            return "f"
        case "int32" | "uint32" | "int16" | "uint16" | "int8" | "uint8":
            return "i"
        case "bool":
            return "b"
        case "key<fry>":
            return "k"
    advice = way_round("random_bits") if str(dtype).startswith("key<") else ""
    raise UnsupportedError(
        f"values of type {dtype}: simd supports float32, integers of 8, 16 and 32 bits, bool and threefry keys",
        advice=advice,
    )


def is_signed(dtype: str) -> bool:
    """Whether integers of a JAX dtype may be negative."""
    return dtype.startswith("int")


def bits_of(dtype: str) -> int:
    """Number of bits of an integer dtype."""
    return 8 * np.dtype(dtype).itemsize


NARROW = {"int8", "int16", "uint8", "uint16"}
MOVES = {"broadcast_in_dim", "reshape", "squeeze", "slice", "transpose", "concatenate", "stack", "unstack", "copy",
         "select_n", "gather", "dynamic_slice", "dynamic_update_slice", "scatter", "jit", "while", "scan", "cond",
         "random_bits"}  # fmt: skip
"""Primitives that only move or choose integers, or whose parts reduce them."""


def overflows(equation: Any) -> list[str]:
    """For each output of an equation, the dtype of 8 or 16 bits to whose range it must be reduced, or ""."""
    moves = equation.primitive.name in MOVES
    dtypes = [str(variable.aval.dtype) for variable in equation.outvars]
    return ["" if moves or dtype not in NARROW else dtype for dtype in dtypes]


def dtype_in(equation: Any, position: int = 0) -> str:
    """Name of the JAX dtype of one input of an equation."""
    return str(equation.invars[position].aval.dtype)
