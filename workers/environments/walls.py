"""Walls for ants: upright, without ends to climb over, met by capsules and spheres in the plane.

A wall is a plane segment thickened by WALL_RADIUS, a collider one thickened by its own radius: a lower leg from knee to
foot, or the torso, whose segment is a point. They touch where the two segments are closest. A contact's normal is
horizontal and points from the wall to the collider, so that nothing lifts an ant over a wall. Each collider has one
contact, with the wall nearest to it. No gathers and no loops: everything is selected, for compilers to come.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

WALL_RADIUS = 0.5
TINY = 1e-9

Segment = tuple[tuple[float, float], tuple[float, float]]


class WallContact(NamedTuple):
    """Where a collider meets, or misses, its nearest wall; leading axes as the collider's."""

    distance: Any
    """Between the two surfaces, metres; negative in contact."""
    normal_3: Any
    """Horizontal unit vector from the wall to the collider."""
    position_3: Any
    """Half-way between the surfaces, at the height of the collider's closest point."""


def nearest_wall(walls: tuple[Segment, ...], foot_3: Any, knee_3: Any, radius: float) -> WallContact:
    """The contact of one collider with the nearest of some walls.

    Args:
        foot_3, knee_3: ends of the collider's axis; equal for a sphere. Of equally near pairs of points the foot's is
            taken, then that of the wall first in the list.
        radius: of the collider.
    """
    best = None
    for wall in walls:
        found = _closest(wall, foot_3, knee_3)
        best = found if best is None else _nearer(found, best)
    assert best is not None
    gap, along, normal_2 = best
    distance = gap - WALL_RADIUS - radius
    normal_3 = jnp.stack([normal_2[0], normal_2[1], jnp.zeros_like(gap)])
    return WallContact(distance, normal_3, foot_3 + along * (knee_3 - foot_3) - normal_3 * (radius + 0.5 * distance))


def _closest(wall: Segment, foot_3: Any, knee_3: Any) -> tuple[Any, Any, Any]:
    """(gap between the axes, where on the collider's from foot 0 to knee 1, unit normal [2]) for one wall.

    Two segments that do not cross are closest at an end of one of them. Where they cross, the gap is how far the foot
    has come through, negative, and the normal points to the knee's side.
    """
    start_2, end_2 = (jnp.array(point, jnp.float32) for point in wall)
    foot_2, knee_2 = foot_3[:2], knee_3[:2]
    zero, one = jnp.float32(0.0), jnp.float32(1.0)
    candidates = [
        (foot_2 - _on(start_2, end_2, foot_2)[1], zero),
        (knee_2 - _on(start_2, end_2, knee_2)[1], one),
    ]
    for corner_2 in (start_2, end_2):
        along, point_2 = _on(foot_2, knee_2, corner_2)
        candidates.append((point_2 - corner_2, along))
    best = None
    for offset_2, along in candidates:
        square = offset_2[0] * offset_2[0] + offset_2[1] * offset_2[1]
        found = (square, along, offset_2)
        best = found if best is None else _nearer(found, best)
    assert best is not None
    square, along, offset_2 = best
    gap = jnp.sqrt(square)

    side_foot, side_knee = _side(start_2, end_2, foot_2), _side(start_2, end_2, knee_2)
    crosses = (side_foot * side_knee < 0) & (_side(foot_2, knee_2, start_2) * _side(foot_2, knee_2, end_2) < 0)
    across_2 = jnp.array([-(end_2[1] - start_2[1]), end_2[0] - start_2[0]]) / jnp.sqrt(jnp.sum((end_2 - start_2) ** 2))
    normal_2 = jnp.where(crosses, across_2 * jnp.sign(side_knee), offset_2 / jnp.maximum(gap, TINY))
    through = -jnp.abs(jnp.sum(across_2 * (foot_2 - start_2)))
    return jnp.where(crosses, through, gap), jnp.where(crosses, 0.0, along), normal_2


def _on(start_2: Any, end_2: Any, point_2: Any) -> tuple[Any, Any]:
    """(where along it from 0 to 1, the point itself) of the segment's point nearest to `point_2`."""
    way_2 = end_2 - start_2
    length = way_2[0] * way_2[0] + way_2[1] * way_2[1]
    from_2 = point_2 - start_2
    along = jnp.clip((from_2[0] * way_2[0] + from_2[1] * way_2[1]) / jnp.maximum(length, TINY), 0.0, 1.0)
    return along, start_2 + along * way_2


def _side(start_2: Any, end_2: Any, point_2: Any) -> Any:
    """Positive to the left of the line, negative to its right."""
    way_2, from_2 = end_2 - start_2, point_2 - start_2
    return way_2[0] * from_2[1] - way_2[1] * from_2[0]


def _nearer(found: tuple[Any, Any, Any], best: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Whichever has the smaller first element; the earlier one of equals."""
    better = found[0] < best[0]
    first, along, vector_2 = (jnp.where(better, new, old) for new, old in zip(found, best, strict=True))
    return first, along, vector_2
