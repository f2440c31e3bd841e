"""MuJoCo models of Brax, Gymnasium and Playground, states of them, and one control step in C MuJoCo.

Only XML files of the three are read. Playground is no dependency: its files are found where `playground` is installed,
or in a folder that contains `mujoco_playground`.
"""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from workers.environments.c_mujoco import CStep, c_step, one_ulp, quantiles, relative_error
from workers.environments.mujoco_parts import MjModel, MujocoState, mujoco

__all__ = ["CStep", "c_step", "one_ulp", "quantiles", "relative_error"]

BRAX, GYMNASIUM = "brax/envs/assets", "gymnasium/envs/mujoco/assets"
PLAYGROUND = "mujoco_playground/_src/dm_control_suite/xmls"
OF_PLAYGROUND = {
    "cartpole": (0.01, 1),
    "walker": (0.0025, 10),
    "hopper": (0.005, 4),
    "cheetah": (0.01, 1),
    "humanoid": (0.005, 5),
    "swimmer": (0.003, 10),
    "reacher": (0.005, 4),
}
"""Name -> (seconds of a substep, substeps of a control step) that Playground 0.2.0's environments set."""
OF_GYMNASIUM = {
    "ant": ("ant", 5),
    "cartpole": ("inverted_pendulum", 2),
    "cheetah": ("half_cheetah", 5),
    "hopper": ("hopper", 4),
    "humanoid": ("humanoid", 5),
    "reacher": ("reacher", 2),
    "swimmer": ("swimmer", 4),
    "walker": ("walker2d_v5", 4),
}
"""Name -> (file, substeps of a control step, the `frame_skip` of Gymnasium's environments)."""
SWIMMER_LINKS = 6


class Example(NamedTuple):
    """A model, and how many of its steps a control step has."""

    model: MjModel
    substeps: int
    note: str = ""
    """What is not as its authors set it."""
    of_mjx: MjModel | None = None
    """What MJX gets, with `contacts`; None: the model itself."""
    contacts: Mapping[Any, Any] = MappingProxyType({})
    """As of `mujoco_parts.step_and_look`."""
    states: Callable[[int, int], MujocoState] | None = None
    """Function (number, seed) of states; None: those of `c_states`."""
    spring: str = ""
    """The same task with Brax's springs; empty if there is none."""


def folder_of(name: str, near: Path | None = None) -> Path | None:
    """Folder of a package's files, such as BRAX; None if it is not installed, nor below `near`."""
    package, _, rest = name.partition("/")
    if near is not None:
        return near / name if (near / name).is_dir() else None
    found = importlib.util.find_spec(package)
    return Path(found.submodule_search_locations[0]) / rest if found and found.submodule_search_locations else None


def set_solver(model: MjModel, iterations: int, line_search: int) -> MjModel:
    """A copy of a model with so many iterations of its solver, at most, and of each line search."""
    model = copy.copy(model)
    model.opt.iterations, model.opt.ls_iterations = iterations, line_search
    return model


def as_c(model: MjModel) -> MjModel:
    """A copy of a model with C MuJoCo's own solver settings: 100 iterations, 50 of the line search, tolerance 1e-8."""
    model, own = set_solver(model, 100, 50), mujoco.MjOption()
    model.opt.tolerance, model.opt.ls_tolerance = own.tolerance, own.ls_tolerance
    return model


def brax_ant(iterations: int = 1, line_search: int = 4) -> Example:
    """Brax's ant as its `mjx` backend sets it, or with other iterations."""
    folder = folder_of(BRAX)
    assert folder is not None
    model = set_solver(mujoco.MjModel.from_xml_path(str(folder / "ant.xml")), iterations, line_search)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return Example(model, 5)


def of_gymnasium(name: str) -> Example:
    """The model of one of Gymnasium's environments with its own settings."""
    file, substeps = OF_GYMNASIUM[name]
    folder = folder_of(GYMNASIUM)
    assert folder is not None
    model, note = mujoco.MjModel.from_xml_path(str(folder / f"{file}.xml")), ""
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        model.opt.solver, note = mujoco.mjtSolver.mjSOL_NEWTON, "solver Newton instead of PGS, which MJX lacks"
    return Example(model, substeps, note)


def of_playground(name: str, near: Path | None = None) -> Example | None:
    """The model of one of Playground's environments of the DM Control suite; None if its files are not there."""
    folder, (timestep, substeps) = folder_of(PLAYGROUND, near), OF_PLAYGROUND[name]
    if folder is None:
        return None
    xml = (folder / f"{name}.xml").read_text()
    model = mujoco.MjModel.from_xml_string(
        _swimmer(xml) if name == "swimmer" else xml,
        {file.name: file.read_bytes() for file in (folder / "common").iterdir()},
    )
    model.opt.timestep = timestep
    return Example(model, substeps)


def _swimmer(xml: str) -> str:
    """The swimmer of SWIMMER_LINKS bodies, as Playground's `swimmer.py` builds it, without its sensors."""
    root = ElementTree.fromstring(xml)
    parent, actuator = root.find("./worldbody/body"), ElementTree.SubElement(root, "actuator")
    assert parent is not None
    limit = 360.0 / SWIMMER_LINKS
    for link in range(SWIMMER_LINKS - 1):
        body = ElementTree.SubElement(parent, "body", name=f"segment_{link}", pos="0 .1 0")
        for kind in ("visual", "inertial"):
            ElementTree.SubElement(body, "geom", {"class": kind, "name": f"{kind}_{link}"})
        ElementTree.SubElement(body, "joint", name=f"joint_{link}", range=f"{-limit} {limit}")
        ElementTree.SubElement(actuator, "motor", name=f"motor_{link}", joint=f"joint_{link}")
        parent = body
    return ElementTree.tostring(root, encoding="unicode")


def first_qpos(model: MjModel) -> np.ndarray:
    """Positions from which a model's episodes begin: its `init_qpos`, its first key frame, or `qpos0`."""
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "init_qpos")
    if at >= 0 and model.numeric_size[at] == model.nq:
        return model.numeric_data[model.numeric_adr[at] :][: model.nq].copy()
    return model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()


def random_ctrl(model: MjModel, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, nu] controls, uniform between the bounds of each actuator, or -1 and 1."""
    low, high = np.where(model.actuator_ctrllimited[:, None] > 0, model.actuator_ctrlrange, [[-1.0, 1.0]]).T
    return rng.uniform(low, high, (count, model.nu)).astype(np.float32)


def c_states(model: MjModel, substeps: int, count: int, seed: int = 0, most_steps: int = 60) -> MujocoState:
    """`count` states of robots that fall, are pushed and move at random, by C MuJoCo, rounded to float32.

    A quarter each: after a few random control steps, in contact or about to be; pushed, with velocities of 1; with
    hinges and slides at a limit or just beyond, moving into it; and long driven, after up to `most_steps` of them.
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    rows, first = [], first_qpos(model)
    joints = np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))  # slides and hinges
    for number in range(count):
        kind = number % 4
        mujoco.mj_resetData(model, data)
        data.qpos[:] = first
        data.qvel[:] = rng.normal(0.0, 0.3, model.nv)
        data.qpos[model.jnt_qposadr[joints]] += rng.normal(0.0, 0.05, len(joints))
        steps = int(rng.integers(1, most_steps + 1)) if kind == 3 else int(rng.integers(0, 12))
        for _ in range(steps):
            data.ctrl[:] = random_ctrl(model, 1, rng)[0]
            mujoco.mj_step(model, data, substeps)
        if kind == 1:
            data.qvel[:] += rng.normal(0.0, 1.0, model.nv)
        if kind == 2:
            for j in joints[model.jnt_limited[joints] > 0]:
                side = int(rng.integers(0, 2))
                way = (-1.0, 1.0)[side]
                data.qpos[model.jnt_qposadr[j]] = model.jnt_range[j, side] + way * abs(rng.normal(0.0, 0.01))
                data.qvel[model.jnt_dofadr[j]] = way * abs(rng.normal(0.0, 1.0))
        rows.append((data.qpos.copy(), data.qvel.copy(), data.act.copy(), data.qacc_warmstart.copy(), data.time))
    return MujocoState(*(np.array(part, np.float32) for part in zip(*rows, strict=True)))
