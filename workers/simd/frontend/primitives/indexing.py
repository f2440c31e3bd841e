"""Rules of what only moves values, which add nothing to the graph, and of indices: slices, gathers and scatters, at
places that are constants or depend on data.

Along each axis, a constant index is a place, which costs nothing. One that depends on data is a choice: what is read is
selected among all places by the bits of the index, and what is written becomes, at each place, the update or what was
there. Comparisons of one index are shared by all words that it moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax import lax

from workers.simd.frontend.primitives.elementwise import extreme_of
from workers.simd.frontend.tracer import PRIMITIVES, Nodes, Tracer, dtype_in, graph_dtype, is_signed, primitive
from workers.simd.graph.graph import UnsupportedError, way_round


@primitive("broadcast_in_dim")
def _broadcast_in_dim(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    shape = equation.params["shape"]
    with_ones = [1] * len(shape)
    for size, axis in zip(x.shape, equation.params["broadcast_dimensions"], strict=True):
        with_ones[axis] = size
    return np.broadcast_to(x.reshape(with_ones), shape)


@primitive("reshape", "squeeze")
def _reshape(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    if equation.primitive.name == "reshape" and equation.params["dimensions"] is not None:  # in Fortran's order, say
        x = np.transpose(x, equation.params["dimensions"])
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


@primitive("empty")
def _empty(t: Tracer, equation: Any) -> Nodes:
    """Zeros, as on a processor, of what `jnp.empty` leaves open from JAX 0.12 on."""
    shape, dtype = equation.params["shape"], equation.params["dtype"]
    if graph_dtype(dtype) == "k":
        return t.keys(t.constants(np.zeros((*shape, 2), np.uint32)))
    return t.constants(np.zeros(shape, dtype))


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


MOST_CHOICES = 512
"""Most places among which indices that depend on data choose."""


class Corner(NamedTuple):
    """Where a window begins in an array."""

    nodes: Mapping[int, int]
    """Axis -> node of the index; it is 0 along other axes."""
    less: str
    """The operation that compares these indices: slt for int32, ult for uint32."""

    def constant(self, t: Tracer, axis: int) -> int | None:
        """Index along an axis, or None if it depends on data."""
        value = t.graph.constant(self.nodes[axis]) if axis in self.nodes else 0
        return value if value is None else int(value) % 2**32 if self.less == "ult" else int(value)


def _corner(equation: Any, position: int, nodes: Mapping[int, int]) -> Corner:
    """Corner at indices with the dtype of the equation's input at `position`."""
    return Corner(nodes, "slt" if is_signed(dtype_in(equation, position)) else "ult")


def _known(
    t: Tracer, equation: Any, x: Nodes, corner: Corner, sizes: Sequence[int]
) -> tuple[tuple[slice, ...], list[int], bool]:
    """What is known of the window of x that begins at a corner.

    Returns:
        (slices of x with the window, moved inside of x, along axes with constant indices; the axes whose indices depend
        on data; whether the window lies inside of x as far as indices are constant).

    Raises:
        UnsupportedError: the other indices choose among too many places.
    """
    at, chosen, inside = [slice(None)] * x.ndim, [], True
    for axis, size in enumerate(sizes):
        value = corner.constant(t, axis)
        if value is None:
            chosen.append(axis)
        else:
            start = min(max(value, 0), x.shape[axis] - size)
            at[axis] = slice(start, start + size)
            inside &= start == value
    places = math.prod(x.shape[axis] - sizes[axis] + 1 for axis in chosen)
    if places > MOST_CHOICES:
        name = equation.primitive.name
        raise UnsupportedError(
            f"{name} with indices that depend on the state, among {places:,} places (at most {MOST_CHOICES})",
            advice=way_round(name),
        )
    return tuple(at), chosen, inside


def _window(t: Tracer, equation: Any, x: Nodes, corner: Corner, sizes: Sequence[int], fills: bool) -> tuple[Nodes, int]:
    """(window of x that begins at a corner, bool node: whether it does not lie inside of x).

    A window that does not lie inside is moved inside; if `fills`, what it then contains does not matter.
    """
    at, chosen, is_inside = _known(t, equation, x, corner, sizes)
    g, window = t.graph, x[at]
    outside = g.const("b", not is_inside)
    for axis in chosen:
        index, last = corner.nodes[axis], x.shape[axis] - sizes[axis]
        outside = g.op("or", outside, g.op("ult", g.i(last), index))  # as uint32, a negative index is a great one
        inside = index if fills else _moved_inside(t, index, corner.less, last)
        rows = _rows_from(t, np.moveaxis(window, axis, 0), index, inside, corner.less, last)
        window = np.moveaxis(rows, 0, axis)
    return window, outside


def _moved_inside(t: Tracer, index: int, less: str, last: int) -> int:
    """Node of the number from 0 to `last` that is nearest to an index."""
    g = t.graph
    inside = g.op("iselect", g.op(less, g.i(last), index), g.i(last), index)
    return g.op("iselect", g.op("slt", inside, g.i(0)), g.i(0), inside) if less == "slt" else inside


def _rows_from(t: Tracer, rows: Nodes, index: int, inside: int, less: str, last: int) -> Nodes:
    """The rows that begin at an index from data, one of 0 to `last`: rows move by each bit of the index in turn.

    For a window of one row these are as many selects as there are other places, and for a longer one fewer than that
    for each of its rows. Few masks are needed at a time, since each takes a register.

    Args:
        index, inside: the index, and the same moved inside; the first alone tells the upper places from the lower.
    """
    g, size = t.graph, len(rows) - last
    highest = last.bit_length() - 1
    for bit in range(highest, -1, -1):
        step = 2**bit
        if bit == highest:
            mask = g.op(less, g.i(step - 1), index)
        else:
            mask = g.op("slt", g.op("shl", inside, g.i(31 - bit)), g.i(0))
        reached = size + step - 1  # rows that the remaining bits can reach
        here, ahead = rows[:reached], rows[step : step + reached]  # a row without one ahead does not change
        moved = t.map(lambda a, b, mask=mask: g.choose(mask, a, b), ahead, here[: len(ahead)])
        rows = np.concatenate([moved, here[len(ahead) :]])
    return rows[:size]


@primitive("dynamic_slice")
def _dynamic_slice(t: Tracer, equation: Any, x: Nodes, *starts: Nodes) -> Nodes:
    corner = _corner(equation, 1, {axis: int(start[()]) for axis, start in enumerate(starts)})
    return _window(t, equation, x, corner, equation.params["slice_sizes"], fills=False)[0]


@primitive("gather")
def _gather(t: Tracer, equation: Any, x: Nodes, indices: Nodes) -> Nodes:
    """Windows of an array; those that do not lie inside are filled or, depending on the mode, moved inside."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    fills = equation.params["mode"] == lax.GatherScatterMode.FILL_OR_DROP
    batch_shape = indices.shape[:-1]
    out_shape = equation.outvars[0].aval.shape
    batch_axes = [axis for axis in range(len(out_shape)) if axis not in numbers.offset_dims]
    batched = numbers.operand_batching_dims
    removed = (*numbers.collapsed_slice_dims, *batched)
    kept_sizes = [sizes[axis] for axis in range(x.ndim) if axis not in removed]
    gathered = np.empty([*batch_shape, *kept_sizes], np.int64)
    fill = _fill(t, equation) if fills else 0
    for place in np.ndindex(*batch_shape):
        nodes = dict(zip(numbers.start_index_map, indices[place].tolist(), strict=True))
        for axis, k in zip(batched, numbers.start_indices_batching_dims, strict=True):
            nodes[axis] = t.graph.i(place[k])
        window, outside = _window(t, equation, x, _corner(equation, 1, nodes), sizes, fills)
        if fills:
            window = t.map(lambda node, outside=outside: t.graph.choose(outside, fill, node), window)
        gathered[place] = window.reshape(kept_sizes)
    order = [*batch_axes, *numbers.offset_dims]
    return np.transpose(gathered, np.argsort(order)).reshape(out_shape)


def _fill(t: Tracer, equation: Any) -> int:
    """Node of the value that a gather gives outside of its operand.

    It is the primitive's fill value, or by dtype NaN, the least signed integer, the greatest unsigned one or true.
    """
    if graph_dtype(equation.outvars[0].aval.dtype) == "k":
        raise UnsupportedError("a gather of keys that may lie outside of their array")
    dtype, value = np.dtype(equation.outvars[0].aval.dtype), equation.params["fill_value"]
    if value is None:
        if dtype.kind in "iu":
            value = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
        else:
            value = np.nan if dtype.kind == "f" else True
    return int(t.constants(np.asarray(value).astype(dtype))[()])


Combine = Callable[[int, int], int]
"""Node of what an update makes of a word, of the nodes of the word and of the update."""


def _update(t: Tracer, equation: Any, x: Nodes, update: Nodes, corner: Corner, clips: bool, combine: Combine) -> None:
    """Update the window of x that begins at a corner, in place.

    Args:
        clips: whether a window that does not lie inside of x is moved inside; otherwise its update is dropped.
    """
    at, chosen, is_inside = _known(t, equation, x, corner, update.shape)
    if not update.size or (not is_inside and not clips):
        return
    g, here = t.graph, t.constants(np.array(True))
    for axis in chosen:
        last = x.shape[axis] - update.shape[axis]
        begins = [_begins(t, corner, axis, start, last, clips) for start in range(last + 1)]
        rows, inside = _spread(t, np.moveaxis(update, axis, 0), begins)
        update = np.moveaxis(rows, 0, axis)
        here = t.ops("and", here, inside.reshape([-1 if k == axis else 1 for k in range(x.ndim)]))
    x[at] = t.map(lambda mask, old, new: g.choose(mask, combine(old, new), old), here, x[at], update)


def _begins(t: Tracer, corner: Corner, axis: int, start: int, last: int, clips: bool) -> int:
    """Bool node: whether the window at an index from data begins at `start`, one of 0 to `last`."""
    g, index = t.graph, corner.nodes[axis]
    if not clips or 0 < start < last:
        return g.op("ieq", index, g.i(start))
    if last == 0:
        return g.const("b", True)
    return g.op(corner.less, index, g.i(1)) if start == 0 else g.op(corner.less, g.i(last - 1), index)


def _spread(t: Tracer, rows: Nodes, begins: Sequence[int]) -> tuple[Nodes, Nodes]:
    """Rows at each place where they may lie.

    Args:
        begins: for each place where the rows may begin, a bool node: whether they do.

    Returns:
        (for each place the row that lies there, bool nodes: whether one does).
    """
    g, spread, inside = t.graph, [], []
    for place in range(len(rows) + len(begins) - 1):
        first, *others = range(max(0, place - len(rows) + 1), min(place + 1, len(begins)))
        row, lies = rows[place - first], begins[first]
        for start in others:
            row = t.map(lambda a, b, mask=begins[start]: g.choose(mask, a, b), rows[place - start], row)
            lies = g.op("or", lies, begins[start])
        spread.append(row)
        inside.append(lies)
    return np.stack(spread), np.array(inside, np.int64)


@primitive("dynamic_update_slice")
def _dynamic_update_slice(t: Tracer, equation: Any, x: Nodes, update: Nodes, *starts: Nodes) -> Nodes:
    corner, updated = _corner(equation, 2, {axis: int(start[()]) for axis, start in enumerate(starts)}), x.copy()
    _update(t, equation, updated, update, corner, clips=True, combine=lambda old, new: new)
    return updated


@primitive("scatter", "scatter-add", "scatter-sub", "scatter-mul", "scatter-min", "scatter-max")
def _scatter(t: Tracer, equation: Any, x: Nodes, indices: Nodes, updates: Nodes) -> Nodes:
    """Operand with updates at indices, one after another: several of one place are combined in their order.

    Updates that do not lie inside of the operand, also by negative indices, are dropped or, with the mode CLIP, moved
    inside.
    """
    numbers, clips = equation.params["dimension_numbers"], equation.params["mode"] == lax.GatherScatterMode.CLIP
    window_axes = list(numbers.update_window_dims)
    batch_axes = [axis for axis in range(updates.ndim) if axis not in window_axes]
    rows = np.transpose(updates, [*batch_axes, *window_axes])
    batched = numbers.operand_batching_dims
    removed = (*numbers.inserted_window_dims, *batched)
    sizes = np.ones(x.ndim, np.int64)
    sizes[[axis for axis in range(x.ndim) if axis not in removed]] = [updates.shape[axis] for axis in window_axes]
    updated, combine = x.copy(), _combination(t, equation)
    for place in np.ndindex(*indices.shape[:-1]):
        nodes = dict(zip(numbers.scatter_dims_to_operand_dims, indices[place].tolist(), strict=True))
        for axis, k in zip(batched, numbers.scatter_indices_batching_dims, strict=True):
            nodes[axis] = t.graph.i(place[k])
        _update(t, equation, updated, rows[place].reshape(sizes), _corner(equation, 1, nodes), clips, combine)
    return updated


def _combination(t: Tracer, equation: Any) -> Combine:
    """How a scatter combines a word with an update."""
    how, dtype = equation.primitive.name.removeprefix("scatter").removeprefix("-"), dtype_in(equation)
    if not how:
        update = equation.params["update_jaxpr"]
        if update is not None and update.outvars[0] is not update.invars[1]:
            raise UnsupportedError("a function of single places, as by x.at[i].apply(f)")
        return lambda old, new: new
    if how in ("min", "max"):
        return extreme_of(t.graph, how, dtype)
    if graph_dtype(dtype) == "b":
        raise UnsupportedError(f"{equation.primitive.name} of bool")
    name = how if graph_dtype(dtype) == "f" else f"i{how}"
    return lambda old, new: t.graph.op(name, old, new)
