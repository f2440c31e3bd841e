"""What Gymnasium's environments of MuJoCo begin with, observe, reward and end with, version 5: a function for each.

Names and defaults of options are Gymnasium's, whose classes these functions repeat; a test compares both. `TASKS` has
the file of the model and the frame skip of each, and `mujoco_gym.py` makes tasks of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from workers.environments import TaskError
from workers.environments.mujoco_contacts import AT_ONCE
from workers.environments.mujoco_gym_parts import (
    GymState,
    Parts,
    Range,
    Simulated,
    body_forces,
    humanoid,
    humanoid_standup,
    inside,
    noisy,
    uniforms_at,
)


class GymTask(NamedTuple):
    file: str
    """Name of the model's file in Gymnasium's package."""
    frame_skip: int
    parts: Callable[..., Parts]
    """Function from a `Simulated` and options, by name."""
    episode_steps: int = 1000
    at_once: tuple[int, ...] = AT_ONCE
    """Contacts that are solved at once; see `mujoco_contacts.solve`."""


def _ant(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.0,
    ctrl_cost_weight: float = 0.5,
    contact_cost_weight: float = 5e-4,
    healthy_reward: float = 1.0,
    main_body: int = 1,
    terminate_when_unhealthy: bool = True,
    healthy_z_range: Range = (0.2, 1.0),
    contact_force_range: Range = (-1.0, 1.0),
    reset_noise_scale: float = 0.1,
    exclude_current_positions_from_observation: bool = True,
    include_cfrc_ext_in_observation: bool = True,
) -> Parts:
    if not 0 < main_body < model.c.nbody:
        allowed = f"1 to {model.c.nbody - 1}, the bodies of the model"
        raise TaskError(f"task.options.main_body = {main_body} is not allowed; must be {allowed}")

    def look(data: Any, stepped: bool) -> Any:
        """Place of the main body, and forces on the bodies."""
        forces = body_forces(model, data, stepped)
        return data.xpos[main_body, :2], jnp.clip(forces, *contact_force_range)

    def observe(state: GymState) -> Any:
        (qpos, qvel, *_), (_, forces), *_ = state
        place = 2 if exclude_current_positions_from_observation else 0
        return jnp.concatenate([qpos[place:], qvel, *([forces[1:].ravel()] if include_cfrc_ext_in_observation else [])])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        (place, _), (place_after, forces) = before.seen, after.seen
        qpos, qvel = after.physics[:2]
        low, high = healthy_z_range
        healthy = jnp.isfinite(qpos).all() & jnp.isfinite(qvel).all() & (qpos[2] >= low) & (qpos[2] <= high)
        velocity = (place_after[0] - place[0]) / model.step_s
        reward = forward_reward_weight * velocity + healthy * healthy_reward
        costs = ctrl_cost_weight * jnp.sum(action**2) + contact_cost_weight * jnp.sum(forces**2)
        return reward - costs, ~healthy & terminate_when_unhealthy

    return Parts(noisy(model, reset_noise_scale, normal=True), observe, outcome, look)


def _half_cheetah(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.0,
    ctrl_cost_weight: float = 0.1,
    reset_noise_scale: float = 0.1,
    exclude_current_positions_from_observation: bool = True,
) -> Parts:
    start = noisy(model, reset_noise_scale, normal=True)
    hidden = 1 if exclude_current_positions_from_observation else 0
    return _runner(model, start, hidden, forward_reward_weight, ctrl_cost_weight)


def _swimmer(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.0,
    ctrl_cost_weight: float = 1e-4,
    reset_noise_scale: float = 0.1,
    exclude_current_positions_from_observation: bool = True,
) -> Parts:
    start = noisy(model, reset_noise_scale)
    hidden = 2 if exclude_current_positions_from_observation else 0
    return _runner(model, start, hidden, forward_reward_weight, ctrl_cost_weight)


def _hopper(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.0,
    ctrl_cost_weight: float = 1e-3,
    healthy_reward: float = 1.0,
    terminate_when_unhealthy: bool = True,
    healthy_state_range: Range = (-100.0, 100.0),
    healthy_z_range: Range = (0.7, float("inf")),
    healthy_angle_range: Range = (-0.2, 0.2),
    reset_noise_scale: float = 5e-3,
    exclude_current_positions_from_observation: bool = True,
) -> Parts:
    def healthy(qpos: Any, qvel: Any) -> Any:
        others = jnp.concatenate([qpos[2:], qvel])
        upright = inside(qpos[1], healthy_z_range) & inside(qpos[2], healthy_angle_range)
        return upright & inside(others, healthy_state_range).all()

    start = noisy(model, reset_noise_scale)
    hidden = 1 if exclude_current_positions_from_observation else 0
    health = _Health(healthy, healthy_reward, terminate_when_unhealthy)
    return _runner(model, start, hidden, forward_reward_weight, ctrl_cost_weight, health, 10.0)


def _walker2d(
    model: Simulated,
    *,
    forward_reward_weight: float = 1.0,
    ctrl_cost_weight: float = 1e-3,
    healthy_reward: float = 1.0,
    terminate_when_unhealthy: bool = True,
    healthy_z_range: Range = (0.8, 2.0),
    healthy_angle_range: Range = (-1.0, 1.0),
    reset_noise_scale: float = 5e-3,
    exclude_current_positions_from_observation: bool = True,
) -> Parts:
    def healthy(qpos: Any, qvel: Any) -> Any:
        return inside(qpos[1], healthy_z_range) & inside(qpos[2], healthy_angle_range)

    start = noisy(model, reset_noise_scale)
    hidden = 1 if exclude_current_positions_from_observation else 0
    health = _Health(healthy, healthy_reward, terminate_when_unhealthy)
    return _runner(model, start, hidden, forward_reward_weight, ctrl_cost_weight, health, 10.0)


def _reacher(model: Simulated, *, reward_dist_weight: float = 1.0, reward_control_weight: float = 1.0) -> Parts:
    fingertip, target = model.body("fingertip"), model.body("target")

    def start(key: Any) -> tuple[Any, Any]:
        """The goal is anywhere in a disc of radius 0.2, where Gymnasium draws in a square until it is in the disc."""
        noise_Q, noise_V = 2.0 * uniforms_at(key, 0, 4) - 1.0, 2.0 * uniforms_at(key, 4, 2) - 1.0
        share, turn = uniforms_at(key, 6, 2)
        angle = 2.0 * jnp.pi * turn
        goal = 0.2 * jnp.sqrt(share) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        qpos = jnp.concatenate([model.mx.qpos0[:2] + 0.1 * noise_Q[:2], goal])
        return qpos, jnp.concatenate([0.005 * noise_V, jnp.zeros(2)])

    def look(data: Any, stepped: bool) -> Any:
        return data.xpos[fingertip] - data.xpos[target]

    def observe(state: GymState) -> Any:
        qpos, qvel = state.physics[:2]
        return jnp.concatenate([jnp.cos(qpos[:2]), jnp.sin(qpos[:2]), qpos[2:], qvel[:2], state.seen[:2]])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        distance = jnp.sqrt(jnp.sum(after.seen**2))
        reward = -reward_dist_weight * distance - reward_control_weight * jnp.sum(action**2)
        return reward, jnp.bool_(False)

    return Parts(start, observe, outcome, look)


def _pusher(
    model: Simulated,
    *,
    reward_near_weight: float = 0.5,
    reward_dist_weight: float = 1.0,
    reward_control_weight: float = 0.1,
) -> Parts:
    bodies = np.array([model.body(name) for name in ("tips_arm", "object", "goal")])

    def start(key: Any) -> tuple[Any, Any]:
        """The object is the first of so many in a rectangle that is far enough from the goal, as with Gymnasium, which
        tries until it is: all are too near in one of 1e10 episodes."""
        tries = 24
        at = uniforms_at(key, model.c.nv, 2 * tries).reshape(tries, 2) * jnp.array([0.3, 0.4]) - jnp.array([0.3, 0.2])
        place = at[jnp.argmax(jnp.sum(at**2, axis=1) > 0.17**2)]
        qvel = 0.005 * (2.0 * uniforms_at(key, 0, model.c.nv) - 1.0)
        return jnp.concatenate([model.mx.qpos0[:-4], place, jnp.zeros(2)]), qvel.at[-4:].set(0.0)

    def observe(state: GymState) -> Any:
        return jnp.concatenate([state.physics.qpos[:7], state.physics.qvel[:7], state.seen.ravel()])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        tips, thing, goal = after.seen
        near, far = (jnp.sqrt(jnp.sum((thing - other) ** 2)) for other in (tips, goal))
        costs = reward_near_weight * near + reward_dist_weight * far + reward_control_weight * jnp.sum(action**2)
        return -costs, jnp.bool_(False)

    return Parts(start, observe, outcome, lambda data, stepped: data.xpos[bodies])


def _inverted_pendulum(model: Simulated, *, reset_noise_scale: float = 0.01) -> Parts:
    def observe(state: GymState) -> Any:
        return jnp.concatenate(state.physics[:2])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        observation = observe(after)
        done = ~jnp.isfinite(observation).all() | (jnp.abs(observation[1]) > 0.2)
        return jnp.where(done, 0.0, 1.0), done

    return Parts(noisy(model, reset_noise_scale), observe, outcome)


def _inverted_double_pendulum(
    model: Simulated, *, healthy_reward: float = 10.0, reset_noise_scale: float = 0.1
) -> Parts:
    def look(data: Any, stepped: bool) -> Any:
        """Place of the tip in the plane, and the force of the constraint on the cart."""
        return jnp.stack([data.site_xpos[0, 0], data.site_xpos[0, 2], data.qfrc_constraint[0]])

    def observe(state: GymState) -> Any:
        qpos, qvel = state.physics[:2]
        limited = jnp.clip(jnp.concatenate([qvel, state.seen[2:]]), -10.0, 10.0)
        return jnp.concatenate([qpos[:1], jnp.sin(qpos[1:]), jnp.cos(qpos[1:]), limited])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        (x, y, _), (_, first, second) = after.seen, after.physics.qvel
        done = y <= 1.0
        penalties = 0.01 * x**2 + (y - 2.0) ** 2 + 1e-3 * first**2 + 5e-3 * second**2
        return jnp.where(done, 0.0, healthy_reward) - penalties, done

    return Parts(noisy(model, reset_noise_scale, normal=True), observe, outcome, look, solves_reset=True)


class _Health(NamedTuple):
    """What a robot that stands is worth."""

    of: Callable[[Any, Any], Any]
    """Function (qpos, qvel) -> whether it stands."""
    reward: float
    ends: bool
    """Whether an episode ends when it does not."""


def _runner(
    model: Simulated,
    start: Callable[[Any], tuple[Any, Any]],
    hidden: int,
    forward_reward_weight: float,
    ctrl_cost_weight: float,
    health: _Health | None = None,
    fastest: float = float("inf"),
) -> Parts:
    """A robot that is rewarded for running along x, the first of its positions.

    Args:
        hidden: leading positions that are not observed.
        fastest: bound of the observed velocities.
    """

    def observe(state: GymState) -> Any:
        qpos, qvel = state.physics[:2]
        return jnp.concatenate([qpos[hidden:], jnp.clip(qvel, -fastest, fastest)])

    def outcome(before: GymState, after: GymState, action: Any) -> tuple[Any, Any]:
        velocity = (after.physics.qpos[0] - before.physics.qpos[0]) / model.step_s
        reward = forward_reward_weight * velocity - ctrl_cost_weight * jnp.sum(action**2)
        if health is None:
            return reward, jnp.bool_(False)
        healthy = health.of(*after.physics[:2])
        return reward + healthy * health.reward, ~healthy & health.ends

    return Parts(start, observe, outcome)


TASKS = {
    "Ant-v5": GymTask("ant.xml", 5, _ant),
    "HalfCheetah-v5": GymTask("half_cheetah.xml", 5, _half_cheetah),
    "Hopper-v5": GymTask("hopper.xml", 4, _hopper),
    "Walker2d-v5": GymTask("walker2d_v5.xml", 4, _walker2d),
    "Swimmer-v5": GymTask("swimmer.xml", 4, _swimmer),
    "Humanoid-v5": GymTask("humanoid.xml", 5, humanoid),
    "HumanoidStandup-v5": GymTask("humanoidstandup.xml", 5, humanoid_standup, at_once=(8,)),
    "Reacher-v5": GymTask("reacher.xml", 2, _reacher, 50),
    "Pusher-v5": GymTask("pusher_v5.xml", 5, _pusher, 100),
    "InvertedPendulum-v5": GymTask("inverted_pendulum.xml", 2, _inverted_pendulum),
    "InvertedDoublePendulum-v5": GymTask("inverted_double_pendulum.xml", 5, _inverted_double_pendulum),
}
"""Environments by their IDs in Gymnasium."""
