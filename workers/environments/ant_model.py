"""Gymnasium's ant among walls as a model of C MuJoCo: the physics `mujoco` of AntMaze and AntTrap.

The ant, its timestep, its integrator and the settings of its contacts are those of `ant.xml` in Gymnasium's package.
Walls are boxes so tall that no ant comes to an upper edge. As with Brax's springs, the torso and the four lower legs
collide with them; the upper legs, which lie between these, do not.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Segment
from es_service.protocol.sources import MODEL_FILES
from workers.environments.ant_tasks import WALL_RADIUS
from workers.environments.gymnasium_task import gymnasium_package

SUBSTEPS = 5
"""Steps of the model in a control step, Gymnasium's `frame_skip`."""
TALL, DRAWN = 50.0, 0.5
"""Half the height of walls in metres: of those that ants meet, whose middle is on the floor, and of those in replays,
which stand on it."""
COLLIDERS = ("torso_geom", "left_ankle_geom", "right_ankle_geom", "third_ankle_geom", "fourth_ankle_geom")
"""Geoms of the ant that collide with walls."""
ONLY_FLOOR, ALSO_WALLS, WALL = "1", "3", "2"
"""Bits of what geoms of the ant collide with: the floor's is 1."""
COLOUR = "0.5 0.5 0.55 1"


def ant_model(walls: tuple[Segment, ...], drawn: bool = False) -> Any:
    """The model, a `mujoco.MjModel`. Geom `wall_0` is the first wall, and so on.

    Args:
        drawn: whether walls are as low as in replays, in which ants are seen behind them.

    Raises:
        TaskError: the package gymnasium, which has the file, is not installed.
        ValueError: a wall is not parallel to an axis.
    """
    return compiled(boxes_of(walls), drawn)


def compiled(box_W_4: NDArray, drawn: bool = False) -> Any:
    """As `ant_model`, of walls as `boxes_of` returns them."""
    assets = Path(gymnasium_package().__file__).parent / MODEL_FILES
    root = ElementTree.parse(assets / "ant.xml").getroot()
    world = root.find("worldbody")
    assert world is not None
    for geom in root.iterfind(".//body//geom"):
        geom.set("contype", ALSO_WALLS if geom.get("name") in COLLIDERS else ONLY_FLOOR)
    for number, (x, y, half_x, half_y) in enumerate(box_W_4.tolist()):
        size, pos = (half_x, half_y, DRAWN if drawn else TALL), (x, y, DRAWN if drawn else 0.0)
        texts = {key: " ".join(map(str, value)) for key, value in (("size", size), ("pos", pos))}
        kind = {"name": f"wall_{number}", "type": "box", "contype": "0", "conaffinity": WALL, "rgba": COLOUR}
        ElementTree.SubElement(world, "geom", kind | texts)
    mujoco: Any = importlib.import_module("mujoco")  # its module does not say what it contains
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


def boxes_of(walls: tuple[Segment, ...]) -> NDArray:
    """[W, 4] middle x and y, and half the extent along x and y, of the boxes of walls, in metres.

    Raises:
        ValueError: a wall is not parallel to an axis.
    """
    end_W_2_2 = np.array(walls, float).reshape(-1, 2, 2)
    half_W_2 = np.abs(end_W_2_2[:, 1] - end_W_2_2[:, 0]) / 2
    if (half_W_2 > 0).all(axis=1).any():
        raise ValueError(f"walls = {walls}: each must be parallel to an axis")
    return np.concatenate([end_W_2_2.mean(axis=1), half_W_2 + WALL_RADIUS], axis=1)


def first_qpos(model: Any) -> NDArray:
    """[15] positions of the model's `init_qpos`, from which Brax's ant begins, too: the feet are near the floor."""
    mujoco: Any = importlib.import_module("mujoco")
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "init_qpos")
    return model.numeric_data[model.numeric_adr[at] :][: model.nq].copy()
