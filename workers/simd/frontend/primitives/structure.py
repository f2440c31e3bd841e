"""Rules of primitives that only move values; they add nothing to the graph."""

from __future__ import annotations

from typing import Any

import numpy as np

from workers.simd.frontend.primitives.registry import PRIMITIVES, primitive
from workers.simd.frontend.tracer import Nodes, Tracer


@primitive("broadcast_in_dim")
def _broadcast_in_dim(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    shape = equation.params["shape"]
    with_ones = [1] * len(shape)
    for size, axis in zip(x.shape, equation.params["broadcast_dimensions"], strict=True):
        with_ones[axis] = size
    return np.broadcast_to(x.reshape(with_ones), shape)


@primitive("reshape", "squeeze")
def _reshape(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    return x.reshape(equation.outvars[0].aval.shape)


@primitive("copy", "stop_gradient", "optimization_barrier", "device_put")
def _same(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    return list(arrays)


@primitive("slice")
def _slice(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    starts, limits = equation.params["start_indices"], equation.params["limit_indices"]
    strides = equation.params["strides"] or [1] * len(starts)
    return x[tuple(slice(*bounds) for bounds in zip(starts, limits, strides, strict=True))]


PRIMITIVES.update(
    transpose=lambda t, equation, x: np.transpose(x, equation.params["permutation"]),
    rev=lambda t, equation, x: np.flip(x, equation.params["dimensions"]),
    concatenate=lambda t, equation, *arrays: np.concatenate(arrays, equation.params["dimension"]),
    stack=lambda t, equation, *arrays: np.stack(arrays, equation.params["axis"]),
    unstack=lambda t, equation, x: list(np.moveaxis(x, equation.params["axis"], 0)),
    tile=lambda t, equation, x: np.tile(x, equation.params["reps"]),
    split=lambda t, equation, x: np.split(x, np.cumsum(equation.params["sizes"])[:-1], equation.params["axis"]),
)


@primitive("iota")
def _iota(t: Tracer, equation: Any) -> Nodes:
    shape, axis = equation.params["shape"], equation.params["dimension"]
    along = np.arange(shape[axis]).astype(equation.params["dtype"])
    return t.constants(np.broadcast_to(np.expand_dims(along, [k for k in range(len(shape)) if k != axis]), shape))


@primitive("pad")
def _pad(t: Tracer, equation: Any, x: Nodes, value: Nodes) -> Nodes:
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        x = np.moveaxis(x, axis, 0)
        spread = np.full(((len(x) - 1) * (inner + 1) + 1 if len(x) else 0, *x.shape[1:]), value[()], np.int64)
        spread[:: inner + 1] = x
        edges = [np.full((max(0, width), *x.shape[1:]), value[()], np.int64) for width in (low, high)]
        spread = np.concatenate([edges[0], spread, edges[1]])
        x = np.moveaxis(spread[max(0, -low) : len(spread) - max(0, -high)], 0, axis)
    return x
