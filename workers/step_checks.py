"""What is examined of the methods of a task in JAX: whether they are pure, that is, whether they compute the same when
they are traced again, and for `es-service doctor` what a control step costs on one core, and how far it is from C
MuJoCo.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import TaskSpec
from es_service.protocol.noise import KEY_WORDS, Domain, stream_keys
from es_service.protocol.options import OptionValue
from es_service.protocol.user_code import raised
from workers.environments import Environment, TaskError, make_environment
from workers.simd.backend.target import NoVectorsError
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import jaxpr_digest
from workers.simd.graph.graph import UnsupportedError

LANES = 256
"""Environments side by side."""
STEPS = 40
"""Control steps with random actions, over which the states that are compared are spread."""


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
    found = {
        "reset": reset,
        "observe": traced(environment.observe, state)[0],
        "step": traced(environment.step, state, action)[0],
        "descriptor": traced(environment.descriptor, state)[0],
        "goal_distance": traced(environment.goal_distance, state)[0],
        "success": traced(environment.success, state, before)[0],
    }
    if environment.metrics is not None:
        found["metrics"] = traced(environment.metrics, state)[0]
    return found


@dataclass(frozen=True)
class StepCost:
    """Findings about a control step, with observation, reward and descriptor."""

    operations: int
    """Scalar operations of the code of our compiler, with each loop body counted once; 0 if XLA computes it."""
    code_bytes: int
    steps_per_second: float
    lowest_B: list[float]
    """Least and greatest values of the descriptor after the steps; NaN is left out."""
    greatest_B: list[float]
    from_c: dict[str, Any] = field(default_factory=dict)
    """Errors of the velocities relative to the greatest of them (`c_mujoco.quantiles`), `contacts`, the states in
    contact, and `ulp_p99`, C MuJoCo's own error if its state moves by one float32 ulp; empty without a model of
    MuJoCo."""


def step_cost(task: TaskSpec, options: Mapping[str, OptionValue], seconds: float) -> StepCost:
    """Compile a control step by our compiler, or else by XLA, try it, and compare it with C MuJoCo if it has a model.

    Args:
        seconds: how long it is measured.
    """
    environment = make_environment(task.name, options)

    def step(state: Any, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        after, reward, done = environment.step(state, action)
        return after, environment.descriptor(after), environment.observe(after), reward, done

    state = jax.jit(jax.vmap(environment.reset))(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(LANES)))
    state = jax.tree.map(np.asarray, state)
    operations = code_bytes = 0
    one = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32))
    action = jax.ShapeDtypeStruct((task.action_size,), jnp.float32)
    try:
        with tempfile.TemporaryDirectory() as folder:  # code from the cache has no number of operations
            run = compile_kernel(step, one, action, folder=Path(folder))
        operations, code_bytes = run.facts.computed, run.facts.code_bytes
    except (UnsupportedError, NoVectorsError):
        run = jax.jit(jax.vmap(step))
    rng = np.random.default_rng(0)
    actions_T_L_A = rng.uniform(-1.0, 1.0, (STEPS, LANES, task.action_size)).astype(np.float32)
    lowest_B, greatest_B = np.full((2, len(task.descriptor_names)), np.nan)
    before, after = jax.tree.map(np.copy, (state, state))
    for number, actions_L_A in enumerate(actions_T_L_A):
        new, descriptor_L_B, *_ = jax.tree.map(np.asarray, run(state, actions_L_A))
        lowest_B = np.fmin.reduce([lowest_B, *descriptor_L_B])
        greatest_B = np.fmax.reduce([greatest_B, *descriptor_L_B])
        seen = np.arange(LANES) % STEPS == number
        for kept, arrays in ((before, state), (after, new)):
            for to, of in zip(jax.tree.leaves(kept), jax.tree.leaves(arrays), strict=True):
                to[seen] = of[seen]
        state = new
    seen_actions_L_A = actions_T_L_A[np.arange(LANES) % STEPS, np.arange(LANES)]
    return StepCost(
        operations,
        code_bytes,
        round(_rate(lambda: jax.block_until_ready(run(state, actions_T_L_A[0])), seconds)),
        lowest_B.tolist(),
        greatest_B.tolist(),
        _from_c(environment, before, after, seen_actions_L_A),
    )


def _rate(call: Callable[[], object], seconds: float) -> float:
    """Control steps a second."""
    calls, started = 0, time.process_time()
    while not calls or time.process_time() - started < seconds:
        call()
        calls += 1
    return calls * LANES / max(time.process_time() - started, 1e-9)


def _from_c(environment: Environment, before: Any, after: Any, actions_L_A: np.ndarray) -> dict[str, Any]:
    if (of := environment.control_step) is None:
        return {}
    from workers.environments.c_mujoco import c_step, one_ulp, quantiles, relative_error

    ctrl = np.asarray(jax.vmap(of.ctrl)(actions_L_A))
    states = of.physics(before)
    right = c_step(of.model, of.substeps, states, ctrl)
    moved = c_step(of.model, of.substeps, one_ulp(states), ctrl)
    use = right.comparable() & moved.comparable() & np.isfinite(of.physics(after).qvel).all(axis=1)
    error, ulp = (relative_error(x.qvel, right.qvel)[use] for x in (of.physics(after), moved))
    return {**quantiles(error), "contacts": int((right.contacts[use] > 0).sum()), "ulp_p99": quantiles(ulp)["p99"]}
