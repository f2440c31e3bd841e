"""AntTrap: an ant is rewarded for running along +x, straight into a trap that is open on the side of the start.

The numbers are those of the benchmark paper (Chalumeau et al. 2022) and of the QDax environment that it used: the
reward of Gym's ant with contact cost, observations with contact forces, and a trap 5 m wide and deep.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from workers.environments import SHIPPED, Environment
from workers.environments.ant import STEP_S, AntState, ant_viewer, contact_forces, make_ant, observe

WALLS = SHIPPED["ant_trap"].walls or ()
DESCRIPTOR_BOUNDS = SHIPPED["ant_trap"].descriptor_bounds
START = (0.0, 0.0)
HEALTHY_Z = (0.2, 1.0)
"""Range of the torso's height, in metres; the episode ends outside of it."""
SURVIVAL_REWARD = 1.0
BEYOND_X = 20.0
"""x of the torso, in metres, beyond which an episode has succeeded."""
CONTROL_COST, CONTACT_COST = 0.5, 5e-4


def make() -> Environment:
    """Functions of AntTrap, which has no options."""
    ant = make_ant(WALLS)

    def step(state: AntState, action: Any) -> tuple[AntState, Any, Any]:
        new = ant.step(state, action)
        forward = (new.q[0] - state.q[0]) / STEP_S
        # The cost is that of the clipped action, as the motors apply it: noise beyond the limits has no effect or cost.
        control = CONTROL_COST * jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2)
        contact = CONTACT_COST * jnp.sum(contact_forces(new) ** 2)
        done = (new.q[2] < HEALTHY_Z[0]) | (new.q[2] > HEALTHY_Z[1])
        return new, forward + SURVIVAL_REWARD - control - contact, done

    def reset(key: Any) -> AntState:
        return ant.reset(key, START)

    return Environment(reset, _observe, step, _descriptor, _no_goal, _beyond, ant_viewer(ant.system))


def _observe(state: AntState) -> Any:
    (x_low, x_high), (_, y_high) = DESCRIPTOR_BOUNDS
    half = (x_high - x_low) / 2.0
    position = jnp.stack([(state.q[0] - x_low - half) / half, state.q[1] / y_high])
    return jnp.concatenate([position, observe(state), contact_forces(state)])


def _descriptor(state: AntState) -> Any:
    low, high = (jnp.array(side, jnp.float32) for side in zip(*DESCRIPTOR_BOUNDS, strict=True))
    return jnp.clip(state.q[:2], low, high)


def _beyond(state: AntState, before: Any) -> Any:
    return before | (state.q[0] > BEYOND_X)


def _no_goal(state: AntState) -> Any:
    return jnp.float32(jnp.nan)
