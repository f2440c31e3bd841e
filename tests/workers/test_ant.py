"""The ant against Brax itself, its walls under force, and the landmarks of AntMaze and AntTrap."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.noise import Domain, stream_keys
from workers.environments import TASKS, ant_maze, ant_trap, make_environment
from workers.environments.ant import (
    LEG_LENGTH,
    LOWER_LEGS,
    STEP_S,
    Ant,
    contact_forces,
    expand,
    make_ant,
    observe,
    physics_step,
)
from workers.environments.brax_parts import Transform, pipeline

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


def test_ten_thousand_steps_of_random_actions_stay_sane(ant):
    def body(state, action):
        state = ant.step(state, action)
        speed = jnp.sqrt(jnp.sum(state.motion.vel**2, -1)).max()
        return state, (state.q[7:], speed, state.q[2])

    run = jax.jit(jax.vmap(lambda state, actions: jax.lax.scan(body, state, actions)))
    _, (joints, speed, height) = run(start(ant, 8), actions(10_000, 8))
    limits = np.degrees(np.abs(np.asarray(joints))).max((0, 1))
    assert np.isfinite(joints).all()
    assert limits[::2].max() < 60  # hips: 30, held by springs
    assert limits[1::2].max() < 110  # ankles: 70
    assert float(speed.max()) < 30
    assert float(height.min()) > -0.5
    assert float(height.max()) < 3


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


def colliders(q_state, system):
    """Torso and both ends of every lower leg in the plane: [..., 9, 2]."""
    full = expand(system, q_state)
    points = [full.x.pos[0]]
    for link, sign_x, sign_y in LOWER_LEGS:
        end = jnp.array([sign_x * LEG_LENGTH, sign_y * LEG_LENGTH, 0.0])
        points += [full.x.pos[link], full.x.take(link).do(Transform.create(pos=end)).pos]
    return jnp.stack(points)[:, :2]


def depth(points, walls) -> jax.Array:
    """How deep the deepest of nine collider points is in a wall; negative outside."""
    radii = jnp.array([0.25] + [0.08] * 8)
    deepest = -jnp.inf
    for a, b in walls:
        a, b = jnp.array(a), jnp.array(b)
        along = jnp.clip((points - a) @ (b - a) / jnp.sum((b - a) ** 2), 0, 1)
        gap = jnp.linalg.norm(points - a - along[:, None] * (b - a), axis=-1)
        deepest = jnp.maximum(deepest, (0.5 + radii - gap).max())
    return deepest


def crossings(before, after, walls) -> jax.Array:
    """Whether the way of the torso crosses a wall's axis."""

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    crossed = False
    for a, b in walls:
        a, b = jnp.array(a), jnp.array(b)
        crossed |= (side(a, b, before) * side(a, b, after) < 0) & (side(before, after, a) * side(before, after, b) < 0)
    return crossed


@pytest.mark.parametrize("name", ["ant_maze", "ant_trap"])
def test_walls_hold(name):
    """Two thousand ants start beside walls and corners and are driven by random and by full-torque actions."""
    walls = {"ant_maze": ant_maze, "ant_trap": ant_trap}[name].WALLS
    ant = make_ant(walls)
    count, steps = 2000, 100
    rng = np.random.default_rng(1)
    ends = np.array(walls)[rng.integers(len(walls), size=20 * count)]
    tries = ends[:, 0] + rng.uniform(size=(20 * count, 1)) * (ends[:, 1] - ends[:, 0])
    tries += rng.uniform(-3, 3, tries.shape)
    inside = np.abs(tries - ant_maze.MIDDLE).max(1) < ant_maze.HALF - 1.6 if name == "ant_maze" else True
    free = np.asarray(jax.jit(jax.vmap(lambda xy: depth(jnp.tile(xy, (9, 1)), walls)))(tries)) < -1.0
    places = tries[free & inside][:count]
    assert len(places) == count
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count))
    state = jax.vmap(lambda key, xy: ant.reset(key, (xy[0], xy[1])))(keys, jnp.array(places, jnp.float32))
    kinds = rng.uniform(-1, 1, (steps, count, 8))
    full = np.sign(rng.uniform(-1, 1, (steps // 10, count, 8))).repeat(10, axis=0)
    kinds = np.where(np.arange(count)[:, None] % 2, kinds, full).astype(np.float32)

    # A steady pull on the torso drives each ant straight at whatever is there.
    pull = rng.normal(size=(count, 2))
    pull = (pull / np.linalg.norm(pull, axis=1, keepdims=True) * 0.4).astype(np.float32)

    def body(carry, action):
        state, pull = carry
        vel = state.motion.vel.at[0, :2].add(pull)
        moved = ant.step(state._replace(motion=state.motion.replace(vel=vel)), action)
        found = (
            depth(colliders(moved, ant.system), walls),
            crossings(state.q[:2], moved.q[:2], walls),
            moved.q[:2],
            jnp.isfinite(moved.q).all(),
        )
        return (moved, pull), found

    run = jax.jit(jax.vmap(lambda state, pull, actions: jax.lax.scan(body, (state, pull), actions)))
    _, (deepest, crossed, xy, finite) = run(state, pull, kinds.swapaxes(0, 1))
    assert finite.all()
    assert not crossed.any()
    assert float(deepest.max()) < 0.1
    assert float((deepest > 0).any(1).mean()) > 0.4, "most of them must have touched a wall"
    if name == "ant_maze":
        assert float(jnp.abs(xy - ant_maze.MIDDLE).max()) < ant_maze.HALF


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
    assert TASKS["ant_trap"].observation_size == environment.observe(state).shape[0] == 113
