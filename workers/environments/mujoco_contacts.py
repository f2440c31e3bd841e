"""Forces of the constraints of MuJoCo's models in JAX, of which few contacts are active at a time.

MJX has a place for each contact that may be, and its solver computes the rows of all of them. C MuJoCo has rows only of
active contacts, those of geoms nearer than their margin: Gymnasium's ant has 25 places, and in nearly all states four
active contacts at most.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from workers.environments.brax_parts import quietly

with quietly():
    from mujoco import mjx
    from mujoco.mjx._src import constraint, solver

AT_ONCE = 4
"""Active contacts of each `condim` that are solved without the places of the others, if there are more places."""


def solve(model: mjx.Model, data: Any, at_once: int = AT_ONCE) -> Any:
    """Data with the accelerations and the forces of the constraints, which `mjx.solver.solve` finds.

    The first `at_once` active contacts of each `condim` are solved without the other places. Only where more are
    active, all places are solved afterwards. Both solutions are the same but for rounding, since the rows of a contact
    that is not active are 0.

    Args:
        data: what `mjx.forward` has computed before it solves, contacts and their rows included.
    """
    contact = data._impl.contact
    groups = [np.flatnonzero(contact.dim == dim) for dim in np.unique(contact.dim)]
    counts = [min(at_once, len(group)) for group in groups]
    if not groups or len(contact.dim) < 2 * sum(counts):
        return solver.solve(model, data)
    active = contact.dist < contact.includemargin
    numbers = [jnp.cumsum(active[group].astype(jnp.int32)) for group in groups]
    places = [_first(number, count) for number, count in zip(numbers, counts, strict=True)]

    def chosen(x: Any) -> Any:
        return jnp.concatenate([x[group].at[at].get(mode="clip") for group, at in zip(groups, places, strict=True)])

    few = jax.tree.map(chosen, contact)
    is_one = jnp.concatenate([at < len(group) for group, at in zip(groups, places, strict=True)])
    few = few.replace(dist=jnp.where(is_one, few.dist, few.includemargin))
    dim = np.concatenate([contact.dim[group[:count]] for group, count in zip(groups, counts, strict=True)])
    found = _solve(model, data, few, dim)
    ends = np.append(contact.efc_address, data._impl.nefc)
    forces, first = [found._impl.efc_force[: ends[0]]], ends[0]
    for group, at in zip(groups, places, strict=True):
        rows = ends[group[0] + 1] - ends[group[0]]
        of_slots = found._impl.efc_force[first : first + rows * len(at)].reshape(len(at), rows)
        forces.append(jnp.zeros((len(group), rows)).at[at].set(of_slots, mode="drop").reshape(-1))
        first += rows * len(at)

    def with_all(carry: Any) -> Any:
        """Solved with all places. It carries where the contacts are, so that their rows are computed only here."""
        _, dist, pos, _ = carry
        after = _solve(model, data, contact.replace(dist=dist, pos=pos), contact.dim)
        after = after.qacc, after.qfrc_constraint, after._impl.efc_force
        return jnp.bool_(False), jnp.zeros_like(dist), jnp.zeros_like(pos), after

    more = jnp.stack([number[-1] > count for number, count in zip(numbers, counts, strict=True)]).any()
    results = found.qacc, found.qfrc_constraint, jnp.concatenate(forces)
    begun = more, contact.dist, contact.pos, results
    *_, (qacc, qfrc, forces) = jax.lax.while_loop(lambda carry: carry[0], with_all, begun)
    return data.tree_replace({"qacc": qacc, "qfrc_constraint": qfrc, "_impl.efc_force": forces})


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
    return solver.solve(model, constraint.make_constraint(model, data.tree_replace(contacts | sizes)))
