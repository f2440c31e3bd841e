"""Whether the methods of a task in JAX are pure: traced again, also in another object, they compute the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue
from es_service.protocol.user_code import raised
from workers.environments import Environment, TaskError, make_environment
from workers.simd.frontend.trace import jaxpr_digest
from workers.simd.graph.graph import UnsupportedError


def require_pure(task: TaskSpec, options: Mapping[str, OptionValue]) -> None:
    """Raise TaskError if a method of a task in JAX computes something else when it is traced again.

    Each worker traces the methods, some of them several times, so that such a task would not be the same everywhere:
    what Python computes in a method, such as a number of `np.random` or a count in `self`, is a constant of the trace.
    For a process of its own, whose compiled functions are forgotten, since JAX traces a function under `jax.jit` once.
    """
    environment = make_environment(task.name, options)
    first = _digests(environment, task)
    try:
        again = {"": _digests(environment, task)}
        jax.clear_caches()
        again[" in another object"] = _digests(make_environment(task.name, options), task)
    except Exception as error:  # the user's code can raise anything, such as for what it stored in the first trace
        raise TaskError(f"{task.name} cannot be traced by JAX again: {raised(error, task.name)}") from error
    for where, digests in again.items():
        if changed := [name for name, digest in first.items() if digest != digests[name]]:
            raise TaskError(
                f"{task.name}: {changed[0]} is not a pure function, since it computes something else when JAX traces "
                f"it again{where}, as each worker does; make random numbers from the key of reset, and put whatever "
                "changes into the state"
            )


def _digests(environment: Environment, task: TaskSpec) -> dict[str, str]:
    """Hash of what each method computes, as it is traced now; empty if the trace has no hash."""

    def traced(method: Callable[..., Any], *arguments: Any) -> tuple[str, Any]:
        # JAX stores traces by function, and this lambda is a new one.
        jaxpr, result = jax.make_jaxpr(lambda *given: method(*given), return_shape=True)(*arguments)
        try:
            return jaxpr_digest(jaxpr), result
        except UnsupportedError:
            return "", result

    reset, state = traced(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
    action, before = jax.ShapeDtypeStruct((task.action_size,), jnp.float32), jax.ShapeDtypeStruct((), bool)
    return {
        "reset": reset,
        "observe": traced(environment.observe, state)[0],
        "step": traced(environment.step, state, action)[0],
        "descriptor": traced(environment.descriptor, state)[0],
        "goal_distance": traced(environment.goal_distance, state)[0],
        "success": traced(environment.success, state, before)[0],
    }
