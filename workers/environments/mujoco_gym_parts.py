"""What Gymnasium's environments of MuJoCo are made of: states, and the functions that tell one from another. Those of
Humanoid-v5 and HumanoidStandup-v5 are here, the others in `mujoco_gym_tasks.py`.
"""

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


def humanoid(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.25,
    ctrl_cost_weight: float = 0.1,
    contact_cost_weight: float = 5e-7,
    contact_cost_range: Range = (-float("inf"), 10.0),
    healthy_reward: float = 5.0,
    terminate_when_unhealthy: bool = True,
    healthy_z_range: Range = (1.0, 2.0),
    reset_noise_scale: float = 1e-2,
    exclude_current_positions_from_observation: bool = True,
    include_cinert_in_observation: bool = True,
    include_cvel_in_observation: bool = True,
    include_qfrc_actuator_in_observation: bool = True,
    include_cfrc_ext_in_observation: bool = True,
) -> Parts:
    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        healthy = inside(after.physics.qpos[2], healthy_z_range)
        velocity = (after.seen.centre[0] - before.seen.centre[0]) / model.step_s
        impact = jnp.clip(contact_cost_weight * jnp.sum(after.seen.forces**2), *contact_cost_range)
        costs = ctrl_cost_weight * jnp.sum(action**2) + impact
        return forward_reward_weight * velocity + healthy * healthy_reward - costs, ~healthy & terminate_when_unhealthy

    observed = _Observed(
        not exclude_current_positions_from_observation,
        include_cinert_in_observation,
        include_cvel_in_observation,
        include_qfrc_actuator_in_observation,
        include_cfrc_ext_in_observation,
    )
    return _parts(model, reset_noise_scale, observed, outcome)


def humanoid_standup(
    model: Simulated,
    *,
    uph_cost_weight: float = 1,
    ctrl_cost_weight: float = 0.1,
    impact_cost_weight: float = 0.5e-6,
    impact_cost_range: Range = (-float("inf"), 10.0),
    reset_noise_scale: float = 1e-2,
    exclude_current_positions_from_observation: bool = True,
    include_cinert_in_observation: bool = True,
    include_cvel_in_observation: bool = True,
    include_qfrc_actuator_in_observation: bool = True,
    include_cfrc_ext_in_observation: bool = True,
) -> Parts:
    """HumanoidStandup-v5, which, as in Gymnasium, makes no use of `uph_cost_weight`."""

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        height = after.physics.qpos[2] / model.c.opt.timestep
        impact = jnp.clip(impact_cost_weight * jnp.sum(after.seen.forces**2), *impact_cost_range)
        return height - ctrl_cost_weight * jnp.sum(action**2) - impact + 1.0, jnp.bool_(False)

    observed = _Observed(
        not exclude_current_positions_from_observation,
        include_cinert_in_observation,
        include_cvel_in_observation,
        include_qfrc_actuator_in_observation,
        include_cfrc_ext_in_observation,
    )
    return _parts(model, reset_noise_scale, observed, outcome)


class _Observed(NamedTuple):
    """Which numbers of a humanoid an observation has, beside its posture and its velocities."""

    place: bool
    inertias: bool
    velocities_of_bodies: bool
    forces_of_actuators: bool
    forces_on_bodies: bool


class _Seen(NamedTuple):
    """What a humanoid observes of MuJoCo's data, by the names of C MuJoCo, and what it is rewarded for."""

    centre: Any
    """[2] centre of mass in the plane."""
    cinert: Any
    cvel: Any
    qfrc_actuator: Any
    forces: Any
    """[bodies, 6] `cfrc_ext`."""


def _parts(
    model: Simulated,
    scale: float,
    observed: _Observed,
    outcome: Callable[[GymState, GymState, Any], tuple[Any, Any]],
) -> Parts:
    """A humanoid whose resets have noise of a scale."""
    mass_B = jnp.asarray(model.c.body_mass, jnp.float32)

    def look(data: Any, stepped: bool) -> _Seen:
        centre = mass_B @ data.xipos[:, :2] / jnp.sum(mass_B)
        forces = body_forces(model, data, stepped)
        return _Seen(centre, data._impl.cinert, data.cvel, data.qfrc_actuator, forces)

    def observe(state: GymState) -> Any:
        (qpos, qvel, *_), seen, *_ = state
        of_data = seen.cinert[1:], seen.cvel[1:], seen.qfrc_actuator[6:], seen.forces[1:]
        chosen = [of.ravel() for is_observed, of in zip(observed[1:], of_data, strict=True) if is_observed]
        return jnp.concatenate([qpos[0 if observed.place else 2 :], qvel, *chosen])

    return Parts(noisy(model, scale), observe, outcome, look)
