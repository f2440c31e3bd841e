"""The ant against Brax itself, and the landmarks of AntMaze and AntTrap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

from es_service.protocol.messages import SIGNS, PolicySpec
from es_service.protocol.noise import NORMAL_STD, Domain, normals, stream_keys
from tests.helpers import SPEC
from tests.workers.steps import (
    LANES,
    brax_substeps,
    carried,
    environment_of,
    kernel_of,
    of_many,
    pushed,
    resets_of,
    steps_of,
    substeps_of,
    whole,
)
from workers import xla
from workers.environments import SHIPPED, make_environment
from workers.environments.ant import AntState, contact_forces, load_system, observe
from workers.environments.ant_tasks import STEP_S
from workers.environments.brax_task import pipeline
from workers.policy import act, initial_parameters, split_layers
from workers.simd.episodes import rollout as simd
from workers.worker import episode_keys

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated"),  # Brax, on its own
]
TRAP_M = 7.0
"""From the start in AntTrap to its nearest wall; ants that stay far from it are as on an empty plane."""


def keys(count: int) -> np.ndarray:
    return stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count))


def start(count: int) -> AntState:
    """Ants at the start of AntTrap."""
    return resets_of("ant_trap")(keys(count))


def step(state: AntState, action: np.ndarray) -> AntState:
    """Their next states."""
    return kernel_of("ant_trap")(state, action)[0]


def actions(count: int, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 8)).astype(np.float32)


@pytest.mark.long
def test_without_a_wall_in_reach_a_substep_is_brax_s_bit_for_bit():
    both = whole(start(16)), whole(start(16))
    for action in actions(16, 300):
        both = substeps_of("ant_trap")(both[0], action)[0], brax_substeps()(both[1], action)
    for mine, brax_s in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_array_equal(mine, brax_s)
    assert 0.05 < np.abs(both[0].x.pos[:, 0, :2]).max() < TRAP_M - 5.0


@pytest.mark.long
def test_a_control_step_is_ten_of_brax_s():
    state = start(16)
    for action in actions(16, 20):
        full = whole(state)
        for _ in range(10):
            full = brax_substeps()(full, action)
        state = steps_of("ant_trap")(state, action)[0]
        np.testing.assert_allclose(state.q, full.q, atol=1e-6)
        np.testing.assert_allclose(state.qd, full.qd, atol=2e-6 * np.abs(full.qd).max())


@pytest.mark.parametrize(
    "make_training_rollout",
    [pytest.param(xla.make_training_rollout, marks=pytest.mark.long), simd.make_training_rollout],
)
def test_a_compiled_episode_is_brax_s_after_one_step(make_training_rollout):
    """The whole rollout, policy and all, beside Brax's own reset and ten of its substeps, far from any wall."""
    shape = PolicySpec((29, 16, 8))
    spec = replace(SPEC, environment="ant_maze", policy=shape, episode_steps=2, action_noise=0.0, observation_clip=None)
    environment = make_environment("ant_maze", {})
    keys_P_S_E = episode_keys(spec, 1, np.arange(8))[0]
    noise_keys_P = stream_keys(spec.seed, Domain.PARAMETER_NOISE, 1, np.arange(8))
    centre_D = initial_parameters(spec.policy, "unit_columns", 0)
    sigma = 0.3
    rollout = make_training_rollout(environment, spec)
    zeros_O, ones_O = np.zeros(29, np.float32), np.ones(29, np.float32)
    found = rollout(centre_D, np.float32(sigma / NORMAL_STD), zeros_O, ones_O, noise_keys_P, keys_P_S_E, keys_P_S_E)

    for s, sign in enumerate(SIGNS):
        noise_P_D = np.stack([normals(key, spec.policy.parameters) for key in noise_keys_P])
        states = resets_of("ant_maze")(keys_P_S_E[:, s, 0])
        first_P_O = np.asarray(jax.vmap(environment.observe)(states))
        parameters_P_D = centre_D + np.float32(sign * sigma) * noise_P_D
        action_P_A = np.stack(
            [
                act(np, spec.policy, split_layers(spec.policy, d), None, o)[0]
                for d, o in zip(parameters_P_D, first_P_O, strict=True)
            ]
        )
        assert np.abs(action_P_A).max() > 0.05
        full = brax_start()(states.q, states.qd)
        for _ in range(10):
            full = brax_substeps()(full, action_P_A)
        x_y = (np.asarray(full.q)[:, :2] - 2.5) / 37.5
        second_P_O = np.concatenate([x_y, np.asarray(full.q)[:, 2:], np.asarray(full.qd)], axis=1)
        # Two observations are summed in an episode of two steps; what is not the first is that after one step.
        ours = np.asarray(found.shifted_sum_O[:, s, 0], np.float64) - first_P_O
        np.testing.assert_allclose(ours[:, :15], second_P_O[:, :15], rtol=1e-6, atol=1e-6)
        # A foot that lands magnifies the last bit, which depends on the processor: Brax itself, from starts that differ
        # in it, differs by up to 4e-5 of the greatest velocity, and 7e-6 in the median.
        off_P = np.abs(ours - second_P_O)[:, 15:].max(1) / np.abs(second_P_O[:, 15:]).max()
        assert np.median(off_P) < 2e-5
        assert off_P.max() < 1e-4


@cache
def brax_start() -> Any:
    """Brax's own state of an ant with these coordinates and velocities."""
    system = load_system(())
    return of_many(lambda q, qd: pipeline.init(system, q, qd))


@pytest.mark.parametrize("steps", [1000, pytest.param(10_000, marks=pytest.mark.long)])
def test_many_steps_of_random_actions_stay_sane(steps):
    """Of 64 ants, so that a thousand steps are 64,000 of one ant."""
    state, joints, speed, height, joules = carried(start(LANES), np.tile([-50.0, 0.0], (LANES, 1))), [], [], [], []
    for action in actions(LANES, steps):
        state = step(state, action)
        joints.append(np.degrees(np.abs(state.q[:, 7:])).max(0))
        speed.append(np.sqrt((state.motion.vel**2).sum(-1)).max())
        height += [state.q[:, 2].min(), state.q[:, 2].max()]
        joules += [energy(state).min(), energy(state).max()]
    limits = np.max(joints, axis=0)
    assert np.isfinite(joints).all()
    assert limits[::2].max() < 65  # hips: 30, held by springs
    assert limits[1::2].max() < 110  # ankles: 70
    assert max(speed) < 30
    assert min(height) > -0.5
    assert max(height) < 3
    assert 30 < min(joules) < max(joules) < 400
    assert state.q[:, 0].max() < -10.0, "no wall is in reach"


def energy(state: AntState) -> np.ndarray:
    """Of motion and of height, joules; masses and inertias are 1, so that a standing ant has some 45."""
    moving = 0.5 * ((state.motion.vel**2).sum((1, 2)) + (state.motion.ang**2).sum((1, 2)))
    return moving + 9.81 * state.centre.pos[:, :, 2].sum(1)


def lying(step: Any, state: AntState, steps: int) -> Iterator[Any]:
    """What each of some steps without any action gives."""
    for _ in range(steps):
        found = step(state, np.zeros((len(state.q), 8), np.float32))
        state = found if isinstance(found, AntState) else found[0]
        yield found


def test_an_ant_left_alone_gains_no_energy():
    dropped = carried(start(8), np.tile([0.0, 0.0, 1.0], (8, 1)))
    before = energy(dropped)
    after = np.stack([energy(state) for state in lying(step, dropped, 200)], axis=1)
    assert (after.max(1) <= before * 1.01).all()
    assert (after[:, -1] < before - 0.9 * 9 * 9.81).all(), "the fall is not kept"


def test_sizes_and_contact_forces():
    state = start(4)
    assert jax.vmap(observe)(state).shape == (4, 27)
    assert jax.vmap(contact_forces)(state).shape == (4, 84)
    [up] = lying(step, carried(state, np.tile([0.0, 0.0, 3.0], (4, 1))), 1)
    assert not np.asarray(jax.vmap(contact_forces)(up)).any()

    *_, state = lying(step, state, 40)
    second = list(lying(step, state, round(1.0 / STEP_S)))
    vertical = [one.push.vel[:, :, 2].sum(1) for one in second]
    weight = 9 * 9.81
    np.testing.assert_allclose(np.mean(vertical, axis=0), weight, rtol=0.05)
    forces = np.asarray(jax.vmap(contact_forces)(second[-1])).reshape(4, 14, 6)
    touched = [4, 7, 10, 13]
    assert (forces[:, touched, 5] == 1.0).any()
    assert not np.delete(forces, [1, *touched], axis=1).any()


@pytest.mark.long
def test_landmarks_of_the_maze():
    environment, state = environment_of("ant_maze"), resets_of("ant_maze")(keys(4))
    np.testing.assert_allclose(-jax.vmap(environment.goal_distance)(state), -60.0)
    observation = jax.vmap(environment.observe)(state)
    np.testing.assert_allclose(observation[:, :2], (-25.0 - 2.5) / 37.5, rtol=1e-6)
    rewards = []
    for _ in range(400):  # ants without will, drawn along +x with ten times their weight: their legs give way
        [(state, reward, *_)] = lying(kernel_of("ant_maze"), drawn(state, 100.0), 1)
        rewards.append(reward)
    np.testing.assert_allclose(rewards[-1], -25.75, atol=0.05)
    assert np.max(rewards) < -25.65, "no more than the tenth of a metre that a wall may give way"
    assert state.q[:, 0].max() < 10.0 - 0.5
    # Left to itself it is let go by the wall, and nothing scores above the landmark.
    *_, (_, reward, *_) = lying(kernel_of("ant_maze"), state, 60)
    assert reward.max() <= -25.75


def drawn(state: AntState, acceleration: float) -> AntState:
    """Ants whose links are all drawn along +x for a step, in m/s2."""
    return pushed(state, np.array([acceleration * STEP_S, 0.0, 0.0]))


def test_the_trap_catches_and_falls_end_the_episode():
    environment, first = environment_of("ant_trap"), start(1)
    state = first
    way = []
    for _ in range(300):
        [(state, *_)] = lying(kernel_of("ant_trap"), drawn(state, 9.81), 1)
        way.append(state.q[0, :3])
    assert 10.5 < way[-1][0] < 11.5
    assert np.max(way, axis=0)[2] < 1.5, "walls lift nothing"

    for height, ends in ((0.55, False), (2.0, True)):
        [(_, _, done, *_)] = lying(kernel_of("ant_trap"), carried(first, np.array([[0.0, 0.0, height - 0.55]])), 1)
        assert bool(done[0]) == ends
    for xy, clipped in (((-3.0, 2.0), (0.0, 2.0)), ((40.0, -9.0), (30.0, -8.0)), ((5.0, 1.0), (5.0, 1.0))):
        away = carried(first, np.array([xy]) - first.q[:, :2])
        np.testing.assert_allclose(jax.vmap(environment.descriptor)(away)[0], clipped, rtol=1e-6)


def test_reward_of_the_trap_by_hand():
    environment, state = environment_of("ant_trap"), start(1)
    action = np.linspace(-1.5, 1.0, 8, dtype=np.float32)
    new, reward, *_ = kernel_of("ant_trap")(state, action[None])
    speed = (float(new.q[0, 0]) - float(state.q[0, 0])) / 0.05
    control = 0.5 * float((np.clip(action, -1, 1) ** 2).sum())
    forces = np.asarray(jax.vmap(contact_forces)(new))
    contact = 5e-4 * float((np.clip(forces, -1, 1) ** 2).sum())
    assert float(reward[0]) == pytest.approx(speed + 1.0 - control - contact, rel=1e-4)
    assert SHIPPED["ant_trap"].observation_size == jax.vmap(environment.observe)(state).shape[1] == 113
