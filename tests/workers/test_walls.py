"""Contacts of capsules with walls in the plane, against brute force and worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from workers.environments import ant
from workers.environments.ant_tasks import WALL_RADIUS
from workers.environments.walls import nearest_wall, wall_rows

RADIUS = 0.08
ALONG_X = (((0.0, 0.0), (4.0, 0.0)),)


def contact(walls, foot, knee, radius=RADIUS):
    found = nearest_wall(wall_rows(walls), jnp.array(foot, jnp.float32), jnp.array(knee, jnp.float32), radius)
    return float(found.distance), np.asarray(found.normal_3), np.asarray(found.position_3)


def least_distance(walls, foot, knee, points=2001):
    """Between the axes, by trying points of each wall against the exact distance to the capsule's axis."""
    best = np.inf
    foot, knee = np.array(foot[:2]), np.array(knee[:2])
    way = knee - foot
    for start, end in walls:
        grid = np.linspace(0, 1, points)[:, None] * (np.array(end) - start) + start
        along = np.clip((grid - foot) @ way / max(way @ way, 1e-12), 0, 1)
        best = min(best, np.linalg.norm(foot + along[:, None] * way - grid, axis=1).min())
    return best


@pytest.mark.slow
@pytest.mark.parametrize("walls", [ant.MAZE_WALLS, ant.TRAP_WALLS], ids=["maze", "trap"])
def test_distance_is_the_least_to_any_wall(walls):
    rng = np.random.default_rng(0)
    ends = np.concatenate([np.array(wall) for wall in walls])
    middle = ends[rng.integers(len(ends), size=400)] + rng.normal(size=(400, 2)) * 2.0
    foot = np.concatenate([middle, rng.uniform(0, 0.6, (400, 1))], axis=1)
    knee = foot + np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)), rng.uniform(-0.3, 0.3, (400, 1))], axis=1)
    found = jax.vmap(lambda f, k: nearest_wall(wall_rows(walls), f, k, RADIUS))(jnp.asarray(foot), jnp.asarray(knee))
    checked = 0
    for row in range(400):
        least = least_distance(walls, foot[row], knee[row])
        gap = float(found.distance[row]) + WALL_RADIUS + RADIUS
        if gap < 0:  # crosses a wall's axis
            assert least < 0.03
            continue
        checked += 1
        assert gap == pytest.approx(least, abs=0.02)
        np.testing.assert_allclose(np.linalg.norm(found.normal_3[row]), 1.0, rtol=1e-5)
        assert found.normal_3[row, 2] == 0.0
    assert checked > 300


@pytest.mark.slow
def test_a_foot_beside_a_wall():
    distance, normal, position = contact(ALONG_X, (2.0, 0.55, 0.1), (2.0, 1.0, 0.4))
    assert distance == pytest.approx(0.55 - 0.58)
    np.testing.assert_allclose(normal, [0, 1, 0])
    np.testing.assert_allclose(position, [2.0, 0.55 - 0.08 + 0.015, 0.1], atol=1e-6)


def test_of_equally_near_points_the_foot_s_is_taken():
    """A leg parallel to the wall: all its points are as near."""
    _, normal, position = contact(ALONG_X, (1.0, 0.55, 0.1), (1.5, 0.55, 0.4))
    np.testing.assert_allclose(position[[0, 2]], [1.0, 0.1])
    np.testing.assert_allclose(normal, [0, 1, 0])


@pytest.mark.slow
def test_of_equally_near_walls_the_first_is_taken():
    walls = (((0.0, 0.0), (4.0, 0.0)), ((0.0, 2.0), (4.0, 2.0)))
    assert contact(walls, (2.0, 1.0, 0.1), (2.0, 1.0, 0.1))[1][1] == 1.0
    assert contact(walls[::-1], (2.0, 1.0, 0.1), (2.0, 1.0, 0.1))[1][1] == -1.0


def test_a_wall_s_end_against_the_middle_of_a_leg():
    distance, normal, position = contact(ALONG_X, (4.3, -0.3, 0.1), (4.3, 0.3, 0.5))
    assert distance == pytest.approx(0.3 - 0.58)
    np.testing.assert_allclose(normal, [1, 0, 0], atol=1e-6)
    assert position[2] == pytest.approx(0.3)


def test_a_foot_that_has_come_through_is_pushed_back_to_the_knee_s_side():
    for side in (1.0, -1.0):
        distance, normal, _ = contact(ALONG_X, (2.0, -0.1 * side, 0.1), (2.0, 0.4 * side, 0.4))
        assert distance == pytest.approx(-0.1 - 0.58)
        np.testing.assert_allclose(normal, [0, side, 0])


def test_a_foot_that_has_hardly_come_through_has_a_normal_too():
    """The square of its depth is no float32 any more."""
    distance, normal, _ = contact(ALONG_X, (2.0, -1e-20, 0.1), (2.0, 0.4, 0.4))
    assert distance == pytest.approx(-0.58)
    np.testing.assert_allclose(normal, [0, 1, 0])
