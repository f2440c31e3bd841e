"""Compiled resets and steps that all tests of a task share: XLA needs many seconds for those of an ant.

simd compiles those of an ant in less time than XLA, and computes them a hundred times as fast (`kernel_of`); XLA's are
for tests that compare the two (`steps_of`).

A step is compiled for LANES states at a time, whatever the number of states that a test has, so that processes of the
tests find each other's code in the cache, and one process does not even trace a function again. Resets only make states
to start from, so simd compiles them, which takes half a second; JAX would need three for those of an ant, and eight to
compute them operation by operation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from workers.environments import SHIPPED, Environment, make_environment
from workers.environments.ant import AntState, expand, load_system, physics_step
from workers.environments.brax_task import pipeline
from workers.environments.walls import wall_rows
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.graph.graph import UnsupportedError

LANES = 64
Step = Callable[[Any, Any], Any]


def of_many(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one state as one of any number of states, in NumPy arrays; it is compiled once, for LANES."""
    compiled = jax.jit(jax.vmap(function))

    def run(*arguments: Any) -> Any:
        count = len(jax.tree.leaves(arguments)[0])
        rows = np.arange(-(-count // LANES) * LANES).reshape(-1, LANES) % count
        parts = [compiled(*jax.tree.map(lambda x, row=row: np.asarray(x)[row], arguments)) for row in rows]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)

    return run


environment_of = cache(lambda task: make_environment(task, {}))


def control_step(environment: Environment) -> Step:
    """All that one control step gives: state, reward, done, observation, descriptor, distance to the goal."""

    def step(state: Any, action: Any) -> Any:
        after, reward, done = environment.step(state, action)
        distance = jnp.nan_to_num(environment.goal_distance(after))  # tasks without a goal have NaN
        return after, reward, done, environment.observe(after), environment.descriptor(after), distance

    return step


@cache
def resets_of(task: str) -> Callable[[Any], Any]:
    """Reset of a task: keys [N, 4] -> states."""
    return _reset(environment_of(task).reset)


def _reset(reset: Callable[[Any], Any]) -> Callable[[Any], Any]:
    try:
        return compile_kernel(reset, jax.ShapeDtypeStruct((4,), np.uint32))
    except UnsupportedError:  # random numbers of JAX
        return of_many(reset)


@cache
def steps_of(task: str) -> Step:
    """Control step of a task: states and actions [N, A] -> what `control_step` gives."""
    return of_many(control_step(environment_of(task)))


@cache
def kernel_of(task: str) -> Step:
    """The same, by simd."""
    environment, count = environment_of(task), SHIPPED[task].action_size
    state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), np.uint32))
    return compile_kernel(control_step(environment), state, jax.ShapeDtypeStruct((count,), np.float32))


@cache
def substeps_of(task: str) -> Step:
    """Substep of an ant among the walls of a task: Brax's whole states and actions -> such states, and impulses."""
    return of_many(substep(task))


def substep(task: str) -> Step:
    system, walls = system_of(task), SHIPPED[task].walls
    rows = wall_rows(walls) if walls else None
    return lambda state, action: physics_step(system, state, action, rows)


@cache
def brax_substeps() -> Step:
    """Brax's own substep, which knows no walls."""
    system = load_system(())
    return of_many(lambda state, action: pipeline.step(system, state, action))


system_of = cache(lambda task: load_system(SHIPPED[task].walls or ()))


@cache
def _whole() -> Callable[[AntState], Any]:
    system = load_system(())
    return of_many(lambda state: expand(system, state))


def whole(state: AntState) -> Any:
    """Brax's states of ants."""
    return _whole()(state)


def carried(state: AntState, way: np.ndarray) -> AntState:
    """Ants carried along ways [N, 2 or 3], in metres."""
    way = np.asarray(way, np.float32)
    q, position = np.array(state.q), np.array(state.centre.pos)
    q[:, : way.shape[1]] += way
    position[:, :, : way.shape[1]] += way[:, None]
    return state._replace(q=q, centre=state.centre.replace(pos=position))


def pushed(state: AntState, change: np.ndarray) -> AntState:
    """Ants whose links' velocities are changed by [N, 3] or [3], in metres per second."""
    velocity = np.asarray(state.motion.vel) + np.asarray(change, np.float32).reshape(-1, 1, 3)
    return state._replace(motion=state.motion.replace(vel=velocity))
