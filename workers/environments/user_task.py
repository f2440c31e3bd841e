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

It may also have:

- `goal_distance(self, state)`: the distance to a goal;
- `success(self, state, before)`: whether an episode that ends in this state has succeeded; `before` is the answer for
  the state before, False in the reset. `return before | (...)` is for a condition that need hold only once. Its
  docstring's first line says in words which episodes succeed;
- `final_fitness = True`, if the last reward measures the whole episode;
- `options`, keyword arguments of the constructor, which must not change any size: by name, `("default", "other")` for a
  few allowed values, or a default with bounds, such as `Option(0.5, low=0.0)`; see `es_service/protocol/options.py`;
- if the descriptor is a place in the plane, `walls`, a tuple of segments ((x, y), (x, y)), and `wall_clearance`, the
  least distance of a descriptor from a wall. The behaviour map's coverage is then relative to the reachable cells;
  and `goal`, a place (x, y). Reports draw both;
- `viewer(self)`, if the task has bodies: a `workers.viewer.Viewer`, with which reports replay episodes in three
  dimensions. `workers.environments.ant.ant_viewer` makes that of an ant;
- `least_reward`: the reward per step from which QD-scores are counted;
- a docstring, whose first line `es-service` shows.

All methods are pure functions of one state that JAX can trace; they are batched and compiled by the service.
`es_service.protocol.noise.uniforms(key, counters)` makes random numbers of the key of `reset`, which is no key of JAX;
`jax.random.wrap_key_data(key[:2])` makes one of it, which the functions of `jax.random` accept. In training, actions
may exceed [-1, 1] by up to 7.95 times `policy.action_noise`, which is added after the output, and the output `linear`
has no bounds; a task that needs bounded actions must clip them. Observations are summed in float32, so their mean must
be less than a thousand standard deviations from 0.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue, declared_options
from es_service.protocol.raised import raised, why_not_imported
from es_service.protocol.user_code import import_user_module, in_no_file
from workers.environments import Environment, TaskError

METHODS = ("reset", "observe", "step", "descriptor")
ATTRIBUTES = {
    "observation_size": int,
    "action_size": int,
    "episode_steps": int,
    "descriptor_names": tuple,
    "descriptor_bounds": tuple,
}

JAX_KEY_WANTED = (
    "reset(key) passes its key to jax.random, but it is a stream key of es-service, uint32 [4]. Make random numbers "
    "with es_service.protocol.noise.uniforms(key, counters), or a key of JAX with jax.random.wrap_key_data(key[:2])"
)
TABLES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "the history": (
        ("centre_{}", "centre_{}_std"),
        ("centre_fitness_mean", "centre_fitness_std", "centre_return_mean", "centre_return_std", "centre_novelty"),
    ),
    "the map": (("{}", "cell_{}"), ("cell", "fitness", "generation", "centre")),
    "the novelty archive": (("{}",), ("generation", "centre")),
    "evaluate --out": (
        ("{}", "{}_std"),
        (
            "run",
            "policy",
            "generation",
            "episodes",
            "stored_fitness",
            "fresh_fitness",
            "fresh_standard_error",
            "successes",
        ),
    ),
}
"""Tables of a run with columns named after the descriptor: (patterns of these columns, other columns)."""


def describe(path: str) -> TaskSpec:
    """Description of a user's class as a task.

    Raises:
        TaskError: the class cannot be imported, or its attributes or methods are missing or wrong.
    """
    task = _import(path)
    missing = [name for name in (*ATTRIBUTES, *METHODS) if not hasattr(task, name)]
    if missing:
        raise TaskError(
            f"{path} has no {', '.join(missing)}; workers/environments/user_task.py lists what a task must have"
        )
    wrong = [
        f"{name} = {getattr(task, name)!r} is not of type {type_.__name__}"
        for name, type_ in ATTRIBUTES.items()
        if not isinstance(getattr(task, name), type_)
    ]
    options, wrong_options = declared_options(task)
    wrong += wrong_options
    if not wrong:
        names, bounds = len(task.descriptor_names), len(task.descriptor_bounds)
        if names != bounds or not names:
            wrong.append(f"{names} descriptor_names but {bounds} descriptor_bounds")
        wrong += _wrong_pairs(task.descriptor_bounds)
        wrong += clashes(tuple(map(str, task.descriptor_names)))
        if not _are_walls(getattr(task, "walls", None)):
            wrong.append(f"walls = {task.walls!r} is not a tuple of segments ((x, y), (x, y))")
        least = getattr(task, "least_reward", None)
        goal = getattr(task, "goal", None)
        if goal is not None and not (_are_finite(goal) and len(goal) == 2):
            wrong.append(f"goal = {goal!r} is not a place (x, y) of finite numbers")
        numbers = {
            "wall_clearance": getattr(task, "wall_clearance", 0.0),
            "least_reward": 0.0 if least is None else least,
        }
        wrong += [f"{name} = {x!r} is not a finite number" for name, x in numbers.items() if not _are_finite((x,))]
        sizes = {name: getattr(task, name) for name, type_ in ATTRIBUTES.items() if type_ is int}
        wrong += [f"{name} = {size} is not positive" for name, size in sizes.items() if size < 1]
    if wrong:
        raise TaskError(f"{path}: {'; '.join(wrong)}")
    _check_shapes(path, {name: option.default for name, option in options.items()})
    return TaskSpec(
        name=path,
        observation_size=task.observation_size,
        action_size=task.action_size,
        episode_steps=task.episode_steps,
        descriptor_names=tuple(map(str, task.descriptor_names)),
        descriptor_bounds=tuple((float(low), float(high)) for low, high in task.descriptor_bounds),
        final_fitness=bool(getattr(task, "final_fitness", False)),
        has_goal=hasattr(task, "goal_distance"),
        options=options,
        summary=(task.__doc__ or "").strip().partition("\n")[0],
        walls=getattr(task, "walls", None),
        wall_clearance=float(getattr(task, "wall_clearance", 0.0)),
        goal=getattr(task, "goal", None),
        least_reward=getattr(task, "least_reward", None),
        success=_success_in_words(task),
    )


def _success_in_words(task: Any) -> str:
    """The first line of the docstring of a class's method `success`; empty if it has no such method."""
    if not hasattr(task, "success"):
        return ""
    return (task.success.__doc__ or "").strip().partition("\n")[0].rstrip(".") or "as the task's method success says"


def _wrong_pairs(bounds: tuple) -> list[str]:
    """Problems of the bounds of a descriptor."""
    return [
        f"descriptor_bounds: {pair!r} is not a pair (low, high) of finite numbers with low < high"
        for pair in bounds
        if not (_are_finite(pair) and len(pair) == 2 and pair[0] < pair[1])
    ]


def clashes(names: tuple[str, ...]) -> list[str]:
    """Problems of the names of a descriptor's dimensions, whose columns must not exist already in a table of a run."""
    wrong: dict[str, str] = {}
    for table, (ours, others) in TABLES.items():
        taken = {column.casefold() for column in others}  # SQL does not distinguish upper and lower case
        for name in names:
            for column in (form.format(name) for form in ours):
                if column.casefold() in taken:
                    wrong.setdefault(
                        name,
                        f"descriptor_names: {name!r} would be the column {column} of {table}, which already has a "
                        "column of that name; choose another name",
                    )
                taken.add(column.casefold())
    return list(wrong.values())


def _are_walls(walls: Any) -> bool:
    """Whether a value is None or a tuple of segments, each between two different places."""
    return walls is None or (
        isinstance(walls, tuple)
        and all(isinstance(wall, tuple) and len(wall) == 2 and wall[0] != wall[1] for wall in walls)
        and all(_are_finite(end) and len(end) == 2 for wall in walls for end in wall)
    )


def _are_finite(numbers: Any) -> bool:
    """Whether a value is a tuple of finite numbers."""
    return isinstance(numbers, tuple) and all(isinstance(x, int | float) and math.isfinite(x) for x in numbers)


def _check_shapes(path: str, options: Mapping[str, OptionValue]) -> None:
    """Raise TaskError if methods return shapes other than the class declares, or cannot be traced."""
    task = _import(path)
    try:
        environment = make(path, options)
        state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((4,), jnp.uint32))
        action = jax.ShapeDtypeStruct((task.action_size,), jnp.float32)
        after, reward, done = jax.eval_shape(environment.step, state, action)
        found = {
            "observe": (jax.eval_shape(environment.observe, state).shape, (task.observation_size,)),
            "descriptor": (jax.eval_shape(environment.descriptor, state).shape, (len(task.descriptor_names),)),
            "the reward of step": (reward.shape, ()),
            "done of step": (done.shape, ()),
            "goal_distance": (jax.eval_shape(environment.goal_distance, state).shape, ()),
            "success": (jax.eval_shape(environment.success, state, jax.ShapeDtypeStruct((), bool)).shape, ()),
        }
    except TaskError as error:
        raise TaskError(f"{path}: {error}") from error.__cause__
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{path} cannot be traced by JAX: {raised(error, path)}") from error
    wrong = [f"{what} has the shape {is_}, not {should}" for what, (is_, should) in found.items() if is_ != should]
    arrays = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), one) for one in (state, after)]
    if jax.tree.structure(state) != jax.tree.structure(after) or arrays[0] != arrays[1]:
        wrong.append(f"step returns a state of arrays {after}, but reset one of {state}; shapes and dtypes must agree")
    if wrong:
        raise TaskError(f"{path}: {'; '.join(wrong)}")


def make(path: str, options: Mapping[str, OptionValue]) -> Environment:
    """Functions of a user's class, constructed with the task's options."""
    kind = _import(path)
    task = kind(**options)
    for name in (*ATTRIBUTES, "walls", "wall_clearance", "goal", "least_reward", "final_fitness"):
        of_class, of_instance = getattr(kind, name, None), getattr(task, name, None)
        if repr(of_class) != repr(of_instance):
            raise TaskError(
                f"its constructor changes {name} ({of_class!r} -> {of_instance!r}), but a run uses the value of the "
                "class; options may change only what the methods compute"
            )
    goal_distance = getattr(task, "goal_distance", lambda state: jnp.float32(jnp.nan))

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        state, reward, done = task.step(state, action)
        return state, jnp.asarray(reward, jnp.float32), jnp.asarray(done, bool)

    def reset(key: Any) -> Any:
        try:
            return task.reset(key)
        except Exception as error:
            if _wants_jax_key(error):
                raise TaskError(JAX_KEY_WANTED) from error
            raise

    viewer = task.viewer() if hasattr(task, "viewer") else None
    success = getattr(task, "success", lambda state, before: before)
    return Environment(reset, task.observe, step, task.descriptor, goal_distance, success, viewer)


def _wants_jax_key(error: Exception) -> bool:
    """Whether a function of `jax.random` has refused its key."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(
        frame.f_code.co_name == "_check_prng_key" and str(frame.f_globals.get("__name__")).startswith("jax.")
        for frame in frames
    )


def _import(path: str) -> Any:
    """The class that `package.module:Class` names."""
    module, _, name = path.partition(":")
    if problem := in_no_file(path):
        raise TaskError(problem)
    try:
        found = import_user_module(path)
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{path}: {why_not_imported(module, error)}") from error
    if not hasattr(found, name):
        raise TaskError(f"{path}: the module {module} has no class {name}")
    return getattr(found, name)
