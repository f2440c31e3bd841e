"""Humanoid-v5 and HumanoidStandup-v5 of Gymnasium, as functions; see `mujoco_gym_tasks.py`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from workers.environments.mujoco_gym_parts import GymState, Parts, Range, Simulated, body_forces, inside, noisy


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
