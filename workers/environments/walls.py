"""Contacts of ants with walls, which are upright and infinitely high, so that contacts are computed in the plane.

A wall is a segment in the plane, thickened by WALL_RADIUS. A collider is a segment thickened by its own radius: a lower
leg from foot to knee, or the torso, whose segment is a point. They touch where the two segments are closest. The normal
of a contact is horizontal and points from the wall to the collider, so no contact lifts an ant over a wall. Each
collider has one contact, with the wall nearest to it. The code avoids gathers and divisions, which compile badly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Segment
from workers.environments.ant_tasks import WALL_RADIUS

TINY = 1e-9
"""Least divisor, which avoids divisions by 0."""


class WallContact(NamedTuple):
    """Distance, normal and position of a collider's contact with its nearest wall."""

    distance: Any
    """Distance between the two surfaces in metres; negative in contact."""
    normal_3: Any
    """Horizontal unit vector from the wall to the collider."""
    position_3: Any
    """Point half-way between the surfaces, at the height of the collider's closest point."""


class WallRows(NamedTuple):
    start_W_2: Any
    end_W_2: Any
    way_W_2: Any
    """From the start to the end."""
    inverse_W: Any
    """1 / length**2."""
    root_W: Any
    """1 / length."""
    across_W_2: Any
    """Unit vector to the left of the way."""


def wall_rows(walls: tuple[Segment, ...]) -> WallRows:
    """Walls, given by their ends, as arrays of NumPy."""
    ends = np.array(walls, np.float32)
    way_W_2 = ends[:, 1] - ends[:, 0]
    inverse_W = 1.0 / (way_W_2**2).sum(-1)
    root_W = np.sqrt(inverse_W)
    across_W_2 = np.stack([-way_W_2[:, 1], way_W_2[:, 0]], -1) * root_W[:, None]
    return WallRows(ends[:, 0], ends[:, 1], way_W_2, inverse_W, root_W, across_W_2)


def walls_near(walls: WallRows, point_2: Any, count: int) -> WallRows:
    """The walls whose middle lines are nearest to a point, the nearest first; of equal ones the first in the list.

    An ant that is far from all others meets no other wall in a control step, so colliders need to look at no others.
    """
    share_W = jnp.clip(_dot(point_2 - walls.start_W_2, walls.way_W_2) * walls.inverse_W, 0.0, 1.0)
    offset_W_2 = point_2 - walls.start_W_2 - share_W[:, None] * walls.way_W_2
    near = jax.lax.top_k(-_dot(offset_W_2, offset_W_2), count)[1]
    return WallRows(*(jnp.asarray(field)[near] for field in walls))


def nearest_wall(walls: WallRows, foot_3: Any, knee_3: Any, radius: Any) -> WallContact:
    """Contact of one collider with the nearest of several walls.

    Two segments that do not cross are closest at an end of one of them. If they cross, the gap is minus the distance by
    which the foot has passed the wall, and the normal points to the side of the knee.

    Args:
        walls: as arrays.
        foot_3, knee_3: ends of the collider's axis; equal for a sphere. Of equally near pairs of points the one at the
            foot is taken, and of equally near walls the first in the list.
        radius: radius of the collider.
    """
    start_W_2, end_W_2, way_W_2, inverse_W, root_W, across_W_2 = walls
    foot_2, knee_2 = foot_3[:2], knee_3[:2]
    leg_2 = knee_2 - foot_2
    inverse_leg = 1.0 / jnp.maximum(_dot(leg_2, leg_2), TINY)

    # The four candidates of each wall: the foot, the knee and the wall's two ends, each with the other segment.
    candidates = []
    for point_2, along in ((foot_2, 0.0), (knee_2, 1.0)):
        share_W = jnp.clip(_dot(point_2 - start_W_2, way_W_2) * inverse_W, 0.0, 1.0)
        candidates.append((point_2 - start_W_2 - share_W[:, None] * way_W_2, jnp.full(len(start_W_2), along)))
    for tip_W_2 in (start_W_2, end_W_2):
        share_W = jnp.clip(_dot(tip_W_2 - foot_2, leg_2) * inverse_leg, 0.0, 1.0)
        candidates.append((foot_2 + share_W[:, None] * leg_2 - tip_W_2, share_W))
    square_W, offset_W_2, along_W = least([(_dot(offset, offset), offset, along) for offset, along in candidates])

    # The nearest wall is the one with the least square of the gap; the square is negative if the foot has passed it.
    side_foot_W, side_knee_W = _cross(way_W_2, foot_2 - start_W_2), _cross(way_W_2, knee_2 - start_W_2)
    ends_apart_W = _cross(leg_2, start_W_2 - foot_2) * _cross(leg_2, end_W_2 - foot_2) < 0
    crosses_W = (side_foot_W * side_knee_W < 0) & ends_apart_W
    through_W = side_foot_W * root_W
    square_W = jnp.where(crosses_W, -through_W * through_W, square_W)
    offset_W_2 = jnp.where(crosses_W[:, None], across_W_2 * jnp.sign(side_knee_W)[:, None], offset_W_2)
    along_W = jnp.where(crosses_W, 0.0, along_W)
    square, offset_2, along, came_through = least(list(zip(square_W, offset_W_2, along_W, crosses_W, strict=True)))

    gap = jnp.sqrt(jnp.abs(square))
    normal_2 = jnp.where(came_through, offset_2, offset_2 * (1.0 / jnp.maximum(gap, TINY)))
    normal_3 = jnp.concatenate([normal_2, jnp.zeros(1)])
    distance = jnp.where(came_through, -gap, gap) - WALL_RADIUS - radius
    on_axis_3 = foot_3 + along * (knee_3 - foot_3)
    return WallContact(distance, normal_3, on_axis_3 - normal_3 * (radius + 0.5 * distance))


def _dot(a_2: Any, b_2: Any) -> Any:
    return (a_2 * b_2).sum(-1)


def least(rows: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Row whose first entry is least, element by element; of equal ones the first row."""
    best = rows[0]
    for row in rows[1:]:
        less = row[0] < best[0]
        best = tuple(
            jnp.where(less if new.ndim == less.ndim else less[..., None], new, old)
            for new, old in zip(row, best, strict=True)
        )
    return best


def _cross(way_2: Any, from_2: Any) -> Any:
    """Cross product of two vectors in the plane; positive if `from_2` is to the left of `way_2`."""
    return way_2[..., 0] * from_2[..., 1] - way_2[..., 1] * from_2[..., 0]
