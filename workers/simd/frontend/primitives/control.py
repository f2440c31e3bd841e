"""Rules of calls, branches and loops."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from workers.simd.frontend.primitives.elementwise import select
from workers.simd.frontend.tracer import Nodes, Tracer, dtype_in, primitive
from workers.simd.graph.graph import UnsupportedError

MOST_TRIPS = 10_000
"""Most trips of a while loop, or of a scan with inputs or outputs per step; both become straight code."""


@primitive("jit", "custom_jvp_call", "custom_vjp_call", "remat2")
def _call(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
    return t.closed(inner, arrays) if hasattr(inner, "consts") else t.jaxpr(inner, [], arrays)


@primitive("platform_index")
def _platform_index(t: Tracer, equation: Any) -> Nodes:
    """Number of the branch for CPUs: the first branch that names them or that names no platform."""
    for number, platforms in enumerate(equation.params["platforms"]):
        if platforms is None or "cpu" in platforms:
            return t.constants(np.int32(number))
    raise UnsupportedError("a choice by platform without a branch for CPUs")


@primitive("cond")
def _cond(t: Tracer, equation: Any, which: Nodes, *arrays: Nodes) -> list[Nodes]:
    """Results of the chosen branch. If the choice is no constant, all branches are computed and then chosen from.

    Loops of a branch make no trips for lanes that take another one.
    """
    branches, value = equation.params["branches"], t.values(which)
    if value is not None:
        return t.closed(branches[min(max(int(value), 0), len(branches) - 1)], arrays)
    cases = []
    for number, branch in enumerate(branches):
        taken = [t.constants(np.bool_(k == number)) for k in range(len(branches))]
        with t.within(int(select(t, dtype_in(equation), which, [[case] for case in taken])[0][()])):
            cases.append(t.closed(branch, arrays))
    return select(t, dtype_in(equation), which, cases)


@primitive("scan")
def _scan(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    """Results of a scan: a loop if it is long and has no inputs or outputs per step, else straight code."""
    params = equation.params
    (constants, carries), length = _counts(params), params["length"]
    shared, carry, rows = (
        arrays[:constants],
        list(arrays[constants : constants + carries]),
        arrays[constants + carries :],
    )
    body = params["jaxpr"]
    if not rows and len(equation.outvars) == carries and length > 0:
        return t.keep_loop(length, lambda carry: t.closed(body, [*shared, *carry]), carry)
    if length > MOST_TRIPS:
        raise UnsupportedError(
            f"a scan of {length:,} steps with inputs or outputs per step; at most {MOST_TRIPS:,} steps are supported"
        )
    stacked: list[list[Nodes]] = [[] for _ in range(len(equation.outvars) - carries)]
    order = reversed(range(length)) if params["reverse"] else range(length)
    for trip in order:
        outputs = t.closed(body, [*shared, *carry, *(row[trip] for row in rows)])
        carry = outputs[:carries]
        for kept, output in zip(stacked, outputs[carries:], strict=True):
            kept.append(output)
    results = []
    for kept, variable in zip(stacked, equation.outvars[carries:], strict=True):
        kept = kept[::-1] if params["reverse"] else kept
        results.append(np.stack(kept) if kept else np.zeros(variable.aval.shape, np.int64))
    return [*carry, *results]


def _counts(params: dict[str, Any]) -> tuple[int, int]:
    """Numbers of arrays of a scan that all trips share, and that they carry."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    shared, carry, _ = params["ft_in"].unpack()  # from JAX 0.11 on
    return len(shared), len(carry)


@primitive("while")
def _while(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    """Results of a while loop: straight code if the number of trips is known while tracing.

    Under vmap, the condition has an element for each element of the carries' leading axes, as in JAX's lowering of it:
    the loop goes on while any is true, and where one is false its carries stay as they are.
    """
    params = equation.params
    in_condition, in_body = params["cond_nconsts"], params["body_nconsts"]
    for_condition, for_body = arrays[:in_condition], arrays[in_condition : in_condition + in_body]
    starts = list(arrays[in_condition + in_body :])

    def elements(carry: list[Nodes]) -> Nodes:
        return t.closed(params["cond_jaxpr"], [*for_condition, *carry])[0]

    def condition(carry: list[Nodes]) -> Nodes:
        going, none = elements(carry).reshape(-1).tolist(), int(t.constants(np.bool_(False))[()])
        return np.array(functools.reduce(functools.partial(t.graph.op, "or"), going, none))

    def body(carry: list[Nodes]) -> list[Nodes]:
        going, after = elements(carry), t.closed(params["body_jaxpr"], [*for_body, *carry])
        if not going.shape:
            return after
        masks = [going.reshape(*going.shape, *[1] * (new.ndim - going.ndim)) for new in after]
        return [t.map(t.graph.choose, mask, new, old) for mask, new, old in zip(masks, after, carry, strict=True)]

    carry = starts
    for _ in range(MOST_TRIPS):
        value = t.values(condition(carry))
        if value is None:
            return t.keep_while(condition, body, starts)
        if not value:
            return carry
        carry = body(carry)
    raise UnsupportedError(f"a while loop of more than {MOST_TRIPS:,} trips, the most that is supported")
