"""Gymnasium's environments of MuJoCo as tasks in JAX, such as `mujoco:Ant-v5`.

The models are the XML files of Gymnasium's package, and the physics is MJX's, with the timestep, the integrator and the
solver that the files name. The solver has the iterations of the files, unless the option `solver_iterations` says
otherwise. Observations, rewards, ends and resets are in `mujoco_gym_tasks.py`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Bounds, TaskSpec
from es_service.protocol.options import Option, OptionValue, choice
from workers.environments import Environment, TaskError
from workers.environments.brax_task import quietly
from workers.environments.c_mujoco import ControlStep
from workers.environments.gymnasium_task import gymnasium_package
from workers.environments.host_task import action_bounds
from workers.environments.mujoco_contacts import feet_of, touching
from workers.environments.mujoco_gym_parts import Feet, GymState, Parts, Simulated
from workers.environments.mujoco_gym_tasks import TASKS, GymTask
from workers.environments.mujoco_parts import (
    MjModel,
    forward,
    mujoco,
    mujoco_viewer,
    once,
    put_model,
    start,
    step_and_look,
)

FAR = 30.0
"""Bound of descriptors whose range is not specified, in metres or in the unit of the joint."""
JOINTS = 2
"""Most joints in the descriptor `final_joints`; they are the first joints of the model."""
FEET = "feet_contact"
"""The descriptor that is the share of control steps after which each foot touched the floor."""


def describe(name: str, given: Mapping[str, OptionValue] = MappingProxyType({})) -> TaskSpec:
    """Description of Gymnasium's environment `name` as a task.

    Args:
        given: values of options that are not the defaults; the size of an observation depends on them.

    Raises:
        TaskError: there is no such environment here, the package with its model is not installed, or a value of an
            option cannot be used.
    """
    task = _task(name)
    model = load(task)
    values: dict[str, Any] = dict(given)
    environment = make(name, **values)
    state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
    descriptors = {kind: (names, bounds) for kind, (names, bounds, _) in _descriptors(model).items()}
    names, bounds = next(iter(descriptors.values()))
    return TaskSpec(
        name=f"mujoco:{name}",
        observation_size=jax.eval_shape(environment.observe, state).shape[0],
        action_size=model.nu,
        episode_steps=task.episode_steps,
        descriptor_names=names,
        descriptor_bounds=bounds,
        final_fitness=False,
        has_goal=False,
        options={
            "descriptor": choice(*descriptors),
            "frame_skip": Option(task.frame_skip, low=1),
            "solver_iterations": Option(model.opt.iterations, low=1),
            **{key: _option(value) for key, value in _defaults(task).items()},
        },
        descriptors=descriptors,
        action_bounds=action_bounds(model.actuator_ctrlrange, model.nu),
        summary=f"{name} of Gymnasium, computed by MJX",
    )


def make(
    name: str,
    descriptor: str | None = None,
    frame_skip: int | None = None,
    solver_iterations: int | None = None,
    **options: Any,
) -> Environment:
    """Functions of Gymnasium's environment `name`.

    Args:
        descriptor: the first of the model if None.
        frame_skip: substeps of a control step; Gymnasium's if None.
        solver_iterations: most iterations of the solver of the constraints; those of the model if None. It ends earlier
            when it has converged.
        options: options of Gymnasium's environment.

    Raises:
        TaskError: as `describe`.
    """
    of = build(name, frame_skip, solver_iterations, **options)
    (model, mx, substeps, step_s), parts, at_once = of.simulated, of.parts, _task(name).at_once
    descriptors = _descriptors(model)
    kind = descriptor or next(iter(descriptors))
    *_, places = descriptors[kind]
    feet = feet_of(model) if kind == FEET else []
    low_A, high_A = jnp.asarray(model.actuator_ctrlrange, jnp.float32).T
    middle_A, half_A = 0.5 * low_A + 0.5 * high_A, 0.5 * high_A - 0.5 * low_A

    @once
    def reset(key: Any) -> GymState:
        counts = Feet(jnp.zeros(len(feet)), jnp.float32(0.0)) if feet else None
        return of.at(*parts.start(key))._replace(feet=counts)

    def ctrl(action: Any) -> Any:
        return jnp.clip(middle_A + half_A * action, low_A, high_A)

    @once
    def step(state: GymState, action: Any) -> tuple[GymState, Any, Any]:
        bounded_A = ctrl(action)

        def look(data: Any) -> Any:
            return parts.look(data, True), touching(model, data, feet)

        physics, (seen, touching_F) = step_and_look(mx, state.physics, bounded_A, substeps, look, at_once)
        counts = state.feet and Feet(state.feet.touched_F + touching_F, state.feet.steps + 1.0)
        after = GymState(physics, seen, counts)
        return after, *parts.outcome(state, after, bounded_A)

    def describe_state(state: GymState) -> Any:
        if state.feet is None:
            return state.physics.qpos[places]
        return state.feet.touched_F / jnp.maximum(state.feet.steps, 1.0)

    return Environment(
        reset,
        parts.observe,
        step,
        describe_state,
        lambda state: jnp.float32(jnp.nan),
        viewer=mujoco_viewer(model, mx, step_s, lambda state: state.physics),
        control_step=ControlStep(model, substeps, lambda state: state.physics, ctrl),
    )


class Built(NamedTuple):
    """An environment with values of its options."""

    simulated: Simulated
    parts: Parts

    def at(self, qpos: Any, qvel: Any) -> GymState:
        """A state with these positions [nq] and velocities [nv], as Gymnasium's `set_state` after a reset."""
        model, of_mjx, *_ = self.simulated
        physics = start(of_mjx, qpos, qvel)
        data = forward(of_mjx, physics, jnp.zeros(model.nu), solved=self.parts.solves_reset)
        return GymState(physics, self.parts.look(data, False))


def build(name: str, frame_skip: int | None = None, solver_iterations: int | None = None, **options: Any) -> Built:
    """Gymnasium's environment `name`; arguments as of `make`.

    MJX lacks PGS, the solver of the humanoids, and has Newton's method instead, which finds the same forces: in C
    MuJoCo, control steps by the two differ only as far as PGS has not converged in the 50 iterations of the files.
    """
    task = _task(name)
    model, substeps = load(task), frame_skip or task.frame_skip
    model.opt.iterations = solver_iterations or model.opt.iterations
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    simulated = Simulated(model, put_model(model), substeps, substeps * model.opt.timestep)
    defaults = _defaults(task)
    ranges = {key: _range(key, value) for key, value in options.items() if isinstance(defaults[key], tuple)}
    return Built(simulated, task.parts(simulated, **{**options, **ranges}))


def load(task: GymTask) -> MjModel:
    """C MuJoCo's model of an environment, from Gymnasium's package.

    Raises:
        TaskError: the package is not installed.
    """
    file = Path(gymnasium_package().__file__).parent / "envs" / "mujoco" / "assets" / task.file
    with quietly():
        return mujoco.MjModel.from_xml_path(str(file))


def _task(name: str) -> GymTask:
    if name in TASKS:
        return TASKS[name]
    near = get_close_matches(name, TASKS, n=1)
    hint = f"; did you mean mujoco:{near[0]}?" if near else ""
    raise TaskError(f"mujoco:{name} is not known; must be {', '.join(TASKS)}{hint}")


def _defaults(task: GymTask) -> dict[str, Any]:
    """Options of Gymnasium's environment and their defaults."""
    named = inspect.signature(task.parts).parameters.values()
    return {one.name: one.default for one in named if one.kind is one.KEYWORD_ONLY}


def _option(default: Any) -> Option:
    """A range has no default here, as with `gymnasium:ID`, since it may be infinite, which a config cannot say."""
    return Option(None if isinstance(default, tuple) else default)


def _range(key: str, value: Any) -> tuple[float, float]:
    """A range that a config gives.

    Raises:
        TaskError: it is none.
    """
    is_pair = isinstance(value, list) and len(value) == 2 and all(type(bound) in (int, float) for bound in value)
    if not is_pair or not -math.inf < value[0] <= value[1] < math.inf:
        raise TaskError(f"task.options.{key} = {value!r} is not allowed; must be two numbers [low, high]")
    return float(value[0]), float(value[1])


def _descriptors(model: MjModel) -> dict[str, tuple[tuple[str, ...], Bounds, Any]]:
    """Descriptors of a model: name -> (names of the dimensions, bounds, their places among the positions).

    The first is the default. `FEET` has no places.
    """
    descriptors: dict[str, tuple[tuple[str, ...], Bounds, Any]] = {}
    root, along = _root(model)
    for kind, axes in (("final_xy", "xy"), ("final_x", "x")):
        if along[: len(axes)] == axes:
            descriptors[kind] = tuple(axes), ((-FAR, FAR),) * len(axes), np.arange(len(axes))
    if root and (feet := len(feet_of(model))):  # what stands on a table is no foot
        descriptors[FEET] = tuple(f"foot_{number}" for number in range(1, feet + 1)), ((0.0, 1.0),) * feet, None
    if joints := min(JOINTS, model.nq - root):
        names = tuple(f"joint_{number}" for number in range(1, joints + 1))
        descriptors["final_joints"] = names, ((-FAR, FAR),) * joints, np.arange(root, root + joints)
    return descriptors


def _root(model: MjModel) -> tuple[int, str]:
    """(leading positions that are the place of a moving base, axes of the world along which the first of them move)."""
    kinds = model.jnt_type[model.jnt_bodyid == 1].tolist()
    if kinds[:1] == [mujoco.mjtJoint.mjJNT_FREE]:
        return 7, "xyz"
    slides = [at for at, kind in enumerate(kinds) if kind == mujoco.mjtJoint.mjJNT_SLIDE]
    along = "".join("xyz"[int(np.argmax(np.abs(model.jnt_axis[at])))] for at in slides)
    return (len(kinds) if slides else 0), along
