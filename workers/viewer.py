"""The bodies of a task for replays: their shapes from the MuJoCo model, and their poses from a state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from es_service.protocol.recordings import Mesh, Scene, Shape

MESH = 7
"""MuJoCo's number of meshes among the kinds of geoms."""
KINDS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", MESH: "mesh"}
"""MuJoCo's number of a kind of geom or site -> its name. Others, such as height fields, are not drawn."""
HIDDEN_GROUP = 3
"""MuJoCo's viewers hide geoms and sites of this group and above."""
GREY = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default colour, in whose place that of the material is seen."""
MOST_TRIANGLES = 5_000
"""Meshes of more triangles are drawn as their convex hulls."""


class Viewer(NamedTuple):
    """Data of a task for replays in three dimensions."""

    model: Any
    """The MuJoCo model (`mj_model` of a Brax system)."""
    poses: Callable[[Any], Any]
    """Function from a state to the world frames of the links, a `brax.base.Transform` with axis [L]. Link i is body
    i + 1 of MuJoCo, whose body 0 is the world."""
    step_s: float
    """Seconds of a control step."""


def scene(viewer: Viewer) -> Scene:
    """What is seen of a task: its visible geoms and sites, as MuJoCo's viewers show them without textures."""
    model, notes = viewer.model, []
    shapes = (*_shapes(model, "geom"), *_shapes(model, "site"))
    meshes = {mesh: _mesh(model, mesh) for mesh in sorted({shape.mesh for shape in shapes if shape.mesh is not None})}
    if hulls := sum(int(model.mesh_facenum[mesh]) > MOST_TRIANGLES for mesh in meshes):
        notes.append(f"Meshes of more than {MOST_TRIANGLES:,} triangles are drawn as their convex hulls: {hulls}.")
    lacking = {
        "height fields": np.sum(model.geom_type == 1),
        "signed distance fields": np.sum(model.geom_type == 8),
        "tendons": np.sum(model.wrap_type[model.tendon_adr] != 1) if model.ntendon else 0,  # 1: a sum of joints
        "skins": model.nskin,
        "flexible bodies": model.nflex,
    }
    if any(lacking.values()):
        notes.append(f"Not drawn: {', '.join(f'{what} ({count})' for what, count in lacking.items() if count)}.")
    numbers = {mesh: number for number, mesh in enumerate(meshes)}
    placed = (shape if shape.mesh is None else shape._replace(mesh=numbers[shape.mesh]) for shape in shapes)
    return Scene(tuple(placed), tuple(meshes.values()), tuple(notes), viewer.step_s)


def _shapes(model: Any, of: str) -> Iterator[Shape]:
    """The visible geoms or sites of a model, with the model's number of a mesh."""
    kinds, groups, materials, bodies = (getattr(model, f"{of}_{name}") for name in ("type", "group", "matid", "bodyid"))
    sizes, places, turns, colours = (getattr(model, f"{of}_{name}") for name in ("size", "pos", "quat", "rgba"))
    for at, kind in enumerate(kinds):
        colour = _rounded(colours[at])
        if colour == GREY and materials[at] >= 0:
            colour = _rounded(model.mat_rgba[materials[at]])
        if kind in KINDS and groups[at] < HIDDEN_GROUP and colour[3] > 0:
            mesh = int(model.geom_dataid[at]) if kind == MESH else None
            size, place, turn = (_rounded(rows[at]) for rows in (sizes, places, turns))
            yield Shape(KINDS[int(kind)], int(bodies[at]) - 1, size, place, turn, colour, mesh)


def _rounded(row: Any) -> tuple[float, ...]:
    return tuple(round(float(x), 5) for x in row)


def _mesh(model: Any, mesh: int) -> Mesh:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices_V_3 = model.mesh_vert[first : first + count]
    triangles_F_3 = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    if len(triangles_F_3) > MOST_TRIANGLES:
        from scipy.spatial import ConvexHull  # the driver imports this module, and needs no hulls

        triangles_F_3 = ConvexHull(vertices_V_3, qhull_options="QJ").simplices
    used, triangles = np.unique(triangles_F_3, return_inverse=True)
    return Mesh(vertices_V_3[used], triangles.reshape(-1, 3).astype(np.int32))
