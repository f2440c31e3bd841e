"""The ant of AntMaze and AntTrap in MuJoCo's physics, by MJX: `task.options.physics: mujoco` or `mujoco_euler`.

The model is that of `ant_model.py`, which C MuJoCo steps in `gymnasium:es_service/AntMazeMujoco-v0` and
`AntTrapMujoco-v0`. An episode begins as with Brax's springs, with the same positions and velocities of the joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Segment
from workers.environments.ant import Ant, joint_noise
from workers.environments.ant_model import SUBSTEPS, ant_model, boxes_of, compiled, first_qpos
from workers.environments.ant_tasks import FORCE_LIMIT, JOINTS, STEP_S
from workers.environments.brax_task import quietly
from workers.environments.mujoco_contacts import AT_ONCE
from workers.environments.mujoco_parts import (
    MujocoState,
    mjx,
    mujoco,
    mujoco_viewer,
    once,
    put_model,
    start,
    step_and_look,
)
from workers.environments.walls import least

# Contacts of spheres and capsules with walls that are upright boxes, as C MuJoCo finds them, in MJX.
#
# C MuJoCo looks for contacts of each collider with every wall, and solves those that it finds. MJX has places for all
# contacts that there may be. Here each collider has places for its SLOTS nearest walls only; no collider of an ant
# reaches more of them. The model of MJX has SLOTS boxes in place of its walls, whose sizes and places do not matter.
#
# The walls are so tall that their upper and lower faces never count, so distances and normals are those of rectangles
# in the plane. A sphere has one contact with a box. A capsule has one where its axis comes nearest to the box, at one
# of its ends or at an edge of the box, and perhaps a second one: where the axis leaves the face or the edge of the
# first, or ends (`mjc_SphereBox` and `mjc_CapsuleBox` of MuJoCo, by their results).

with quietly():
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, math, types

SLOTS = 2
"""Walls, at most, with which one collider has contacts."""
FAR = 1e3
"""Distance of a contact that is none, in metres."""
TINY = 1e-12
"""Least divisor, which avoids divisions by 0."""
CORNERS = ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
FACES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
"""Normals into a rectangle of its faces."""

Kinds = tuple[types.GeomType, types.GeomType]
Contacts = tuple[Any, Any, Any]
"""Distances of surfaces [n], positions [n, 3] and frames [n, 3, 3], whose first rows point into the wall."""


def wall_contacts(box_W_4: NDArray) -> Mapping[Kinds, Any]:
    """Functions with which MJX finds contacts with walls, for pairs of a sphere or a capsule and a box.

    Args:
        box_W_4: middle x and y, and half the extent along x and y, of each wall.
    """
    box = types.GeomType.BOX
    functions = {types.GeomType.SPHERE: (1, _sphere), types.GeomType.CAPSULE: (2, _capsule)}
    return {(kind, box): _collider((kind, box), box_W_4, *function) for kind, function in functions.items()}


def _collider(kinds: Kinds, box_W_4: NDArray, count: int, contacts: Callable[..., Contacts]) -> Any:
    """A function of MJX's form, of a function that finds `count` contacts of a geom with one box."""
    slots = min(SLOTS, len(box_W_4))

    def collide(model: mjx.Model, data: Any, key: Any, geom: Any) -> Contacts:
        pairs = [pair[:2] for pair in collision_driver.geom_pairs(model) if _kinds(model, pair) == kinds]
        geoms, boxes = (sorted({pair[side] for pair in pairs}) for side in (0, 1))
        assert pairs == [(one, other) for one in geoms for other in boxes], "each collider meets each slot, in order"
        assert len(boxes) == slots
        at = np.array(geoms)

        def of_geom(pos: Any, mat: Any, size: Any) -> Contacts:
            # a sphere is a capsule without a length
            half_way = mat[:, 2] * (size[1] if count > 1 else 0.0)
            near_S_4 = nearest_boxes(box_W_4, pos[:2], half_way[:2], slots)
            return jax.vmap(lambda near_4: contacts(pos, half_way, size[0], near_4))(near_S_4)

        found = jax.vmap(of_geom)(data.geom_xpos[at], data.geom_xmat[at], model.geom_size[at])
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), found)

    collide.ncon = count  # pyright: ignore[reportFunctionMemberAccess]
    return collide


def _kinds(model: mjx.Model, pair: tuple[int, int, int]) -> Kinds:
    first, second = model.geom_type[list(pair[:2])]
    return types.GeomType(first), types.GeomType(second)


def nearest_boxes(box_W_4: NDArray, middle_2: Any, half_way_2: Any, count: int) -> Any:
    """The boxes [count, 4] nearest to a segment in the plane, nearest first; of equally near ones the first."""
    best = [(jnp.float32(jnp.inf), jnp.zeros(4))] * count
    for box_4 in box_W_4.astype(np.float32):
        new = _nearest_point(middle_2 - box_4[:2], half_way_2, box_4[2:])[0], jnp.asarray(box_4)
        for place, old in enumerate(best):
            is_less = new[0] < old[0]
            best[place], new = jax.tree.map(partial(jnp.where, is_less), (new, old), (old, new))
    return jnp.stack([box_4 for _, box_4 in best])


def _nearest_point(middle_2: Any, half_way_2: Any, half_2: Any) -> tuple[Any, ...]:
    """Where the axis of a capsule comes nearest to a rectangle about the origin.

    Returns:
        Square of the distance; place on the axis, from -1 to 1; whether an end of the axis is beyond a face across x,
        and across y [2]; the corner, as signs [2], or zeros if it is an end that is nearest
    """
    inverse = 1.0 / jnp.maximum(jnp.sum(half_way_2**2), TINY)
    rows: list[tuple[Any, ...]] = []
    for place in (-1.0, 1.0):
        end_2 = middle_2 + place * half_way_2
        beyond_2 = jnp.abs(end_2) - half_2
        out_2 = beyond_2 > 0
        square = jnp.sum(jnp.where(out_2, beyond_2, 0.0) ** 2)
        # beyond two faces a corner is at least as near
        rows.append((jnp.where(out_2.all(), jnp.inf, square), jnp.float32(place), out_2, jnp.zeros(2)))
    for corner in CORNERS:
        way_2 = np.array(corner, np.float32) * half_2 - middle_2
        place = jnp.clip(jnp.sum(way_2 * half_way_2) * inverse, -1.0, 1.0)
        square = jnp.sum((way_2 - place * half_way_2) ** 2)
        rows.append((square, place, jnp.zeros(2, bool), jnp.asarray(corner, jnp.float32)))
    return least(rows)


def _capsule(pos: Any, half_way: Any, radius: Any, box_4: Any) -> Contacts:
    middle_2, half_2, way_2 = pos[:2] - box_4[:2], box_4[2:], half_way[:2]
    _, place, out_2, corner_2 = _nearest_point(middle_2, way_2, half_2)
    steep_2 = jnp.maximum(jnp.abs(way_2), TINY)

    # from an end beyond a face, the second contact is where the axis is no longer above the face, or the other end
    towards = -place
    from_2 = (middle_2 + place * way_2) * jnp.sign(way_2) * towards
    room_2 = jnp.where(out_2, 2.0, (half_2 - from_2) / steep_2)
    along_face = towards * jnp.minimum(2.0, jnp.min(room_2))

    # from an edge, it is in the direction in which the axis goes along the face to which it is more nearly parallel
    inwards_2 = (way_2 > 0) != (corner_2 > 0)
    is_x = steep_2[0] > steep_2[1]
    towards = jnp.where(jnp.where(is_x, inwards_2[0], inwards_2[1]), 1.0, -1.0)
    room = jnp.where(is_x, half_2[0] / steep_2[0], half_2[1] / steep_2[1])
    along_edge = towards * jnp.minimum(1.0 - towards * place, 2.0 * room)

    is_edge = corner_2[0] != 0
    has_second = jnp.where(is_edge, inwards_2[0] != inwards_2[1], out_2.any())
    second = place + jnp.where(is_edge, along_edge, along_face)
    dist, position, frame = jax.vmap(lambda at: _ball(pos + at * half_way, radius, box_4))(jnp.stack([place, second]))
    return jnp.where(jnp.stack([True, has_second]), dist, FAR), position, frame


def _sphere(pos: Any, half_way: Any, radius: Any, box_4: Any) -> Contacts:
    return jax.tree.map(lambda x: x[None], _ball(pos, radius, box_4))


def _ball(pos: Any, radius: Any, box_4: Any) -> Contacts:
    middle_2, half_2 = pos[:2] - box_4[:2], box_4[2:]
    way_2 = jnp.clip(middle_2, -half_2, half_2) - middle_2
    apart = jnp.sqrt(jnp.sum(way_2**2))
    depths = [
        (half_2[0] + middle_2[0]),
        (half_2[0] - middle_2[0]),
        (half_2[1] + middle_2[1]),
        (half_2[1] - middle_2[1]),
    ]
    depth, face_2 = least([(depth, jnp.array(face)) for depth, face in zip(depths, FACES, strict=True)])
    is_inside = apart == 0
    apart, normal_2 = (
        jnp.where(is_inside, -depth, apart),
        jnp.where(is_inside, face_2, way_2 / jnp.maximum(apart, TINY)),
    )
    normal = jnp.concatenate([normal_2, jnp.zeros(1)])
    return apart - radius, pos + 0.5 * (radius + apart) * normal, math.make_frame(normal)


class MujocoAntState(NamedTuple):
    """State of one ant between two control steps."""

    physics: MujocoState
    force: Any
    """[14, 6] torque and force of the contacts on each body, as C MuJoCo's `cfrc_ext`: about the ant's centre of mass,
    along the axes of the world, in the last computation of forces in the control step. 0 after a reset."""

    @property
    def q(self) -> Any:
        """[15] torso position, torso quaternion, joint angles."""
        return self.physics.qpos

    @property
    def qd(self) -> Any:
        """[14] velocities of the torso and of the joints."""
        return self.physics.qvel


def make_ant(walls: tuple[Segment, ...] = (), integrator: str = "RK4", at_once: Sequence[int] = AT_ONCE) -> Ant:
    """Build the ant of a task.

    Args:
        integrator: that of the model, `RK4`, or `Euler`.
        at_once: as in `mujoco_contacts.solve`.

    Raises:
        TaskError: the package gymnasium, which has the ant's model, is not installed.
    """
    box_W_4 = boxes_of(walls)
    model = compiled(box_W_4[:SLOTS])
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    mx, contacts, init_q = put_model(model), wall_contacts(box_W_4) if walls else {}, first_qpos(model)

    def reset(key: Any, at: tuple[float, float]) -> MujocoAntState:
        noise = joint_noise(key)
        q = jnp.asarray(init_q, jnp.float32).at[7:].add(noise[:JOINTS]).at[:2].set(jnp.array(at, jnp.float32))
        qd = jnp.zeros(model.nv, jnp.float32).at[6:].set(noise[JOINTS:])
        return MujocoAntState(start(mx, q, qd), jnp.zeros((model.nbody, 6)))

    def look(data: Any) -> Any:
        found: Any = mjx.rne_postconstraint(mx, data)
        return found._impl.cfrc_ext

    @once
    def step(state: MujocoAntState, action: Any) -> MujocoAntState:
        ctrl = jnp.clip(action, -1.0, 1.0)
        return MujocoAntState(*step_and_look(mx, state.physics, ctrl, SUBSTEPS, look, at_once, contacts))

    viewer = mujoco_viewer(ant_model(walls, drawn=True), mx, STEP_S, lambda state: state.physics)
    return Ant(reset, step, viewer, lambda state: jnp.clip(state.force.ravel(), -FORCE_LIMIT, FORCE_LIMIT))
