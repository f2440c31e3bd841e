"""AntTrap: an ant is rewarded for running along +x, straight into a trap that is open on the side of the start.

The numbers are those of the benchmark paper (Chalumeau et al. 2022) and of the QDax environment that it used: the
reward of Gym's ant with contact cost, observations with contact forces, and a trap 5 m wide and deep.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from workers.environments import SHIPPED, Environment
from workers.environments.ant import ant_in, observe
from workers.environments.ant_tasks import (
    BODIES,
    STEP_S,
    TRAP_BEYOND_X,
    TRAP_CONTACT_COST,
    TRAP_CONTROL_COST,
    TRAP_HEALTHY_Z,
    TRAP_START,
    TRAP_SURVIVAL_REWARD,
)

WALLS = SHIPPED["ant_trap"].walls or ()
DESCRIPTOR_BOUNDS = SHIPPED["ant_trap"].descriptor_bounds


def make(physics: str = "spring", contact_forces: str = "computed") -> Environment:
    """Functions of AntTrap.

    Args:
        physics: see `ant_in`.
        contact_forces: `computed`, as in Gym's ant and in the benchmark; or `zero` in observations and in the reward,
            as with mujoco-py and MuJoCo 2, which did not compute them.
    """
    ant = ant_in(physics, WALLS)

    def forces(state: Any) -> Any:
        return ant.contact_forces(state) if contact_forces == "computed" else jnp.zeros(6 * BODIES, jnp.float32)

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        new = ant.step(state, action)
        forward = (new.q[0] - state.q[0]) / STEP_S
        # The cost is that of the clipped action, as the motors apply it: noise beyond the limits has no effect or cost.
        control = TRAP_CONTROL_COST * jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2)
        contact = TRAP_CONTACT_COST * jnp.sum(forces(new) ** 2)
        done = (new.q[2] < TRAP_HEALTHY_Z[0]) | (new.q[2] > TRAP_HEALTHY_Z[1])
        return new, forward + TRAP_SURVIVAL_REWARD - control - contact, done

    def reset(key: Any) -> Any:
        return ant.reset(key, TRAP_START)

    def observe_all(state: Any) -> Any:
        return jnp.concatenate([_position(state), observe(state), forces(state)])

    return Environment(reset, observe_all, step, _descriptor, _no_goal, _beyond, ant.viewer)


def _position(state: Any) -> Any:
    (x_low, x_high), (_, y_high) = DESCRIPTOR_BOUNDS
    half = (x_high - x_low) / 2.0
    return jnp.stack([(state.q[0] - x_low - half) / half, state.q[1] / y_high])


def _descriptor(state: Any) -> Any:
    low, high = (jnp.array(side, jnp.float32) for side in zip(*DESCRIPTOR_BOUNDS, strict=True))
    return jnp.clip(state.q[:2], low, high)


def _beyond(state: Any, before: Any) -> Any:
    return before | (state.q[0] > TRAP_BEYOND_X)


def _no_goal(state: Any) -> Any:
    return jnp.float32(jnp.nan)
