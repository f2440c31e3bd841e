"""Random slices, gathers and scatters, at indices that are constants or depend on data."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import lax

from tests.workers.simd.draws import LANES, Case, Draw, booleans, floats, integers, shape


def gather(draw: Draw) -> Case:
    of = shape(draw, least=1)
    axis = draw(st.integers(0, len(of) - 1))
    indices = np.array(draw(st.lists(st.integers(-of[axis] - 2, of[axis] + 1), min_size=1, max_size=5)))
    mode = draw(st.sampled_from(["clip", "fill", "wrap"]))
    make = draw(st.sampled_from([floats, integers, booleans]))
    return lambda x: jnp.take(x, indices, axis=axis, mode=mode), [make(draw, of)]


def gather_along(draw: Draw) -> Case:
    of = shape(draw, least=2)
    indices = np.random.default_rng(draw(st.integers(0, 99))).integers(0, of[-1], (*of[:-1], 2))
    return lambda x: jnp.take_along_axis(x, indices, axis=-1), [floats(draw, of)]


def scatter(draw: Draw) -> Case:
    of = shape(draw, least=1)
    indices = np.array(draw(st.lists(st.integers(-of[0] - 2, of[0] + 1), min_size=1, max_size=5, unique=True)))
    method = draw(st.sampled_from(["set", "add", "multiply"]))
    mode = draw(st.sampled_from(["drop", "clip"]))
    if method == "set":
        indices = np.array(sorted({int(np.clip(i % of[0], 0, of[0] - 1)) for i in indices}))  # order is not defined
    update = floats(draw, (len(indices), *of[1:]))
    return lambda x, u: getattr(x.at[indices], method)(u, mode=mode), [floats(draw, of), update]


def segment_sum(draw: Draw) -> Case:
    segments = np.array(draw(st.lists(st.integers(-1, 4), min_size=3, max_size=6)))
    return lambda x: jax.ops.segment_sum(x, segments, 4), [floats(draw, (len(segments), 2))]


def dynamic(draw: Draw) -> Case:
    start, value = draw(st.integers(-3, 9)), floats(draw, (2, 3))
    return (
        lambda x, u: (lax.dynamic_slice(x, (start, 0), (2, 2)), lax.dynamic_update_slice(x, u, (start, start))),
        [floats(draw, (5, 4)), value],
    )


def indices(draw: Draw, of: tuple[int, ...], size: int, dtype: str = "int32") -> np.ndarray:
    """Indices of an axis of `size` places, some of which lie before or behind it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return rng.integers(-size - 2, size + 2, (LANES, *of)).astype(np.int32).view(dtype)


def gather_by_data(draw: Draw) -> Case:
    of = shape(draw, least=1)
    axis, dtype = draw(st.integers(0, len(of) - 1)), draw(st.sampled_from(["int32", "uint32"]))
    mode, make = draw(st.sampled_from(["clip", "fill", "wrap"])), draw(st.sampled_from([floats, integers, booleans]))
    at = indices(draw, shape(draw, most=2), of[axis], dtype)
    return lambda x, at: jnp.take(x, at, axis=axis, mode=mode), [make(draw, of), at]


def places_by_data(draw: Draw) -> Case:
    of = tuple(draw(st.integers(2, 5)) for _ in range(3))
    make, dtype = draw(st.sampled_from([floats, integers, booleans])), draw(st.sampled_from(["int32", "uint32"]))
    sizes = [draw(st.integers(1, size)) for size in of]

    def function(x, at, rows):
        i, j, k = at
        return (
            x[i, :, k], x[1, j], x[0, i, 1], x[:, rows], x[rows, 0], x[rows[0], rows],
            lax.dynamic_slice(x, (i, j, k), sizes), lax.dynamic_slice(x, (i, at.dtype.type(1), k), sizes),
            jax.vmap(lambda table, row: lax.dynamic_slice(table, (row, j), (sizes[1], 1)))(x[:2], rows),
            jax.vmap(lambda table, row: table[row], (None, 0))(x, rows),
        )  # fmt: skip

    return function, [make(draw, of), indices(draw, (3,), min(of), dtype), indices(draw, (2,), min(of), dtype)]


def scatter_by_data(draw: Draw) -> Case:
    of = shape(draw, least=1, most=2)
    make = draw(st.sampled_from([floats, integers, lambda draw, of: integers(draw, of, "uint32")]))
    at = indices(draw, (draw(st.integers(1, 3)),), of[0], draw(st.sampled_from(["int32", "uint32"])))
    update, mode = make(draw, (at.shape[1], *of[1:])), draw(st.sampled_from(["drop", "clip"]))
    return lambda x, u, at: (
        x.at[at[0]].set(u[0], mode=mode),  # of several updates of one place, JAX may keep any
        *(getattr(x.at[at], how)(u, mode=mode) for how in ("add", "subtract", "multiply", "min", "max")),
    ), [make(draw, of), update, at]  # fmt: skip


def updates_by_data(draw: Draw) -> Case:
    of = tuple(draw(st.integers(2, 4)) for _ in range(3))
    make, dtype = draw(st.sampled_from([floats, integers, booleans])), draw(st.sampled_from(["int32", "uint32"]))
    sizes = tuple(draw(st.integers(1, size)) for size in of)

    def function(x, update, at, rows):
        i, j, k = at
        return (
            lax.dynamic_update_slice(x, update, (i, j, k)),
            lax.dynamic_update_slice(x, update, (at.dtype.type(1), j, k)),
            x.at[i, :, k].set(update[0, 0, 0]), x.at[1, j].set(update[0, 0, 0]), x.at[i, j, k].set(update[0, 0, 0]),
            x.at[:, j, 0].set(x[:, 0, 0]),
            jax.vmap(lambda table, row: lax.dynamic_update_slice(table, update[0], (row, j)))(x[:2], rows),
        )  # fmt: skip

    places = [indices(draw, (count,), min(of), dtype) for count in (3, 2)]
    return function, [make(draw, of), make(draw, sizes), *places]
