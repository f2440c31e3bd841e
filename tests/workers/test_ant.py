"""The ant against Brax itself, and the landmarks of AntMaze and AntTrap."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import SIGNS, PolicyShape
from es_service.protocol.noise import NORMAL_STD, Domain, normals, stream_keys
from tests.helpers import SPEC
from workers import rollout as xla
from workers.environments import SHIPPED, make_environment
from workers.environments.ant import STEP_S, Ant, contact_forces, expand, load_system, make_ant, observe, physics_step
from workers.environments.brax_parts import pipeline
from workers.policy import act, initial_parameters, split_layers
from workers.simd.episodes import rollout as simd
from workers.worker import episode_keys

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated"),  # Brax, on its own
]
FAR_WALLS = (((50.0, 50.0), (60.0, 50.0)), ((50.0, 50.0), (50.0, 60.0)))


@pytest.fixture(scope="module")
def ant() -> Ant:
    """An ant on an empty plane."""
    return make_ant()


def start(ant: Ant, count: int, xy=(0.0, 0.0)):
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count))
    return jax.vmap(lambda key: ant.reset(key, xy))(keys)


def actions(count: int, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 8)).astype(np.float32)


def test_without_a_wall_in_reach_a_substep_is_brax_s_bit_for_bit(ant):
    state = jax.vmap(lambda state: expand(ant.system, state))(start(ant, 16))
    ours = jax.jit(jax.vmap(lambda state, action: physics_step(ant.system, state, action, FAR_WALLS)[0]))
    theirs = jax.jit(jax.vmap(lambda state, action: pipeline.step(ant.system, state, action)))
    both = state, state
    for action in actions(16, 300):
        both = ours(both[0], action), theirs(both[1], action)
    for mine, brax_s in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_array_equal(mine, brax_s)
    assert float(jnp.abs(both[0].x.pos[:, 0, :2]).max()) > 0.05


def test_a_control_step_is_ten_of_brax_s(ant):
    state = start(ant, 16)
    step = jax.jit(jax.vmap(ant.step))
    brax_step = jax.jit(jax.vmap(lambda state, action: pipeline.step(ant.system, state, action)))
    for action in actions(16, 20):
        full = jax.vmap(lambda state: expand(ant.system, state))(state)
        for _ in range(10):
            full = brax_step(full, action)
        state = step(state, action)
        np.testing.assert_allclose(state.q, full.q, atol=1e-6)
        np.testing.assert_allclose(state.qd, full.qd, atol=2e-6 * np.abs(full.qd).max())


@pytest.mark.parametrize("make_training_rollout", [xla.make_training_rollout, simd.make_training_rollout])
def test_a_compiled_episode_is_brax_s_after_one_step(make_training_rollout):
    """The whole rollout, policy and all, beside Brax's own reset and ten of its substeps, far from any wall."""
    shape = PolicyShape((29, 16, 8))
    spec = replace(SPEC, environment="ant_maze", policy=shape, episode_steps=2, action_noise=0.0, observation_clip=None)
    environment = make_environment("ant_maze", {})
    keys_P_S_E = episode_keys(spec, 1, np.arange(8))[0]
    noise_keys_P = stream_keys(spec.seed, Domain.PARAMETER_NOISE, 1, np.arange(8))
    centre_D = initial_parameters(spec.policy, "unit_columns", 0)
    sigma = 0.3
    rollout = make_training_rollout(environment, spec)
    zeros_O, ones_O = np.zeros(29, np.float32), np.ones(29, np.float32)
    found = rollout(centre_D, np.float32(sigma / NORMAL_STD), zeros_O, ones_O, noise_keys_P, keys_P_S_E, keys_P_S_E)

    system = load_system(())
    brax_step = jax.jit(jax.vmap(lambda state, action: pipeline.step(system, state, action)))
    for s, sign in enumerate(SIGNS):
        noise_P_D = np.stack([normals(key, spec.policy.parameters) for key in noise_keys_P])
        states = jax.vmap(environment.reset)(keys_P_S_E[:, s, 0])
        first_P_O = np.asarray(jax.vmap(environment.observe)(states))
        parameters_P_D = centre_D + np.float32(sign * sigma) * noise_P_D
        action_P_A = np.stack(
            [act(np, split_layers(spec.policy, d), o) for d, o in zip(parameters_P_D, first_P_O, strict=True)]
        )
        assert np.abs(action_P_A).max() > 0.05
        full = jax.jit(jax.vmap(lambda q, qd: pipeline.init(system, q, qd)))(states.q, states.qd)
        for _ in range(10):
            full = brax_step(full, action_P_A)
        x_y = (np.asarray(full.q)[:, :2] - 2.5) / 37.5
        second_P_O = np.concatenate([x_y, np.asarray(full.q)[:, 2:], np.asarray(full.qd)], axis=1)
        # Two observations are summed in an episode of two steps; what is not the first is that after one step.
        ours = np.asarray(found.shifted_sum_O[:, s, 0], np.float64) - first_P_O
        np.testing.assert_allclose(ours[:, :15], second_P_O[:, :15], rtol=1e-6, atol=1e-6)
        # A foot that lands magnifies the last bit: most ants are within 1e-6 of the greatest velocity (simd, whose sums
        # have another order, 3e-6), one within 2e-5.
        off_P = np.abs(ours - second_P_O)[:, 15:].max(1) / np.abs(second_P_O[:, 15:]).max()
        assert np.median(off_P) < (1e-6 if make_training_rollout is xla.make_training_rollout else 5e-6)
        assert off_P.max() < 3e-5


def test_ten_thousand_steps_of_random_actions_stay_sane(ant):
    def body(state, action):
        state = ant.step(state, action)
        speed = jnp.sqrt(jnp.sum(state.motion.vel**2, -1)).max()
        return state, (state.q[7:], speed, state.q[2], energy(state))

    run = jax.jit(jax.vmap(lambda state, actions: jax.lax.scan(body, state, actions)))
    _, (joints, speed, height, joules) = run(start(ant, 8), actions(10_000, 8))
    limits = np.degrees(np.abs(np.asarray(joints))).max((0, 1))
    assert np.isfinite(joints).all()
    assert limits[::2].max() < 60  # hips: 30, held by springs
    assert limits[1::2].max() < 110  # ankles: 70
    assert float(speed.max()) < 30
    assert float(height.min()) > -0.5
    assert float(height.max()) < 3
    assert 30 < float(joules.min()) < float(joules.max()) < 400


def energy(state) -> jax.Array:
    """Of motion and of height, joules; masses and inertias are 1, so that a standing ant has some 45."""
    moving = 0.5 * (jnp.sum(state.motion.vel**2) + jnp.sum(state.motion.ang**2))
    return moving + 9.81 * jnp.sum(state.centre.pos[:, 2])


def test_an_ant_left_alone_gains_no_energy(ant):
    def body(state, _):
        state = ant.step(state, jnp.zeros(8))
        return state, energy(state)

    dropped = start(ant, 8)
    dropped = dropped._replace(centre=dropped.centre.replace(pos=dropped.centre.pos + jnp.array([0.0, 0.0, 1.0])))
    before = np.asarray(jax.vmap(energy)(dropped))
    after = np.asarray(jax.jit(jax.vmap(lambda state: jax.lax.scan(body, state, None, 200)))(dropped)[1])
    assert (after.max(1) <= before * 1.01).all()
    assert (after[:, -1] < before - 0.9 * 9 * 9.81).all(), "the fall is not kept"


def test_sizes_and_contact_forces(ant):
    state = jax.vmap(lambda key: ant.reset(key, (0.0, 0.0)))(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(4)))
    assert jax.vmap(observe)(state).shape == (4, 27)
    assert jax.vmap(contact_forces)(state).shape == (4, 84)
    step = jax.jit(jax.vmap(ant.step))
    up = state._replace(centre=state.centre.replace(pos=state.centre.pos + jnp.array([0.0, 0.0, 3.0])))
    assert not np.asarray(jax.vmap(contact_forces)(step(up, jnp.zeros((4, 8))))).any()

    for _ in range(40):
        state = step(state, jnp.zeros((4, 8)))
    vertical = []
    for _ in range(round(1.0 / STEP_S)):
        state = step(state, jnp.zeros((4, 8)))
        vertical.append(np.asarray(state.push.vel[:, :, 2].sum(1)))
    weight = 9 * 9.81
    np.testing.assert_allclose(np.mean(vertical, axis=0), weight, rtol=0.05)
    forces = np.asarray(jax.vmap(contact_forces)(state)).reshape(4, 14, 6)
    touched = [4, 7, 10, 13]
    assert (forces[:, touched, 5] == 1.0).any()
    assert not np.delete(forces, [1, *touched], axis=1).any()


def test_landmarks_of_the_maze():
    environment = make_environment("ant_maze", {})
    state = jax.vmap(environment.reset)(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(4)))
    np.testing.assert_allclose(-jax.vmap(environment.goal_distance)(state), -60.0)
    observation = jax.vmap(environment.observe)(state)
    np.testing.assert_allclose(observation[:, :2], (-25.0 - 2.5) / 37.5, rtol=1e-6)

    def pulled(state, _):
        """An ant without will, drawn along +x with ten times its weight: its legs give way."""
        vel = state.motion.vel.at[:, 0].add(100.0 * STEP_S)
        state, reward, _ = environment.step(state._replace(motion=state.motion.replace(vel=vel)), jnp.zeros(8))
        return state, reward

    end, rewards = jax.jit(jax.vmap(lambda state: jax.lax.scan(pulled, state, None, 400)))(state)
    np.testing.assert_allclose(rewards[:, -1], -25.75, atol=0.05)
    assert float(rewards.max()) < -25.65, "no more than the tenth of a metre that a wall may give way"
    assert float(end.q[:, 0].max()) < 10.0 - 0.5
    # Left to itself it is let go by the wall, and nothing scores above the landmark.
    rest = jax.jit(
        jax.vmap(lambda state: jax.lax.scan(lambda s, _: environment.step(s, jnp.zeros(8))[:2], state, None, 60))
    )
    assert float(rest(end)[1][:, -1].max()) <= -25.75


def test_the_trap_catches_and_falls_end_the_episode():
    environment = make_environment("ant_trap", {})
    state = environment.reset(stream_keys(0, Domain.TRAINING_RESET, 0))

    def pulled(state, _):
        vel = state.motion.vel.at[:, 0].add(9.81 * STEP_S)
        state, _, done = environment.step(state._replace(motion=state.motion.replace(vel=vel)), jnp.zeros(8))
        return state, (state.q[:3], done)

    _, (way, _) = jax.jit(lambda state: jax.lax.scan(pulled, state, None, 300))(state)
    assert 10.5 < float(way[-1, 0]) < 11.5
    assert float(way[:, 2].max()) < 1.5, "walls lift nothing"

    step = jax.jit(environment.step)
    for height, ends in ((0.55, False), (2.0, True)):
        lifted = state._replace(centre=state.centre.replace(pos=state.centre.pos + jnp.array([0, 0, height - 0.55])))
        assert bool(step(lifted, jnp.zeros(8))[2]) == ends
    for xy, clipped in (((-3.0, 2.0), (0.0, 2.0)), ((40.0, -9.0), (30.0, -8.0)), ((5.0, 1.0), (5.0, 1.0))):
        away = state._replace(q=state.q.at[:2].set(jnp.array(xy)))
        np.testing.assert_allclose(environment.descriptor(away), clipped)


def test_reward_of_the_trap_by_hand():
    environment = make_environment("ant_trap", {})
    state = environment.reset(stream_keys(0, Domain.TRAINING_RESET, 0))
    action = jnp.linspace(-1.5, 1.0, 8)
    new, reward, _ = jax.jit(environment.step)(state, action)
    speed = (float(new.q[0]) - float(state.q[0])) / 0.05
    control = 0.5 * float((np.clip(action, -1, 1) ** 2).sum())
    contact = 5e-4 * float((np.clip(np.asarray(contact_forces(new)), -1, 1) ** 2).sum())
    assert float(reward) == pytest.approx(speed + 1.0 - control - contact, rel=1e-4)
    assert SHIPPED["ant_trap"].observation_size == environment.observe(state).shape[0] == 113
