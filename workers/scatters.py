"""Functions of JAX with sums in place of scatters that add, for GPUs.

With deterministic operations, XLA sorts what such a scatter adds, which takes most of the time of a step of Brax. It
also adds to another environment of the batch what JAX's index -1 should have dropped (seen with jaxlib 0.11.2 on an
H200): ants had forces of their neighbours. A sum over all updates, of which those of other rows count as 0, needs no
order and drops what it should. Other scatters get a place for what is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal
from jax.lax import GatherScatterMode

CALLS = ("jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat2")
"""Primitives that only call a function."""


def without_scatters(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with every scatter that adds whole rows, such as `segment_sum` and `x.at[index].add(row)`, as a sum
    of all rows; other scatters stay, with indices inside of what they change. The order of additions is XLA's, and so
    may be other bits."""

    def dense(*arguments: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        return jax.tree.unflatten(jax.tree.structure(shape), _evaluated(closed, jax.tree.leaves(arguments)))

    return dense


def _evaluated(closed: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    jaxpr = closed.jaxpr
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))

    def read(atom: Any) -> Any:
        aval: Any = atom.aval
        return jnp.asarray(atom.val, aval.dtype) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        outputs = _outputs(equation, [read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _outputs(equation: Any, inputs: list[Any]) -> Sequence[Any]:
    """Outputs of an equation; the jaxprs in it are evaluated in the same way."""
    name, params = equation.primitive.name, equation.params
    if name == "scatter-add" and _adds_rows(params["dimension_numbers"], *(atom.aval for atom in equation.invars)):
        return [_sum_of_rows(*inputs)]
    if name in CALLS:
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        return _evaluated(inner if hasattr(inner, "consts") else ClosedJaxpr(inner, ()), inputs)
    if name.startswith("scatter") and _drops(params):
        return [_with_a_place_for_the_dropped(equation, *inputs)]
    inner = {name: _without(value) for name, value in params.items() if _has_jaxprs(value)}  # of a loop or a branch
    outputs = equation.primitive.bind(*inputs, **params | inner)
    return outputs if equation.primitive.multiple_results else [outputs]


def _has_jaxprs(value: Any) -> bool:
    return isinstance(value, ClosedJaxpr) or (isinstance(value, tuple) and any(map(_has_jaxprs, value)))


def _without(value: Any) -> Any:
    """A jaxpr, or a tuple of some, that is evaluated in the same way."""
    if isinstance(value, tuple):
        return tuple(map(_without, value))
    like = [jax.ShapeDtypeStruct(variable.aval.shape, variable.aval.dtype) for variable in value.jaxpr.invars]
    return jax.make_jaxpr(lambda *inputs: _evaluated(value, inputs))(*like)


def _adds_rows(numbers: Any, operand: Any, indices: Any, updates: Any) -> bool:
    """Whether a scatter adds rows [K, ...] to the rows [N, ...] that K numbers name."""
    return (
        indices.ndim == 2
        and indices.shape[-1] == 1
        and tuple(numbers.inserted_window_dims) == (0,)
        and tuple(numbers.scatter_dims_to_operand_dims) == (0,)
        and not numbers.operand_batching_dims
        and tuple(numbers.update_window_dims) == tuple(range(1, operand.ndim))
        and updates.shape == (indices.shape[0], *operand.shape[1:])
    )


def _sum_of_rows(operand: Any, indices: Any, updates: Any) -> Any:
    is_row_N_K = indices[None, :, 0] == jnp.arange(operand.shape[0], dtype=indices.dtype)[:, None]
    is_row = is_row_N_K.reshape(*is_row_N_K.shape, *[1] * (operand.ndim - 1))
    return operand + jnp.where(is_row, updates[None], jnp.zeros((), updates.dtype)).sum(axis=1)


def _drops(params: dict[str, Any]) -> bool:
    """Whether a scatter drops updates by their indices, which name single places along their axes."""
    numbers = params["dimension_numbers"]
    inserted = set(numbers.inserted_window_dims)
    drops = params["mode"] == GatherScatterMode.FILL_OR_DROP
    return drops and set(numbers.scatter_dims_to_operand_dims) <= inserted and not numbers.operand_batching_dims


def _with_a_place_for_the_dropped(equation: Any, operand: Any, indices: Any, updates: Any) -> Any:
    """The scatter into an operand that is longer by one along each axis of the indices, for the dropped updates."""
    axes = equation.params["dimension_numbers"].scatter_dims_to_operand_dims
    sizes = jnp.asarray([operand.shape[axis] for axis in axes], indices.dtype)
    is_kept = ((indices >= 0) & (indices < sizes)).all(axis=-1, keepdims=True)
    longer = jnp.pad(operand, [(0, int(axis in axes)) for axis in range(operand.ndim)])
    scattered = equation.primitive.bind(longer, jnp.where(is_kept, indices, sizes), updates, **equation.params)
    return scattered[tuple(slice(size) for size in operand.shape)]
