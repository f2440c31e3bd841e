"""Contacts of MuJoCo's models in JAX that MJX finds otherwise than C MuJoCo, those of two types of geoms, and the
forces of all constraints, which MJX finds more slowly and less exactly.

MJX has a place for each contact that may be, and its solver computes the rows of all of them. C MuJoCo has rows only of
active contacts, those of geoms nearer than their margin: Gymnasium's ant has 25 places, and in nearly all states four
active contacts at most.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from workers.environments.brax_task import quietly

with quietly():
    from mujoco import mjx
    from mujoco.mjx._src import (
        collision_driver,
        collision_primitive,
        constraint,
        math,
        solver,
        support,
        types,
    )

SHORTEST = 1e-15
"""Least length of a vector that has a direction, in metres, as in C MuJoCo (`mjMINVAL`)."""
HALVINGS = 24
"""Halvings of a capsule's axis, after which a point is known to a float32 ulp of its length."""
AT_ONCE = (4,)
"""Numbers of active contacts of each `condim` that are solved without the places of the others, if there are at least
twice as many places. An ant that walks has at most four, in nearly all states."""


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


def solve(model: mjx.Model, data: Any, at_once: Sequence[int] = AT_ONCE) -> Any:
    """Data with the accelerations and the forces of the constraints, which `mjx.solver.solve` looks for.

    The first of `at_once` active contacts of each `condim` are solved without the other places. Only where more are
    active, so many as the next number says are solved afterwards, and in the end all places. All solutions are the same
    but for rounding, since the rows of a contact that is not active are 0.

    Args:
        data: what `mjx.forward` has computed before it solves, contacts and their rows included.
        at_once: numbers of contacts, which grow. Those are left out that are more than half of the places.
    """
    contact = data._impl.contact
    groups = [np.flatnonzero(contact.dim == dim) for dim in np.unique(contact.dim)]
    fewer = [count for count in at_once if groups and 2 * sum(_counts(groups, count)) <= len(contact.dim)]
    if not fewer:
        return _converged(model, data)
    active = contact.dist < contact.includemargin
    numbers = [jnp.cumsum(active[group].astype(jnp.int32)) for group in groups]
    most = jnp.stack([number[-1] for number in numbers]).max()

    def solved(count: int, contact: Any) -> tuple[Any, Any, Any]:
        """Accelerations, the constraints' forces on them, and the forces of all rows."""
        if count == len(contact.dim):
            after = _solve(model, data, contact, contact.dim)
            return after.qacc, after.qfrc_constraint, after._impl.efc_force
        return _solved_of_few(model, data, contact, groups, numbers, count)

    results = solved(fewer[0], contact)
    for before, count in zip(fewer, [*fewer[1:], len(contact.dim)], strict=True):

        def again(carry: Any, count: int = count) -> Any:
            """Solved anew. It carries where the contacts are, so that their rows are computed only here."""
            _, dist, pos, _ = carry
            after = solved(count, contact.replace(dist=dist, pos=pos))
            return jnp.bool_(False), jnp.zeros_like(dist), jnp.zeros_like(pos), after

        wanted = (most > before) & (most <= count)
        begun = wanted, contact.dist, contact.pos, results
        *_, results = jax.lax.while_loop(lambda carry: carry[0], again, begun)
    qacc, qfrc, forces = results
    return data.tree_replace({"qacc": qacc, "qfrc_constraint": qfrc, "_impl.efc_force": forces})


def _counts(groups: Sequence[np.ndarray], count: int) -> list[int]:
    """How many contacts of each group are solved at once."""
    return [min(count, len(group)) for group in groups]


def _solved_of_few(
    model: mjx.Model,
    data: Any,
    contact: Any,
    groups: Sequence[np.ndarray],
    numbers: Sequence[Any],
    count: int,
) -> tuple[Any, Any, Any]:
    """What is solved with the first active contacts of each group.

    Args:
        groups: numbers of the places of each `condim`.
        numbers: as in `_first`, of each group.
        count: most contacts of each group.
    """
    counts = _counts(groups, count)
    places = [_first(number, least) for number, least in zip(numbers, counts, strict=True)]

    def chosen(x: Any) -> Any:
        return jnp.concatenate([x[group].at[at].get(mode="clip") for group, at in zip(groups, places, strict=True)])

    few = jax.tree.map(chosen, contact)
    is_one = jnp.concatenate([at < len(group) for group, at in zip(groups, places, strict=True)])
    few = few.replace(dist=jnp.where(is_one, few.dist, few.includemargin))
    dim = np.concatenate([contact.dim[group[:least]] for group, least in zip(groups, counts, strict=True)])
    found = _solve(model, data, few, dim)
    ends = np.append(contact.efc_address, data._impl.nefc)
    forces, first = [found._impl.efc_force[: ends[0]]], ends[0]
    for group, at in zip(groups, places, strict=True):
        rows = ends[group[0] + 1] - ends[group[0]]
        of_slots = found._impl.efc_force[first : first + rows * len(at)].reshape(len(at), rows)
        forces.append(jnp.zeros((len(group), rows)).at[at].set(of_slots, mode="drop").reshape(-1))
        first += rows * len(at)
    return found.qacc, found.qfrc_constraint, jnp.concatenate(forces)


def _first(numbers: Any, count: int) -> Any:
    """[count] places of the first, second ... active contact; the number of places if there is none.

    Args:
        numbers: [n] number of active contacts up to each place.
    """
    return jnp.sum(numbers < jnp.arange(1, count + 1)[:, None], axis=1)


def _solve(model: mjx.Model, data: Any, contact: Any, dim: np.ndarray) -> Any:
    """Data solved with some contacts.

    Args:
        contact: their contacts, sorted by `dim`.
        dim: [n] `condim` of each.
    """
    kinds = constraint.make_efc_type(model, dim)
    address = constraint.make_efc_address(model, dim, kinds)
    sizes = {"_impl.efc_type": kinds, "_impl.nefc": len(kinds), "_impl.ncon": len(dim)}
    contacts = {"_impl.contact": contact.replace(dim=dim, efc_address=address)}
    return _converged(model, constraint.make_constraint(model, data.tree_replace(contacts | sizes)))


def _converged(model: mjx.Model, data: Any) -> Any:
    """As `mjx.solver.solve`, with a step of Newton's method at the end, where float32 lets MJX end too early.

    A line search takes a step only if the cost falls by it. In float32 the cost has seven digits, so near the minimum,
    where it is flat, no step is seen to lower it, and accelerations may be wrong by 3e-4 of the greatest of them. The
    gradient tells more: the next step is taken if the gradient is smaller after it. A search that has used all
    iterations is left where it is, as in C MuJoCo.
    """
    if model.opt.solver != types.SolverType.NEWTON or model.opt.iterations == 1:
        return solver.solve(model, data)

    def at(qacc: Any) -> Any:
        return solver.Context.create(model, data.replace(qacc=qacc), grad=False)

    def turned(context: Any) -> Any:
        context = solver._update_gradient(model, data, context)
        return context.replace(search=-context.Mgrad)

    def iteration(context: Any) -> Any:
        context = solver._update_constraint(model, data, solver._linesearch(model, data, context))
        return turned(context).replace(solver_niter=context.solver_niter + 1)

    def goes_on(context: Any) -> Any:
        change, slope = context.prev_cost - context.cost, math.norm(context.grad)
        least = model.opt.tolerance * solver._trace_m(model, data)
        return (context.solver_niter < model.opt.iterations) & (change >= least) & (slope >= least)

    context = at(data.qacc_smooth)
    if not model.opt.disableflags & types.DisableBit.WARMSTART:
        warm = at(data.qacc_warmstart)
        context = jax.tree.map(lambda x, y: jnp.where(warm.cost < context.cost, x, y), warm, context)
    context = jax.lax.while_loop(goes_on, iteration, turned(context))
    step = context.search
    moved = context.replace(
        qacc=context.qacc + step,
        Ma=context.Ma + support.mul_m(model, data, step),
        Jaref=context.Jaref + data._impl.efc_J @ step,
    )
    moved = solver._update_constraint(model, data, moved)
    slope = math.norm(moved.Ma - data.qfrc_smooth - moved.qfrc_constraint)
    is_nearer = (slope < math.norm(context.grad)) & (context.solver_niter < model.opt.iterations)
    qacc, qfrc, force = (
        jnp.where(is_nearer, getattr(moved, name), getattr(context, name))
        for name in ("qacc", "qfrc_constraint", "efc_force")
    )
    return data.tree_replace({"qacc": qacc, "qfrc_constraint": qfrc, "_impl.efc_force": force})


def feet_of(model: Any) -> list[int]:
    """Bodies of an `MjModel` that have no children and can touch a floor, which is a plane of the world."""
    floors, bodies = _floors(model), model.geom_bodyid
    pairs = [(int(first), int(second)) for first, second, _ in collision_driver.geom_pairs(model)]
    near = {int(bodies[other]) for pair in pairs for geom, other in (pair, pair[::-1]) if geom in floors}
    return sorted(near - {*model.body_parentid.tolist()})


def touching(model: Any, data: Any, feet: list[int]) -> Any:
    """[F] 1 for each foot that has an active contact with a floor, which C MuJoCo would list, else 0."""
    if not feet:
        return jnp.zeros(0)
    contact, floors = data._impl.contact, np.array(sorted(_floors(model)))
    is_active, body_C_2 = contact.dist < contact.includemargin, jnp.asarray(model.geom_bodyid)[contact.geom]
    is_of_floor = is_active & (contact.geom[:, :, None] == floors).any(axis=(1, 2))
    return jnp.stack([(is_of_floor & (body_C_2 == foot).any(axis=1)).any() for foot in feet]).astype(jnp.float32)


def _floors(model: Any) -> set[int]:
    return {*np.flatnonzero((model.geom_type == types.GeomType.PLANE) & (model.geom_bodyid == 0)).tolist()}
