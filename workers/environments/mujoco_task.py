"""Classes of users with a model of MuJoCo as tasks, named `package.module:Class`. A class must have:

    class Class:
        model = "robot.xml"       # a file in MJCF beside the class's own, or the XML itself, an MjSpec, an MjModel
        frame_skip: int           # steps of the model in a control step
        episode_steps: int
        descriptor_names: tuple[str, ...]
        descriptor_bounds: tuple[tuple[float, float], ...]

        def reward(self, data): ...      # -> reward of a control step; `data` is the `mjx.Data` after it
        def descriptor(self, data): ...  # -> descriptor [len(descriptor_names)] of an episode that ends here

It may also have:

- `done(self, data)`: whether the episode ends here, as bool;
- `observe(self, data)`: the observation, one array of any length; else positions, velocities and activations;
- `reset(self, key)`: positions [nq] and velocities [nv] of a new episode from a stream key, of which
  `es_service.protocol.noise.uniforms(key, counters)` makes random numbers; else those of the model's first key frame,
  or its `qpos0` and 0;
- a second parameter of `reward` and `done`, `reward(self, data, earlier)`: the data before the control step;
- `goal_distance(self, data)`, and `success(self, data, before)`, where `before` is the answer for the state before;
- `metric_names` and `metrics(self, data)`, as many numbers of an episode that ends here, as in `user_task.py`;
- `options`, `final_fitness`, `walls`, `wall_clearance`, `goal`, `least_reward` and a docstring, as in `user_task.py`;
  `model` may be a property that depends on options.

`data` is what `mujoco.mj_forward` computes in the state, with the controls of the control step (0 after a reset): also
positions of bodies and sites, contacts, sensors. What no function uses is not computed. `self.mj_model` is the compiled
`mujoco.MjModel`, which knows names: `data.site_xpos[self.mj_model.site("hand").id]`.

An action of -1 or 1 is a bound of its actuator (`ctrlrange`, or -1 and 1), and what is beyond is clipped. The model's
own options decide on timestep, integrator and solver. The functions are pure functions that JAX can trace, as in
`user_task.py`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue, declared_options, option_values
from es_service.protocol.sources import files_read, model_files, modules_of
from workers.environments import Environment, TaskError
from workers.environments.c_mujoco import ControlStep
from workers.environments.declared import (
    OF_EVERY_CLASS,
    construct,
    missing_names,
    task_of_class,
    unknown_attributes,
    wrong_values,
)
from workers.environments.mujoco_parts import (
    MjModel,
    MujocoState,
    forward,
    mujoco,
    mujoco_viewer,
    put_model,
    start,
    step,
)
from workers.environments.user_task import reset_of, shown, tracing, wrong_types

ATTRIBUTES = {"frame_skip": int, "episode_steps": int, "descriptor_names": tuple, "descriptor_bounds": tuple}
NEEDED = ("model", *ATTRIBUTES, "reward", "descriptor")
EARLIER = "earlier"
"""An argument that a function may do without."""
ARGUMENTS = {
    **dict.fromkeys(("reward", "done"), ("data", EARLIER)),
    **dict.fromkeys(("descriptor", "observe", "goal_distance", "metrics"), ("data",)),
    "success": ("data", "before"),
    "reset": ("key",),
}
"""Function of a class -> what it is called with."""
CONDITIONS = ("done", "success")
"""Functions that return bool."""
KNOWN = (*NEEDED, *OF_EVERY_CLASS, "done", "observe", "reset")


class TaskState(NamedTuple):
    """State of a task between two control steps, and what the user's functions say of it."""

    physics: MujocoState
    ctrl: Any
    """[nu] controls of the control step before it; 0 after a reset."""
    observation_O: Any
    descriptor_B: Any
    goal_distance: Any
    successes_2: Any
    """Whether an episode that ends here has succeeded, if it would not have, and if it would have, a step before."""
    metrics_M: Any = None
    """None if the class has no metrics."""


def describe(path: str, task: Any, given: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of a user's class with a model as a task.

    Args:
        task: the class.
        given: values of options that are not the defaults; sizes and the model may depend on them.

    Raises:
        TaskError: its attributes, its model or its functions are missing or wrong.
    """
    if missing := missing_names(task, NEEDED, "workers/environments/mujoco_task.py lists what a task must have"):
        raise TaskError(f"{path}{missing}")
    options, wrong = declared_options(task)
    wrong += wrong_types(task, ATTRIBUTES)
    if not wrong:
        wrong += wrong_values(task, task.descriptor_names, task.descriptor_bounds, ("frame_skip", "episode_steps"))
    if wrong:
        raise TaskError(f"{path}: {'; '.join(wrong)}")
    with tracing(path):
        environment = make(path, task, option_values(options, given))
        state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
        jax.eval_shape(environment.step, state, jax.ShapeDtypeStruct(state.ctrl.shape, jnp.float32))
    sizes = {"observation_size": state.observation_O.size, "action_size": state.ctrl.size, "__doc__": task.__doc__}
    sized = type(task.__name__, (task,), sizes)
    bounds = task.descriptor_names, task.descriptor_bounds
    return replace(task_of_class(path, sized, "jax", bounds, options), notes=unknown_attributes(path, task, KNOWN))


def make(path: str, task: Any, options: Mapping[str, OptionValue]) -> Environment:
    """Functions of a user's class with a model, constructed with the task's options.

    Raises:
        TaskError: its model cannot be used. Otherwise whatever the class raises.
    """
    own = construct(task, options)
    model = _load(path, task, own.model)
    if not model.nu:
        raise TaskError("the model has no actuator, so a policy could do nothing; give it an element <actuator>")
    own.mj_model = model
    mx = put_model(model)
    first_qpos, first_qvel = (model.key_qpos[0], model.key_qvel[0]) if model.nkey else (model.qpos0, np.zeros(model.nv))
    limited = model.actuator_ctrllimited.astype(bool)
    low_A, high_A = (
        jnp.asarray(np.where(limited, bounds, side), jnp.float32)
        for bounds, side in zip(model.actuator_ctrlrange.T, (-1.0, 1.0), strict=True)
    )
    has_metrics = hasattr(own, "metric_names")
    called = [name for name in ARGUMENTS if hasattr(own, name) and (name != "metrics" or has_metrics)]
    wanted = {name: _wanted(own, name) for name in called}
    own_reset = reset_of(own) if hasattr(own, "reset") else lambda key: (first_qpos, first_qvel)

    def ctrl(action: Any) -> Any:
        return jnp.clip(0.5 * (low_A + high_A) + 0.5 * (high_A - low_A) * action, low_A, high_A)

    def implied(physics: MujocoState, ctrl_A: Any) -> Any:
        try:
            return forward(mx, physics, ctrl_A)
        except Exception as error:  # MJX finds out only here what it cannot do
            raise TaskError(f"MJX cannot compute this model: {type(error).__name__}: {error}") from error

    def say(name: str, shape: tuple[int, ...] | None, *arguments: Any) -> Any:
        """What a function of the user's returns, one array of this shape; of one axis if None."""
        result = getattr(own, name)(*arguments[: wanted[name]])
        if result is None or isinstance(result, dict | str):
            raise TaskError(f"{name} returned {shown(result)}; it must return one array")
        array = jnp.asarray(result)
        if name in CONDITIONS and array.dtype != bool:
            raise TaskError(f"{name} returned {array.dtype}; it must return bool, such as data.qpos[2] < 0.2")
        if array.shape != shape and not (shape is None and array.ndim == 1):
            should = f"must be {shape}" if shape is not None else "must have one axis, (length,)"
            raise TaskError(f"{name} returned an array of the shape {array.shape}; it {should}")
        return array

    def say_of_step(name: str, data: Any, before: TaskState) -> Any:
        earlier = (implied(before.physics, before.ctrl),) if wanted[name] > 1 else ()
        return say(name, (), data, *earlier)

    def look(physics: MujocoState, ctrl_A: Any, data: Any) -> TaskState:
        """The state with what the user's functions say of it."""
        observation_O = (
            say("observe", None, data)
            if hasattr(own, "observe")
            else jnp.concatenate([physics.qpos, physics.qvel, physics.act])
        )
        distance = say("goal_distance", (), data) if hasattr(own, "goal_distance") else jnp.nan
        succeeds = partial(say, "success", (), data) if hasattr(own, "success") else jnp.asarray
        return TaskState(
            physics,
            ctrl_A,
            observation_O.astype(jnp.float32),
            say("descriptor", (len(task.descriptor_names),), data).astype(jnp.float32),
            jnp.asarray(distance, jnp.float32),
            jnp.stack([succeeds(jnp.bool_(False)), succeeds(jnp.bool_(True))]),
            say("metrics", (len(task.metric_names),), data).astype(jnp.float32) if has_metrics else None,
        )

    def reset(key: Any) -> TaskState:
        qpos, qvel = _pair(own_reset(key))
        for what, array, size in (("positions", qpos, "nq"), ("velocities", qvel, "nv")):
            if jnp.shape(array) != (getattr(model, size),):
                raise TaskError(
                    f"reset returned {what} of the shape {jnp.shape(array)}; must be ({getattr(model, size)},), the "
                    f"{size} of the model"
                )
        physics, nothing = start(mx, qpos, qvel), jnp.zeros(model.nu, jnp.float32)
        return look(physics, nothing, implied(physics, nothing))

    def one_step(before: TaskState, action: Any) -> tuple[TaskState, Any, Any]:
        ctrl_A = ctrl(action)
        physics = step(mx, before.physics, ctrl_A, task.frame_skip)
        data = implied(physics, ctrl_A)
        reward = say_of_step("reward", data, before).astype(jnp.float32)
        done = say_of_step("done", data, before) if hasattr(own, "done") else jnp.bool_(False)
        return look(physics, ctrl_A, data), reward, done

    return Environment(
        reset,
        lambda state: state.observation_O,
        one_step,
        lambda state: state.descriptor_B,
        lambda state: state.goal_distance,
        lambda state, before: jnp.where(before, state.successes_2[1], state.successes_2[0]),
        metrics=(lambda state: state.metrics_M) if has_metrics else None,
        viewer=mujoco_viewer(model, mx, task.frame_skip * float(model.opt.timestep), lambda state: state.physics),
        control_step=ControlStep(model, task.frame_skip, lambda state: state.physics, ctrl),
    )


def _pair(result: Any) -> tuple[Any, Any]:
    """What the user's reset returns."""
    try:
        qpos, qvel = result
    except (TypeError, ValueError):
        raise TaskError(f"reset returned {shown(result)}; it must return (positions, velocities)") from None
    return qpos, qvel


def _wanted(own: Any, name: str) -> int:
    """How many of its ARGUMENTS a function of the user's takes.

    Raises:
        TaskError: it cannot be called with them.
    """
    signature, arguments = inspect.signature(getattr(own, name)), ARGUMENTS[name]
    for count in (len(arguments), len(arguments) - (arguments[-1] == EARLIER)):
        with suppress(TypeError):
            signature.bind(*arguments[:count])
            return count
    raise TaskError(f"{name} has the parameters {signature}; it is called as {name}({', '.join(arguments)})")


def _load(path: str, task: Any, given: Any) -> MjModel:
    """The compiled model of a class.

    Args:
        given: the value of its attribute `model`.

    Raises:
        TaskError: there is no such file, MuJoCo refuses it, or it is not part of the run's identity.
    """
    if isinstance(given, mujoco.MjModel):
        return given
    if isinstance(given, mujoco.MjSpec):
        return _compiled("its MjSpec", given.compile)
    if isinstance(given, str) and given.lstrip().startswith("<"):
        if files := files_read(given.encode()):
            raise TaskError(
                f"its XML reads the file {files[0]}, which would be no part of the run's identity; write the XML into "
                'a file beside the module and name that: model = "robot.xml"'
            )
        return _compiled("its XML", lambda: mujoco.MjModel.from_xml_string(given))
    if not isinstance(given, str | Path):
        raise TaskError(f"model = {given!r} is neither the name of a file, XML, an MjSpec nor an MjModel")
    owner = next((kind for kind in task.__mro__ if "model" in vars(kind)), task)
    folder = Path(getattr(sys.modules[owner.__module__], "__file__", None) or "x").absolute().parent
    file = folder / given
    if not file.is_file():
        near = get_close_matches(file.name, [other.name for other in file.parent.glob("*.xml")], 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise TaskError(
            f"model = {str(given)!r}: there is no file {file}; names are relative to the folder of the class{hint}"
        )
    counted = {known.resolve() for known in modules_of(path).models.values()}
    if other := [read for read in model_files(file) if read.resolve() not in counted]:
        raise TaskError(
            f"model = {str(given)!r}: the file {other[0]} would be no part of the run's identity, since no string in "
            f'your modules names it; write the name of the model as one string, such as model = "{file.name}"'
        )
    return _compiled(str(given), lambda: mujoco.MjModel.from_xml_path(str(file)))


def _compiled(what: str, compile_: Callable[[], MjModel]) -> MjModel:
    try:
        return compile_()
    except (ValueError, mujoco.FatalError) as error:
        why = " ".join(str(error).removeprefix("Error: ").split())
        hint = "; names in a model are relative to its folder, or to its meshdir and the like"
        raise TaskError(f"MuJoCo cannot read {what}: {why}{hint if 'opening file' in why else ''}") from error
