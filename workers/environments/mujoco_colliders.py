"""Contacts of two types of geoms that MJX finds otherwise than C MuJoCo."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from workers.environments.brax_task import quietly

with quietly():
    from mujoco.mjx._src import collision_driver, collision_primitive, math, types

SHORTEST = 1e-15
"""Least length of a vector that has a direction, in metres, as in C MuJoCo (`mjMINVAL`)."""
HALVINGS = 24
"""Halvings of a capsule's axis, after which a point is known to a float32 ulp of its length."""


@contextlib.contextmanager
def contacts_as_c(more: Mapping[Any, Any]) -> Iterator[None]:
    """Context manager in which MJX is traced with the contacts of C MuJoCo, and with more functions for contacts."""
    functions, kinds = collision_driver._COLLISION_FUNC, types.GeomType
    ours = {(kinds.PLANE, kinds.CAPSULE): _plane_capsule, (kinds.CAPSULE, kinds.CYLINDER): _capsule_cylinder}
    with quietly():
        before = dict(functions)
        functions.update({**ours, **more})
        try:
            yield
        finally:
            functions.update(before)


@collision_primitive.collider(ncon=2)
def _plane_capsule(plane: Any, capsule: Any) -> tuple[Any, Any, Any]:
    """Contacts of a plane with both ends of a capsule: distances, places and frames.

    The first tangent of the frame, on which the pyramid of friction depends, is along the capsule, as in C MuJoCo.
    MJX has another one for capsules that stand steeper than 60 degrees.
    """
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    flat = axis - normal * jnp.dot(normal, axis)
    length = jnp.sqrt(jnp.sum(flat**2))
    tangent = jnp.where(length > SHORTEST, flat / jnp.maximum(length, SHORTEST), jnp.eye(3)[0])
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    ends = jnp.stack([capsule.pos + axis * capsule.size[1], capsule.pos - axis * capsule.size[1]])
    distances = (ends - plane.pos) @ normal - capsule.size[0]
    places = ends - normal * (capsule.size[0] + 0.5 * distances)[:, None]
    return distances, places, jnp.stack([frame, frame])


@collision_primitive.collider(ncon=1)
def _capsule_cylinder(capsule: Any, cylinder: Any) -> tuple[Any, Any, Any]:
    """The contact of a capsule and a cylinder where they are nearest: distance, place and frame.

    MJX looks for two by a few steps of gradient descent. The signed distance to a cylinder is convex, so along the axis
    of a capsule its slope grows, and halving finds where it is 0. C MuJoCo has two contacts if the capsule lies on the
    cylinder, and if the axis is inside of it may push out in another direction.
    """
    radius, half, axis = capsule.size[0], capsule.size[1], capsule.mat[:, 2]
    centre, along = cylinder.mat.T @ (capsule.pos - cylinder.pos), cylinder.mat.T @ axis

    def halved(_: Any, bounds: tuple[Any, Any]) -> tuple[Any, Any]:
        low, high = bounds
        middle = 0.5 * (low + high)
        is_falling = jnp.dot(_from_cylinder(centre + middle * along, cylinder.size)[1], along) < 0.0
        return jnp.where(is_falling, middle, low), jnp.where(is_falling, high, middle)

    low, high = jax.lax.fori_loop(0, HALVINGS, halved, (-half, half))
    nearest = 0.5 * (low + high)
    distance, outwards = _from_cylinder(centre + nearest * along, cylinder.size)
    outwards = cylinder.mat @ outwards
    place = capsule.pos + nearest * axis - 0.5 * (radius + distance) * outwards
    return distance - radius, place, math.make_frame(-outwards)


def _from_cylinder(point: Any, size: Any) -> tuple[Any, Any]:
    """Signed distance of a point from a cylinder, and its gradient, in the frame of the cylinder.

    Args:
        size: radius and half the length of the cylinder.
    """
    away = jnp.sqrt(jnp.sum(point[:2] ** 2))
    radial = jnp.where(away > SHORTEST, jnp.append(point[:2] / jnp.maximum(away, SHORTEST), 0.0), jnp.eye(3)[0])
    axial = jnp.where(point[2] < 0.0, -1.0, 1.0) * jnp.eye(3)[2]
    beside, beyond = away - size[0], jnp.abs(point[2]) - size[1]
    corner = jnp.sqrt(beside**2 + beyond**2)
    is_corner = (beside > 0.0) & (beyond > 0.0)
    from_corner = (beside * radial + beyond * axial) / jnp.maximum(corner, SHORTEST)
    direction = jnp.where(beside > beyond, radial, axial)
    return jnp.where(is_corner, corner, jnp.maximum(beside, beyond)), jnp.where(is_corner, from_corner, direction)
