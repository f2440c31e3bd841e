"""Rules of primitives that only move values; they add nothing to the graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax import lax

from workers.simd.frontend.dtypes import graph_dtype
from workers.simd.frontend.primitives.registry import PRIMITIVES, primitive
from workers.simd.frontend.tracer import Nodes, Tracer
from workers.simd.graph.unsupported import UnsupportedError, way_round


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


def _indices(t: Tracer, equation: Any, indices: Nodes, source: str) -> np.ndarray:
    """Values of indices, which must be constants."""
    values = t.values(indices)
    if values is None:
        name = equation.primitive.name
        raise UnsupportedError(f"{name} with indices that depend on the state", advice=way_round(name))
    return values.astype(np.int32).view(source).astype(np.int64)


@primitive("dynamic_slice")
def _dynamic_slice(t: Tracer, equation: Any, x: Nodes, *starts: Nodes) -> Nodes:
    sizes = equation.params["slice_sizes"]
    at = _dynamic_starts(t, equation, x, sizes, starts, 1)
    return x[tuple(slice(start, start + size) for start, size in zip(at, sizes, strict=True))]


@primitive("dynamic_update_slice")
def _dynamic_update_slice(t: Tracer, equation: Any, x: Nodes, update: Nodes, *starts: Nodes) -> Nodes:
    at = _dynamic_starts(t, equation, x, update.shape, starts, 2)
    updated = x.copy()
    updated[tuple(slice(start, start + size) for start, size in zip(at, update.shape, strict=True))] = update
    return updated


def _dynamic_starts(t: Tracer, equation: Any, x: Nodes, sizes: Any, starts: Any, first: int) -> list[int]:
    """Start of a window along each axis, moved so that the window lies inside of x."""
    at = []
    for axis, start in enumerate(starts):
        value = int(_indices(t, equation, start, str(equation.invars[first + axis].aval.dtype)))
        at.append(min(max(value, 0), x.shape[axis] - sizes[axis]))
    return at


@primitive("gather")
def _gather(t: Tracer, equation: Any, x: Nodes, indices: Nodes) -> Nodes:
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    mode = equation.params["mode"]
    starts = _indices(t, equation, indices, str(equation.invars[1].aval.dtype))
    batch_shape = starts.shape[:-1]
    out_shape = equation.outvars[0].aval.shape
    batch_axes = [axis for axis in range(len(out_shape)) if axis not in numbers.offset_dims]
    batched = numbers.operand_batching_dims
    removed = (*numbers.collapsed_slice_dims, *batched)
    kept = [axis for axis in range(x.ndim) if axis not in removed]
    gathered = np.empty([*batch_shape, *(sizes[axis] for axis in kept)], np.int64)
    for place in np.ndindex(*batch_shape):
        batch = {axis: place[k] for axis, k in zip(batched, numbers.start_indices_batching_dims, strict=True)}
        corner = dict(zip(numbers.start_index_map, starts[place], strict=True)) | batch
        window = _window(x, corner, sizes, mode)
        gathered[place] = _fill(t, equation) if window is None else x[window].reshape([sizes[axis] for axis in kept])
    order = [*batch_axes, *numbers.offset_dims]
    return np.transpose(gathered, np.argsort(order)).reshape(out_shape)


def _window(x: Nodes, corner: dict[int, int], sizes: Any, mode: Any) -> tuple[slice, ...] | None:
    """The window of x that begins at a corner (axis -> index, 0 for other axes).

    A window that does not lie wholly inside of x is moved inside; with the mode FILL_OR_DROP, None is returned instead.
    """
    at = np.array([corner.get(axis, 0) for axis in range(x.ndim)], np.int64)
    most = np.array(x.shape, np.int64) - np.array(sizes, np.int64)
    if ((at < 0) | (at > most)).any() and mode == lax.GatherScatterMode.FILL_OR_DROP:
        return None
    at = np.clip(at, 0, most)
    return tuple(slice(start, start + size) for start, size in zip(at, sizes, strict=True))


def _fill(t: Tracer, equation: Any) -> int:
    """Node of the value that a gather gives outside of its operand.

    It is the primitive's fill value, or by dtype NaN, the least int32, the greatest uint32 or true.
    """
    dtype, value = np.dtype(equation.outvars[0].aval.dtype), equation.params["fill_value"]
    if value is None:
        value = {"float32": np.nan, "int32": -(2**31), "uint32": 2**32 - 1, "bool": True}[str(dtype)]
    return int(t.constants(np.asarray(value).astype(dtype))[()])


@primitive("scatter", "scatter-add", "scatter-mul")
def _scatter(t: Tracer, equation: Any, x: Nodes, indices: Nodes, updates: Nodes) -> Nodes:
    """Operand with updates at indices.

    Updates outside of the operand, also by negative indices, are dropped or, depending on the mode, moved inside.
    """
    numbers, mode = equation.params["dimension_numbers"], equation.params["mode"]
    starts = _indices(t, equation, indices, str(equation.invars[1].aval.dtype))
    is_float = graph_dtype(equation.invars[0].aval.dtype) == "f"
    name = {"scatter": None, "scatter-add": "add", "scatter-mul": "mul"}[equation.primitive.name]
    name = name if is_float or name is None else f"i{name}"
    window_axes = list(numbers.update_window_dims)
    batch_axes = [axis for axis in range(updates.ndim) if axis not in window_axes]
    rows = np.transpose(updates, [*batch_axes, *window_axes])
    batched = numbers.operand_batching_dims
    removed = (*numbers.inserted_window_dims, *batched)
    kept = [axis for axis in range(x.ndim) if axis not in removed]
    sizes = np.ones(x.ndim, np.int64)
    sizes[kept] = [updates.shape[axis] for axis in window_axes]
    updated = x.copy()
    for place in np.ndindex(*starts.shape[:-1]):
        batch = {axis: place[k] for axis, k in zip(batched, numbers.scatter_indices_batching_dims, strict=True)}
        corner = dict(zip(numbers.scatter_dims_to_operand_dims, starts[place], strict=True)) | batch
        window = _window(x, corner, sizes, mode)
        if window is None:
            continue
        update = rows[place].reshape(sizes)
        updated[window] = update if name is None else t.ops(name, updated[window], update)
    return updated
