"""Walls for ants: upright, without tops to climb over, met by capsules and spheres in the plane.

A wall is a plane segment thickened by WALL_RADIUS, a collider one thickened by its own radius: a lower leg from foot to
knee, or the torso, whose segment is a point. They touch where the two segments are closest. A contact's normal is
horizontal and points from the wall to the collider, so that nothing lifts an ant over a wall. Each collider has one
contact, with the wall nearest to it. Choices are made without gathers, and divisions spared, for compilers' sake.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Segment

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
    inverse_W = 1.0 / (way_W_2**2).sum(-1)
    foot_2, knee_2 = foot_3[:2], knee_3[:2]
    leg_2 = knee_2 - foot_2
    inverse_leg = 1.0 / jnp.maximum(_dot(leg_2, leg_2), TINY)

    # The four candidates of each wall: foot, knee, and the wall's two ends, each against the other segment.
    candidates = []
    for point_2, along in ((foot_2, 0.0), (knee_2, 1.0)):
        share_W = jnp.clip(_dot(point_2 - start_W_2, way_W_2) * inverse_W, 0.0, 1.0)
        candidates.append((point_2 - start_W_2 - share_W[:, None] * way_W_2, jnp.full(len(walls), along)))
    for end_W_2 in (start_W_2, ends[:, 1]):
        share_W = jnp.clip(_dot(end_W_2 - foot_2, leg_2) * inverse_leg, 0.0, 1.0)
        candidates.append((foot_2 + share_W[:, None] * leg_2 - end_W_2, share_W))
    square_W, offset_W_2, along_W = _least([(_dot(offset, offset), offset, along) for offset, along in candidates])

    # Squares of gaps decide which wall is nearest, those of feet that came through as negative numbers.
    side_foot_W, side_knee_W = _cross(way_W_2, foot_2 - start_W_2), _cross(way_W_2, knee_2 - start_W_2)
    ends_apart_W = _cross(leg_2, start_W_2 - foot_2) * _cross(leg_2, ends[:, 1] - foot_2) < 0
    crosses_W = (side_foot_W * side_knee_W < 0) & ends_apart_W
    across_W_2 = np.stack([-way_W_2[:, 1], way_W_2[:, 0]], -1) * np.sqrt(inverse_W)[:, None]
    through_W = side_foot_W * np.sqrt(inverse_W)
    square_W = jnp.where(crosses_W, -through_W * through_W, square_W)
    offset_W_2 = jnp.where(crosses_W[:, None], across_W_2 * jnp.sign(side_knee_W)[:, None], offset_W_2)
    along_W = jnp.where(crosses_W, 0.0, along_W)
    square, offset_2, along, came_through = _least(list(zip(square_W, offset_W_2, along_W, crosses_W, strict=True)))

    gap = jnp.sqrt(jnp.abs(square))
    normal_2 = jnp.where(came_through, offset_2, offset_2 * (1.0 / jnp.maximum(gap, TINY)))
    normal_3 = jnp.concatenate([normal_2, jnp.zeros(1)])
    distance = jnp.where(came_through, -gap, gap) - WALL_RADIUS - radius
    on_axis_3 = foot_3 + along * (knee_3 - foot_3)
    return WallContact(distance, normal_3, on_axis_3 - normal_3 * (radius + 0.5 * distance))


def _dot(a_2: Any, b_2: Any) -> Any:
    return (a_2 * b_2).sum(-1)


def _least(rows: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Of each lane's rows the one whose first entry is least; of equal ones the first."""
    best = rows[0]
    for row in rows[1:]:
        less = row[0] < best[0]
        best = tuple(
            jnp.where(less if new.ndim == less.ndim else less[..., None], new, old)
            for new, old in zip(row, best, strict=True)
        )
    return best


def _cross(way_2: Any, from_2: Any) -> Any:
    """Positive to the left of the way, negative to its right."""
    return way_2[..., 0] * from_2[..., 1] - way_2[..., 1] * from_2[..., 0]
