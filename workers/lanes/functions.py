"""The functions of one lane, which simd compiles and xla maps over blocks of lanes: its reset and its step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from workers.environments import Environment


class Seen(NamedTuple):
    """Results of a reset or a step in each lane."""

    observation: Any
    """[N, O] float32, neither normalised nor clipped."""
    reward: Any
    """[N] float32; 0 after a reset."""
    done: Any
    """[N] bool: whether the task has ended the episode."""
    descriptor: Any
    """[N, B] float32, in the units of the task."""
    goal_distance: Any
    """[N] float32; NaN if the task has no goal."""
    success: Any
    """[N] bool: whether the episode would have succeeded if it ended here; False if the task does not say."""


class Carry(NamedTuple):
    """State of a lane."""

    state: Any
    success: Any


class LaneFunctions(NamedTuple):
    """The functions of one lane."""

    begin: Callable[[Any], tuple[Carry, Seen]]
    """Function of the stream key of a reset."""
    step: Callable[[Carry, Any], tuple[Carry, Seen]]
    """Function of a carry and an action [A]."""


def lane_functions(environment: Environment) -> LaneFunctions:
    """The functions of a lane of a task."""

    def carried(state: Any, before: Any) -> Carry:
        return Carry(state, jnp.asarray(environment.success(state, before), bool))

    def seen(carry: Carry, reward: Any, done: Any) -> Seen:
        return Seen(
            jnp.asarray(environment.observe(carry.state), jnp.float32),
            jnp.asarray(reward, jnp.float32),
            jnp.asarray(done, bool),
            jnp.asarray(environment.descriptor(carry.state), jnp.float32),
            jnp.asarray(environment.goal_distance(carry.state), jnp.float32),
            carry.success,
        )

    def begin(key: Any) -> tuple[Carry, Seen]:
        carry = carried(environment.reset(key), jnp.array(False))
        return carry, seen(carry, 0.0, False)

    def step(carry: Carry, action_A: Any) -> tuple[Carry, Seen]:
        state, reward, done = environment.step(carry.state, action_A)
        after = carried(state, carry.success)
        return after, seen(after, reward, done)

    return LaneFunctions(begin, step)
