"""Walls for ants: upright, without tops to climb over, met by capsules and spheres in the plane.

A wall is a plane segment thickened by WALL_RADIUS, a collider one thickened by its own radius: a lower leg from foot to
knee, or the torso, whose segment is a point. They touch where the two segments are closest. A contact's normal is
horizontal and points from the wall to the collider, so that nothing lifts an ant over a wall. Each collider has one
contact, with the wall nearest to it. Choices are sums over masks, without gathers, for compilers to come.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from es_service.protocol import Segment

WALL_RADIUS = 0.5
TINY = 1e-9


class WallContact(NamedTuple):
    """Where a collider meets, or misses, its nearest wall."""

    distance: Any
    """Between the two surfaces, metres; negative in contact."""
    normal_3: Any
    """Horizontal unit vector from the wall to the collider."""
    position_3: Any
    """Half-way between the surfaces, at the height of the collider's closest point."""


def nearest_wall(walls: tuple[Segment, ...], foot_3: Any, knee_3: Any, radius: Any) -> WallContact:
    """The contact of one collider with the nearest of some walls.

    Two segments that do not cross are closest at an end of one of them. Where they cross, the gap is how far the foot
    has come through, negative, and the normal points to the knee's side.

    Args:
        foot_3, knee_3: ends of the collider's axis; equal for a sphere. Of equally near pairs of points the foot's is
            taken, then that of the wall first in the list.
        radius: of the collider.
    """
    ends = np.array(walls, np.float32)
    start_W_2, way_W_2 = ends[:, 0], ends[:, 1] - ends[:, 0]
    foot_2, knee_2 = foot_3[:2], knee_3[:2]
    leg_2 = knee_2 - foot_2

    # The four candidates C of each wall: foot, knee, and the wall's two ends, each against the other segment.
    offset_W_C_2, along_W_C = [], []
    for point_2, along in ((foot_2, 0.0), (knee_2, 1.0)):
        share_W = _share(point_2 - start_W_2, way_W_2)
        offset_W_C_2.append(point_2 - start_W_2 - share_W[:, None] * way_W_2)
        along_W_C.append(jnp.full(len(walls), along))
    for end_W_2 in (start_W_2, ends[:, 1]):
        share_W = _share(end_W_2 - foot_2, leg_2)
        offset_W_C_2.append(foot_2 + share_W[:, None] * leg_2 - end_W_2)
        along_W_C.append(share_W)
    offset_W_C_2, along_W_C = jnp.stack(offset_W_C_2, 1), jnp.stack(along_W_C, 1)
    nearest_W_C = _first_least(jnp.sum(offset_W_C_2 * offset_W_C_2, -1))
    offset_W_2 = jnp.sum(offset_W_C_2 * nearest_W_C[:, :, None], 1)
    along_W = jnp.sum(along_W_C * nearest_W_C, 1)
    gap_W = jnp.sqrt(jnp.sum(offset_W_2 * offset_W_2, -1))

    side_foot_W, side_knee_W = _cross(way_W_2, foot_2 - start_W_2), _cross(way_W_2, knee_2 - start_W_2)
    ends_apart_W = _cross(leg_2, start_W_2 - foot_2) * _cross(leg_2, ends[:, 1] - foot_2) < 0
    crosses_W = (side_foot_W * side_knee_W < 0) & ends_apart_W
    length_W = np.sqrt((way_W_2**2).sum(-1))
    across_W_2 = np.stack([-way_W_2[:, 1], way_W_2[:, 0]], -1) / length_W[:, None]
    through_W_2 = across_W_2 * jnp.sign(side_knee_W)[:, None]
    normal_W_2 = jnp.where(crosses_W[:, None], through_W_2, offset_W_2 / jnp.maximum(gap_W, TINY)[:, None])
    gap_W = jnp.where(crosses_W, -jnp.abs(side_foot_W) / length_W, gap_W)
    along_W = jnp.where(crosses_W, 0.0, along_W)

    chosen_W = _first_least(gap_W[None])[0]
    distance = jnp.sum(gap_W * chosen_W) - WALL_RADIUS - radius
    normal_2 = jnp.sum(normal_W_2 * chosen_W[:, None], 0)
    normal_3 = jnp.concatenate([normal_2, jnp.zeros(1)])
    on_axis_3 = foot_3 + jnp.sum(along_W * chosen_W) * (knee_3 - foot_3)
    return WallContact(distance, normal_3, on_axis_3 - normal_3 * (radius + 0.5 * distance))


def _share(from_2: Any, way_2: Any) -> Any:
    """How far along a way, from 0 to 1, the point lies that is nearest to one `from_2` away from its start."""
    length = (way_2 * way_2).sum(-1)
    return jnp.clip((from_2 * way_2).sum(-1) / jnp.maximum(length, TINY), 0.0, 1.0)


def _cross(way_2: Any, from_2: Any) -> Any:
    """Positive to the left of the way, negative to its right."""
    return way_2[..., 0] * from_2[..., 1] - way_2[..., 1] * from_2[..., 0]


def _first_least(values: Any) -> Any:
    """1.0 at the first least of the last axis, 0.0 elsewhere."""
    least = values == values.min(-1, keepdims=True)
    before = jnp.cumsum(least, -1) - least
    return (least & (before == 0)).astype(jnp.float32)
