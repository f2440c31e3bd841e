"""The operations of scalar graphs: their argument and result dtypes, their meaning in NumPy and their LLVM instruction.

There are three dtypes: "f" is float32, "i" a 32-bit integer (each operation decides whether it is signed) and "b" bool.
Every operation is one vector instruction, or nearly, and gives the same bits on every machine and at every width.
Division and roots are not approximated. Tangents, exponentials and the like are built from these operations in
`elementary.py`. Vector units do not divide integers, so LLVM divides lane by lane, except by constants.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


class Operation(NamedTuple):
    """An operation of scalar graphs; a row of OPERATIONS."""

    takes: str
    """Dtypes of the arguments, one letter each."""
    gives: str
    meaning: Callable[..., Any]
    """The operation in NumPy, which folds constants and which tests compare the machine code with."""
    llvm: str
    """The LLVM instruction, in which {0}, {1}, {2} are the arguments and {F}, {I}, {B} the vector types; or the name of
    the intrinsic to call, in which {N} and {M} are the type suffixes for floats and integers."""
    commutes: bool = False
    """Whether the arguments may be exchanged. Those of a sum of floats may not, because of two products the second is
    fused."""


def _fused(a: Any, b: Any, c: Any) -> Any:
    """a * b + c of floats: in float64 the product is exact and the sum is rounded to odd, so that rounding it again is
    rounding once."""
    product = np.asarray(a, np.float64) * np.asarray(b, np.float64)
    total = product + c
    away = total - product
    error = (product - (total - away)) + (c - away)  # exact: total + error == product + c
    bits = total.view(np.int64)
    inexact_and_even = np.isfinite(total) & (error != 0) & (bits & 1 == 0)
    toward = np.where((error > 0) == (total > 0), 1, -1)
    return np.where(inexact_and_even, (bits + toward).view(np.float64), total)


def _unsigned(x: Any) -> Any:
    return np.asarray(x, np.int32).view(np.uint32)


OPERATIONS: dict[str, Operation] = {
    "add": Operation("ff", "f", np.add, "fadd {F} {0}, {1}"),
    "sub": Operation("ff", "f", np.subtract, "fsub {F} {0}, {1}"),
    "mul": Operation("ff", "f", np.multiply, "fmul {F} {0}, {1}", commutes=True),
    "div": Operation("ff", "f", np.divide, "fdiv {F} {0}, {1}"),
    "fma": Operation("fff", "f", _fused, "llvm.fma.{N}"),
    "neg": Operation("f", "f", np.negative, "fneg {F} {0}"),
    "abs": Operation("f", "f", np.abs, "llvm.fabs.{N}"),
    "sqrt": Operation("f", "f", np.sqrt, "llvm.sqrt.{N}"),
    "floor": Operation("f", "f", np.floor, "llvm.floor.{N}"),
    "ceil": Operation("f", "f", np.ceil, "llvm.ceil.{N}"),
    "round": Operation("f", "f", np.rint, "llvm.roundeven.{N}"),
    # Comparisons with NaN are false, except `ne`.
    "eq": Operation("ff", "b", np.equal, "fcmp oeq {F} {0}, {1}", commutes=True),
    "ne": Operation("ff", "b", np.not_equal, "fcmp une {F} {0}, {1}", commutes=True),
    "lt": Operation("ff", "b", np.less, "fcmp olt {F} {0}, {1}"),
    "le": Operation("ff", "b", np.less_equal, "fcmp ole {F} {0}, {1}"),
    # Integers wrap around.
    "iadd": Operation("ii", "i", np.add, "add {I} {0}, {1}", commutes=True),
    "isub": Operation("ii", "i", np.subtract, "sub {I} {0}, {1}"),
    "imul": Operation("ii", "i", np.multiply, "mul {I} {0}, {1}", commutes=True),
    "iand": Operation("ii", "i", np.bitwise_and, "and {I} {0}, {1}", commutes=True),
    "ior": Operation("ii", "i", np.bitwise_or, "or {I} {0}, {1}", commutes=True),
    "ixor": Operation("ii", "i", np.bitwise_xor, "xor {I} {0}, {1}", commutes=True),
    # Integers are never divided by 0, nor the least integer by -1; elementary.py ensures this. Quotients are rounded
    # towards zero.
    "sdiv": Operation("ii", "i", lambda a, b: (a - np.fmod(a, b)) // b, "sdiv {I} {0}, {1}"),
    "srem": Operation("ii", "i", np.fmod, "srem {I} {0}, {1}"),
    "udiv": Operation("ii", "i", lambda a, b: (_unsigned(a) // _unsigned(b)).view(np.int32), "udiv {I} {0}, {1}"),
    "urem": Operation("ii", "i", lambda a, b: (_unsigned(a) % _unsigned(b)).view(np.int32), "urem {I} {0}, {1}"),
    # Shifts are by 0 to 31; the rules of the primitives ensure this.
    "shl": Operation("ii", "i", np.left_shift, "shl {I} {0}, {1}"),
    "lshr": Operation("ii", "i", lambda a, b: (_unsigned(a) >> _unsigned(b)).view(np.int32), "lshr {I} {0}, {1}"),
    "ashr": Operation("ii", "i", np.right_shift, "ashr {I} {0}, {1}"),
    "popcount": Operation("i", "i", lambda a: np.bitwise_count(_unsigned(a)).astype(np.int32), "llvm.ctpop.{M}"),
    "ieq": Operation("ii", "b", np.equal, "icmp eq {I} {0}, {1}", commutes=True),
    "slt": Operation("ii", "b", np.less, "icmp slt {I} {0}, {1}"),
    "ult": Operation("ii", "b", lambda a, b: _unsigned(a) < _unsigned(b), "icmp ult {I} {0}, {1}"),
    "float_of_int": Operation("i", "f", lambda a: np.asarray(a).astype(np.float32), "sitofp {I} {0} to {F}"),
    "float_of_uint": Operation("i", "f", lambda a: _unsigned(a).astype(np.float32), "uitofp {I} {0} to {F}"),
    # The argument is in the range of int32; elementary.py ensures this.
    "int_of_float": Operation("f", "i", lambda a: np.asarray(a).astype(np.int32), "fptosi {F} {0} to {I}"),
    "bits": Operation("f", "i", lambda a: np.asarray(a, np.float32).view(np.int32), "bitcast {F} {0} to {I}"),
    "unbits": Operation("i", "f", lambda a: np.asarray(a, np.int32).view(np.float32), "bitcast {I} {0} to {F}"),
    "int_of_bool": Operation("b", "i", lambda a: np.asarray(a).astype(np.int32), "zext {B} {0} to {I}"),
    "and": Operation("bb", "b", np.logical_and, "and {B} {0}, {1}", commutes=True),
    "or": Operation("bb", "b", np.logical_or, "or {B} {0}, {1}", commutes=True),
    "xor": Operation("bb", "b", np.logical_xor, "xor {B} {0}, {1}", commutes=True),
    "select": Operation("bff", "f", np.where, "select {B} {0}, {F} {1}, {F} {2}"),
    "iselect": Operation("bii", "i", np.where, "select {B} {0}, {I} {1}, {I} {2}"),
    "bselect": Operation("bbb", "b", np.where, "select {B} {0}, {B} {1}, {B} {2}"),
}
"""Operations by name. Products and sums are separate nodes; `schedule.py` fuses them by its rule."""

NUMPY_DTYPES = {"f": np.dtype(np.float32), "i": np.dtype(np.int32), "b": np.dtype(bool)}
BIT_MOVES = {"unbits", "bits", "neg", "abs", "select"}
"""Operations that pass floats through unchanged. All others replace denormal arguments and results by zeros."""
ROUNDED = {"mul", "div", "fma"}
"""Operations whose results may be both inexact and tiny. The reference implementation computes them in
float64 and rounds once."""
SMALLEST_NORMAL = 2.0**-126
LEAST_KEPT = 2.0**-126 - 2.0**-151
"""Least absolute value that is not a zero after rounding: what 24 bits round to 2^-126, as on x86-64. Processors of Arm
look before rounding, so what is below 2^-126 is a zero there."""


def compute(name: str, arguments: Sequence[Any]) -> Any:
    """Result of an operation, computed in NumPy with the same bits as in kernels."""
    operation = OPERATIONS[name]
    if name not in BIT_MOVES:
        arguments = [_flushed(x) if dtype == "f" else x for dtype, x in zip(operation.takes, arguments, strict=True)]
    with np.errstate(all="ignore"):
        if name in ROUNDED:
            exact = operation.meaning(*(np.asarray(x, np.float64) for x in arguments))
            return np.asarray(_flushed(exact, LEAST_KEPT), np.float32)
        result = np.asarray(operation.meaning(*arguments), NUMPY_DTYPES[operation.gives])
    return _flushed(result) if operation.gives == "f" and name not in BIT_MOVES else result


def _flushed(x: Any, least: float = SMALLEST_NORMAL) -> Any:
    """Floats with those below `least` replaced by zeros of the same sign; denormal numbers by default."""
    return x * (np.abs(x) >= least)
