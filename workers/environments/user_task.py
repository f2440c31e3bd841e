"""Classes of users as tasks, named `package.module:Class`. A class must have these attributes and methods:

    class Class:
        observation_size: int
        action_size: int
        episode_steps: int
        descriptor_names: tuple[str, ...]
        descriptor_bounds: tuple[tuple[float, float], ...]

        def reset(self, key): ...          # stream key, uint32 [4] -> state, any pytree of arrays
        def observe(self, state): ...      # -> observation [observation_size]
        def step(self, state, action): ... # -> (state, reward, done)
        def descriptor(self, state): ...   # -> descriptor [len(descriptor_names)] of an episode that ends here

A class with a model of MuJoCo has less to say, see `mujoco_task.py`. It may also have:

- `goal_distance(self, state)`: the distance to a goal;
- `success(self, state, before)`: whether an episode that ends in this state has succeeded; `before` is the answer for
  the state before, False in the reset. `return before | (...)` is for a condition that need hold only once. Its
  docstring's first line says in words which episodes succeed;
- `metric_names`, a tuple of names, and `metrics(self, state)`, as many numbers of an episode that ends in this state,
  which the run records as columns `metric_NAME` of its history (means over the evaluation episodes). What is counted
  along the way, such as energy or the greatest height, is part of the state; NaN is no number;
- `final_fitness = True`, if the last reward measures the whole episode;
- `options`, keyword arguments of the constructor, which must not change any size: by name, `("default", "other")` for a
  few allowed values, or a default with bounds, such as `Option(0.5, low=0.0)`; see `es_service/protocol/options.py`;
- if the descriptor is a place in the plane, `walls`, a tuple of segments ((x, y), (x, y)), and `wall_clearance`, the
  least distance of a descriptor from a wall. The behaviour map's coverage is then relative to the reachable cells;
  and `goal`, a place (x, y). Reports draw both;
- `goal_places`, a mapping from values of the option `goal` to the descriptor of an episode that ends there, and
  `goal_radius`, how far from it an episode has still reached it, for `es-service polish --goals`;
- `viewer(self)`, if the task has bodies: a `workers.viewer.Viewer`, with which reports replay episodes in three
  dimensions. `workers.environments.ant.make_ant(...).viewer` is that of an ant;
- `least_reward`: the reward per step from which QD-scores are counted;
- a docstring, whose first line `es-service` shows.

All methods are pure functions of one state that JAX can trace; they are batched and compiled by the service.
`es_service.protocol.noise.uniforms(key, counters)` makes random numbers of the key of `reset`, which is no key of JAX;
`jax.random.wrap_key_data(key[:2])` makes one of it, which the functions of `jax.random` accept. In training, actions
may exceed [-1, 1] by up to 7.95 times `policy.action_noise`, which is added after the output, and the output `linear`
has no bounds; a task that needs bounded actions must clip them.
Observations and rewards are rounded to float32; with xla a task may compute in double precision (`jax_enable_x64`).
Observations are summed in float32, so their mean must be less than a thousand standard deviations from 0.
"""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue, declared_options, option_values
from es_service.protocol.user_code import raised
from workers.environments import Environment, TaskError
from workers.environments.declared import (
    KEPT_ATTRIBUTES,
    OF_EVERY_CLASS,
    construct,
    import_named,
    missing_names,
    task_of_class,
    unknown_attributes,
    wrong_values,
)

METHODS = ("reset", "observe", "step", "descriptor")
ATTRIBUTES = {
    "observation_size": int,
    "action_size": int,
    "episode_steps": int,
    "descriptor_names": tuple,
    "descriptor_bounds": tuple,
}

KNOWN = (*ATTRIBUTES, *METHODS, *OF_EVERY_CLASS, "viewer")
OF_PYTHON_TASKS = {
    "discrete_actions": "set policy.output to argmax, with which the action is 1 for the chosen one and 0 for the "
    "others (action @ moves)",
    "action_bounds": "step gets what the policy puts out; clip and scale it there, such as by "
    "low + (high - low) * (jnp.clip(action, -1.0, 1.0) + 1.0) / 2.0",
}
"""Attribute that only tasks of Python objects have -> what a task in JAX does instead."""

JAX_KEY_WANTED = (
    "reset(key) passes its key to jax.random, but it is a stream key of es-service, uint32 [4]. Make random numbers "
    "with es_service.protocol.noise.uniforms(key, counters), or a key of JAX with jax.random.wrap_key_data(key[:2])"
)


def describe(path: str, given: Mapping[str, OptionValue] = MappingProxyType({})) -> TaskSpec:
    """Description of a user's class as a task.

    Args:
        given: values of options that are not the defaults, with which its methods are tried.

    Raises:
        TaskError: the class cannot be imported, or its attributes or methods are missing or wrong.
    """
    task = import_named(path)
    if has_model(task):
        from workers.environments import mujoco_task

        return mujoco_task.describe(path, task, given)
    lists = "workers/environments/user_task.py lists what a task must have"
    if missing := missing_names(task, (*ATTRIBUTES, *METHODS), lists):
        is_simulator = all(hasattr(task, name) for name in ("reset", "step")) and not hasattr(task, "observe")
        hint = f"; if it simulates in Python, did you mean python:{path}?" if is_simulator else ""
        raise TaskError(f"{path}{missing}{hint}")
    wrong = wrong_types(task, ATTRIBUTES)
    wrong += [
        f"{name} = {value!r} has no effect on a task in JAX: {instead}, and remove the attribute"
        for name, instead in OF_PYTHON_TASKS.items()
        if (value := getattr(task, name, None)) is not None and value is not False
    ]
    options, wrong_options = declared_options(task)
    wrong += wrong_options
    if not wrong:
        sizes = tuple(name for name, type_ in ATTRIBUTES.items() if type_ is int)
        wrong += wrong_values(task, task.descriptor_names, task.descriptor_bounds, sizes)
    if wrong:
        raise TaskError(f"{path}: {'; '.join(wrong)}")
    _check_shapes(path, option_values(options, given))
    spec = task_of_class(path, task, "jax", (task.descriptor_names, task.descriptor_bounds), options)
    return replace(spec, notes=unknown_attributes(path, task, KNOWN))


def has_model(kind: Any) -> bool:
    """Whether a class has a model of MuJoCo in the place of steps of its own (`mujoco_task.py`)."""
    return not hasattr(kind, "step") and (hasattr(kind, "model") or hasattr(kind, "frame_skip"))


def wrong_types(task: Any, attributes: Mapping[str, type]) -> list[str]:
    """Attributes of a class that are not of these types, in sentences."""
    return [
        f"{name} = {getattr(task, name)!r} is not of type {type_.__name__}"
        for name, type_ in attributes.items()
        if not isinstance(value := getattr(task, name), type_) or isinstance(value, bool)
    ]


@contextmanager
def tracing(path: str) -> Iterator[None]:
    """Context manager in which what a user's class raises becomes a TaskError with the task's name."""
    try:
        yield
    except TaskError as error:
        raise TaskError(f"{path}: {error}") from error.__cause__
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{path} cannot be traced by JAX: {raised(error, path)}") from error


def _check_shapes(path: str, options: Mapping[str, OptionValue]) -> None:
    """Raise TaskError if methods return shapes other than the class declares, or cannot be traced."""
    task = import_named(path)
    with tracing(path):
        environment = make(path, options)
        state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
        action = jax.ShapeDtypeStruct((task.action_size,), jnp.float32)
        after, reward, done = jax.eval_shape(environment.step, state, action)
        shapes = {
            "observe": (_shape("observe", environment.observe, state), (task.observation_size,)),
            "descriptor": (_shape("descriptor", environment.descriptor, state), (len(task.descriptor_names),)),
            "the reward of step": (reward.shape, ()),
            "done of step": (done.shape, ()),
            "goal_distance": (_shape("goal_distance", environment.goal_distance, state), ()),
            "success": (_shape("success", environment.success, state, jax.ShapeDtypeStruct((), bool)), ()),
        }
        if environment.metrics is not None:
            shapes["metrics"] = (_shape("metrics", environment.metrics, state), (len(task.metric_names),))
    wrong = [f"{what} has the shape {is_}, not {should}" for what, (is_, should) in shapes.items() if is_ != should]
    arrays = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree) for tree in (state, after)]
    if jax.tree.structure(state) != jax.tree.structure(after) or arrays[0] != arrays[1]:
        wrong.append(f"step returns a state of arrays {after}, but reset one of {state}; shapes and dtypes must agree")
    if wrong:
        raise TaskError(f"{path}: {'; '.join(wrong)}")


def _shape(name: str, method: Callable[..., Any], *arguments: Any) -> tuple[int, ...]:
    """Shape of the array that a method returns. Raises TaskError if it returns something else."""
    result = jax.eval_shape(method, *arguments)
    if not hasattr(result, "shape"):
        raise TaskError(f"{name} returned {shown(result)}; it must return one array")
    return result.shape


def shown(result: Any) -> str:
    """What a method has returned, in a message: the structure, since the numbers are not known while JAX traces."""
    if result is None:
        return "None (is a `return` missing?)"
    return repr(result) if isinstance(result, str) else str(jax.tree.map(lambda _: "*", result)).replace("'*'", "*")


def make(path: str, options: Mapping[str, OptionValue]) -> Environment:
    """Functions of a user's class, constructed with the task's options."""
    kind = import_named(path)
    if has_model(kind):
        from workers.environments import mujoco_task

        return mujoco_task.make(path, kind, options)
    task = construct(kind, options)
    for name in (*ATTRIBUTES, *KEPT_ATTRIBUTES):
        of_class, of_instance = getattr(kind, name, None), getattr(task, name, None)
        if repr(of_class) != repr(of_instance):
            raise TaskError(
                f"its constructor changes {name} ({of_class!r} -> {of_instance!r}), but a run uses the value of the "
                "class; options may change only what the methods compute"
            )
    goal_distance = getattr(task, "goal_distance", lambda state: jnp.float32(jnp.nan))

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        result = task.step(state, action)
        try:
            state, reward, done = result
        except (TypeError, ValueError):
            raise TaskError(f"step returned {shown(result)}; it must return (state, reward, done)") from None
        if reward is None or done is None:
            raise TaskError(f"step returned {shown(result)}; its reward and done must not be None")
        return state, jnp.asarray(reward, jnp.float32), jnp.asarray(done, bool)

    def observe(state: Any) -> Any:
        observation = task.observe(state)
        if observation is None:
            raise TaskError(f"observe returned {shown(None)}; it must return one array")
        return jnp.asarray(observation, jnp.float32)

    viewer = task.viewer() if hasattr(task, "viewer") else None
    success = getattr(task, "success", lambda state, before: before)
    return words_in_place_of_keys(
        Environment(
            reset_of(task),
            observe,
            step,
            task.descriptor,
            goal_distance,
            success,
            metrics=task.metrics if hasattr(task, "metric_names") else None,
            viewer=viewer,
        )
    )


def reset_of(task: Any) -> Callable[[Any], Any]:
    """The user's reset, which says what to do if it passes its key to `jax.random`."""

    def reset(key: Any) -> Any:
        try:
            return task.reset(key)
        except Exception as error:
            if _wants_jax_key(error):
                raise TaskError(JAX_KEY_WANTED) from error
            raise

    return reset


def _wants_jax_key(error: Exception) -> bool:
    """Whether a function of `jax.random` has refused its key."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(
        frame.f_code.co_name == "_check_prng_key" and str(frame.f_globals.get("__name__")).startswith("jax.")
        for frame in frames
    )


@partial(jax.tree_util.register_dataclass, data_fields=["words"], meta_fields=["kind"])
@dataclasses.dataclass(frozen=True)
class KeyWords:
    """The words of keys of JAX, in their place in a state."""

    words: Any
    """uint32 [..., words of a key]."""
    kind: str
    """JAX's name of the generator."""


def words_in_place_of_keys(environment: Environment) -> Environment:
    """The environment with `KeyWords` in its states where its own functions have typed keys of JAX."""

    def outside(state: Any) -> Any:
        return jax.tree.map(lambda leaf: _words(leaf) if _is_key(leaf) else leaf, state)

    def inside(state: Any) -> Any:
        return jax.tree.map(_key, state, is_leaf=lambda leaf: isinstance(leaf, KeyWords))

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        after, reward, done = environment.step(inside(state), action)
        return outside(after), reward, done

    viewer = environment.viewer
    return dataclasses.replace(
        environment,
        reset=lambda key: outside(environment.reset(key)),
        observe=lambda state: environment.observe(inside(state)),
        step=step,
        descriptor=lambda state: environment.descriptor(inside(state)),
        goal_distance=lambda state: environment.goal_distance(inside(state)),
        success=lambda state, before: environment.success(inside(state), before),
        metrics=None if (metrics := environment.metrics) is None else lambda state: metrics(inside(state)),
        viewer=viewer and viewer._replace(poses=lambda state: viewer.poses(inside(state))),
    )


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _words(keys: Any) -> KeyWords:
    return KeyWords(jax.random.key_data(keys), str(jax.random.key_impl(keys)))


def _key(leaf: Any) -> Any:
    return jax.random.wrap_key_data(leaf.words, impl=leaf.kind) if isinstance(leaf, KeyWords) else leaf
