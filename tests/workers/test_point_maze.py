"""PointMaze against a scalar reference implementation of the published rules, and landmarks worked out by hand."""

import importlib
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from tests.references import point_maze as reference
from tests.workers.steps import resets_of
from workers.environments import SHIPPED, SHIPPED_IN, make_environment
from workers.environments.ant_tasks import MAZES

ENVIRONMENT = make_environment("point_maze", {})
step = jax.jit(ENVIRONMENT.step)
steps = jax.jit(jax.vmap(ENVIRONMENT.step))


@pytest.mark.slow
def test_random_moves_equal_the_reference():
    rng = np.random.default_rng(0)
    count = 100_000
    old = rng.uniform(-1, 1, (count, 2)).astype(np.float32)
    old[: count // 2, 1] = rng.choice([-0.5, -0.49, 0.2, 0.21], count // 2) + rng.normal(0, 0.05, count // 2)
    action = rng.uniform(-1.5, 1.5, (count, 2)).astype(np.float32)
    new, reward, done = (np.asarray(x) for x in steps(old, action))
    differing = 0
    for i in range(count):
        x, y, expected_reward, expected_done = reference.step(*old[i].tolist(), tuple(action[i].tolist()))
        same = np.allclose([*new[i], reward[i]], [x, y, expected_reward], atol=1e-5) and done[i] == expected_done
        differing += not same
    assert differing <= 3  # moves whose hit is within float32 rounding of a wall's end or the goal's edge


@pytest.mark.parametrize(
    ("start", "action", "end"),
    [
        ((0.0, -0.52), (0.0, 1.0), (0.0, -0.5)),  # the lower wall from below
        ((-0.6, -0.52), (0.0, 1.0), (-0.6, -0.42)),  # its gap
        ((0.0, -0.45), (0.5, -1.0), (0.05, -0.49)),  # from above; x slides on
        ((-0.55, -0.52), (1.0, 1.0), (-0.45, -0.42)),  # crosses the line at x = -0.53, left of the wall
        ((-0.52, -0.52), (1.0, 0.5), (-0.42, -0.5)),  # crosses it at x = -0.48: stopped
        ((0.0, 0.15), (0.0, 1.0), (0.0, 0.2)),  # the upper wall from below
        ((0.6, 0.15), (0.0, 1.0), (0.6, 0.25)),  # its gap
        ((0.0, 0.25), (0.0, -1.0), (0.0, 0.21)),  # from above
        ((0.95, -0.95), (5.0, -5.0), (1.0, -1.0)),  # the arena; the action is clipped
    ],
)
def test_walls_by_hand(start, action, end):
    position, reward, done = step(jnp.array(start, jnp.float32), jnp.array(action, jnp.float32))
    np.testing.assert_allclose(position, end, atol=1e-6)
    assert reward == pytest.approx(-np.hypot(end[0] + 0.5, end[1] - 0.8), abs=1e-6)
    assert not done


def test_goal_is_a_square_of_side_a_tenth():
    for offset, expected in ((0.04, True), (0.049, True), (0.051, False)):
        corner = jnp.array([-0.5 + offset, 0.8 - offset], jnp.float32)
        assert bool(step(corner, jnp.zeros(2))[2]) is expected


def test_deceptive_optimum_is_the_paper_s_value():
    """Straight up from the start, then left under the upper wall: about -126.4 in 200 steps, as greedy methods get."""
    state, total = jnp.array([0.0, -0.85], jnp.float32), 0.0
    for _ in range(200):
        # round the lower wall on the left, then press against the upper wall below the goal
        target_x = -0.55 if state[1] < -0.495 else -0.5
        action = jnp.array([(target_x - state[0]) * 10, 1.0 if abs(state[0] - target_x) < 0.2 else 0.4])
        state, reward, done = step(state, action)
        total += float(reward)
        assert not done
    np.testing.assert_allclose(state, [-0.5, 0.2], atol=1e-5)
    assert total == pytest.approx(-126.4, abs=1.5)


def test_reset_covers_its_rectangle_and_corner_is_fixed():
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(5000))
    start = np.asarray(jax.vmap(ENVIRONMENT.reset)(keys))
    np.testing.assert_allclose(start.min(0), [-0.1, -1.0], atol=2e-3)
    np.testing.assert_allclose(start.max(0), [0.1, -0.7], atol=2e-3)
    np.testing.assert_allclose(start.mean(0), [0.0, -0.85], atol=5e-3)
    corner = make_environment("point_maze", {"start": "corner"})
    np.testing.assert_array_equal(jax.vmap(corner.reset)(keys[:3]), np.float32([[0.9, -0.9]] * 3))


@pytest.mark.parametrize(
    "name", [name if name == "point_maze" else pytest.param(name, marks=pytest.mark.slow) for name in SHIPPED]
)
def test_task_table_tells_the_truth(name):
    """The driver plans with the table and never sees the module; a wrong size would only show in a worker."""
    task = SHIPPED[name]
    module, function = ("goal_maze", "make") if name in MAZES else (SHIPPED_IN[name], name)
    made_by = getattr(importlib.import_module(f"workers.environments.{module}"), function)
    takes = inspect.signature(made_by).parameters
    defaults = {option: declared.default for option, declared in task.options.items()}
    assert defaults == {x.name: x.default for x in takes.values() if x.name != "maze"}
    environment = make_environment(name, defaults)
    state = jax.tree.map(lambda leaf: leaf[0], resets_of(name)(stream_keys(0, Domain.TRAINING_RESET, 0)[None]))
    assert np.isfinite(environment.goal_distance(state)) == task.has_goal

    def shape(function, *arguments):
        return jax.tree.map(lambda one: one.shape, jax.eval_shape(function, *arguments))

    assert shape(environment.observe, state) == (task.observation_size,)
    assert shape(environment.descriptor, state) == (len(task.descriptor_names),) == (len(task.descriptor_bounds),)
    _, reward, done = shape(environment.step, state, jnp.zeros(task.action_size))
    assert reward == done == shape(environment.goal_distance, state) == ()
