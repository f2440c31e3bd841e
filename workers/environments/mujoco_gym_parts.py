"""What Gymnasium's environments of MuJoCo are made of: states, and the functions that tell one from another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from es_service.protocol.noise import NORMAL_STD, normal_integers, uniforms
from workers.environments.mujoco_parts import MjModel, MujocoState, mjx, mujoco

Range = tuple[float, float]
"""(low, high)."""


class Simulated(NamedTuple):
    """A model, and what a control step of it is."""

    c: MjModel
    mx: mjx.Model
    frame_skip: int
    """Substeps of a control step."""
    step_s: float
    """Seconds of a control step."""

    def body(self, name: str) -> int:
        return mujoco.mj_name2id(self.c, mujoco.mjtObj.mjOBJ_BODY, name)


class Feet(NamedTuple):
    """What the descriptor `feet_contact` counts."""

    touched_F: Any
    """Number of control steps after which each foot touched the floor."""
    steps: Any
    """Number of control steps."""


class GymState(NamedTuple):
    """State of an environment of Gymnasium between two control steps."""

    physics: MujocoState
    seen: Any
    """What `look` of the task saw in the last computed substep, any pytree."""
    feet: Feet | None = None
    """None with descriptors that do not need it."""


class Parts(NamedTuple):
    """An environment of Gymnasium as functions."""

    start: Callable[[Any], tuple[Any, Any]]
    """Function from a stream key to the positions [nq] and velocities [nv] of a reset."""
    observe: Callable[[GymState], Any]
    """Function from a state to an observation [O]."""
    outcome: Callable[[GymState, GymState, Any], tuple[Any, Any]]
    """Function (state, state after a control step, action within the bounds of its actuators) -> (reward, done)."""
    look: Callable[[Any, bool], Any] = lambda data, stepped: ()
    """Function (data, whether a step or a reset has computed it) to what a state keeps of MuJoCo's data.

    Data after a step are those of the last forward computation in it: for RK4 its fourth, for Euler of the state before
    the last substep, while positions and velocities are already those after it. Gymnasium reads them so."""
    solves_reset: bool = False
    """Whether `look` reads accelerations or the constraints' forces after a reset, too."""


def noisy(model: Simulated, scale: float, *, normal: bool = False) -> Callable[[Any], tuple[Any, Any]]:
    """Resets near the model's own state: uniform noise on positions, uniform or normal noise on velocities."""
    nq, nv = model.c.nq, model.c.nv

    def start(key: Any) -> tuple[Any, Any]:
        if normal:
            noise_V = normal_integers(jnp, key, _counters(nq, nv)).astype(jnp.float32) / NORMAL_STD
        else:
            noise_V = 2.0 * uniforms_at(key, nq, nv) - 1.0
        return model.mx.qpos0 + scale * (2.0 * uniforms_at(key, 0, nq) - 1.0), scale * noise_V

    return start


def _counters(first: int, count: int) -> Any:
    return jnp.arange(first, first + count, dtype=jnp.uint32)


def uniforms_at(key: Any, first: int, count: int) -> Any:
    """Uniform variates in [0, 1) at coordinates from `first` on."""
    return uniforms(key, _counters(first, count))


def inside(x: Any, bounds: Range) -> Any:
    low, high = bounds
    return (low < x) & (x < high)


def body_forces(model: Simulated, data: Any, stepped: bool) -> Any:
    """[bodies, 6] forces of contacts on the bodies, C MuJoCo's `cfrc_ext`, which a reset of Gymnasium leaves at 0."""
    found: Any = mjx.rne_postconstraint(model.mx, data) if stepped else None
    return found._impl.cfrc_ext if stepped else jnp.zeros((model.c.nbody, 6))
