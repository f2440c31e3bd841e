"""The bodies of a task for replays: their shapes from the MuJoCo model, and their poses from a state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from es_service.protocol.recordings import Shape

KINDS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box"}
"""MuJoCo's number of a kind of geom -> its name. Others, such as meshes, are not shown."""
HIDDEN_GROUP = 3
"""MuJoCo's viewers hide geoms of this group and above."""


class Viewer(NamedTuple):
    """Data of a task for replays in three dimensions."""

    model: Any
    """The MuJoCo model (`mj_model` of a Brax system)."""
    poses: Callable[[Any], Any]
    """Function from a state to the world frames of the links, a `brax.base.Transform` with axis [L]."""
    step_s: float
    """Seconds of a control step."""


def shapes(model: Any) -> tuple[Shape, ...]:
    """The visible geoms of a MuJoCo model. Link i of Brax is body i + 1 of MuJoCo, whose body 0 is the world."""
    return tuple(
        Shape(
            KINDS[int(model.geom_type[geom])],
            int(model.geom_bodyid[geom]) - 1,
            *(
                tuple(round(float(x), 5) for x in rows[geom])
                for rows in (model.geom_size, model.geom_pos, model.geom_quat, model.geom_rgba)
            ),
        )
        for geom in range(model.ngeom)
        if model.geom_type[geom] in KINDS and model.geom_group[geom] < HIDDEN_GROUP and model.geom_rgba[geom][3] > 0
    )
