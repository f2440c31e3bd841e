"""Tasks: their descriptions as plain data, and the functions that make them, imported only where rollouts run."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from es_service.protocol.errors import TaskError as TaskError
from es_service.protocol.messages import NO_CHOICES, HostChoices, TaskSpec
from es_service.protocol.options import OptionValue, choice
from es_service.protocol.sources import LIBRARY, PATH_FOLLOWS, SUITES, meant_environment
from workers.environments.ant_tasks import ANT_CLEARANCE, MAZES, goal_maze
from workers.viewer import Viewer

if TYPE_CHECKING:  # it imports this module
    from workers.environments.c_mujoco import ControlStep
    from workers.environments.function_task import FunctionTask
    from workers.environments.host_task import HostTask


PHYSICS = ("spring", "mujoco", "mujoco_euler")
"""Physics of the ants: Brax's springs, or MuJoCo by MJX with the integrator RK4 of `ant.xml`, or with Euler."""

SHIPPED: Mapping[str, TaskSpec] = {
    "point_maze": TaskSpec(
        name="point_maze",
        observation_size=2,
        action_size=2,
        episode_steps=200,
        descriptor_names=("x", "y"),
        descriptor_bounds=((-1.0, 1.0), (-1.0, 1.0)),
        final_fitness=True,
        has_goal=True,
        options={"start": choice("default", "corner")},
        walls=(((-0.5, -0.495), (1.0, -0.495)), ((-1.0, 0.205), (0.5, 0.205))),
        goal=(-0.5, 0.8),
        success="the point is in the goal square of side 0.1",
        least_reward=-2.3431,  # from the corner (1, -1)
        summary="a point must reach a goal in a square; two walls block the direct path",
    ),
    "ant_maze": TaskSpec(
        name="ant_maze",
        observation_size=29,
        action_size=8,
        episode_steps=3000,
        descriptor_names=("x", "y"),
        descriptor_bounds=((-35.0, 40.0), (-35.0, 40.0)),
        final_fitness=True,
        has_goal=True,
        options={"physics": choice(*PHYSICS)},
        walls=(
            ((-35.0, -35.0), (40.0, -35.0)),
            ((-35.0, 40.0), (40.0, 40.0)),
            ((-35.0, -35.0), (-35.0, 40.0)),
            ((40.0, -35.0), (40.0, 40.0)),
            ((-15.0, 3.0), (-15.0, 37.0)),
            ((-16.0, -15.0), (10.0, -15.0)),
            ((10.0, -35.0), (10.0, 0.0)),
        ),
        wall_clearance=ANT_CLEARANCE,
        goal=(35.0, -25.0),
        success="the ant is within 5 m of the goal at the end",
        least_reward=-95.6,  # from the corner (-35, 40)
        summary="an ant must go round three walls to a goal 60 m away; the direct path ends in a pocket",
    ),
    "ant_trap": TaskSpec(
        name="ant_trap",
        observation_size=113,
        action_size=8,
        episode_steps=1000,
        descriptor_names=("x", "y"),
        descriptor_bounds=((0.0, 30.0), (-8.0, 8.0)),
        final_fitness=False,
        has_goal=False,
        options={"physics": choice(*PHYSICS), "contact_forces": choice("computed", "zero")},
        walls=(((12.0, -2.0), (12.0, 2.0)), ((7.0, 3.0), (12.0, 3.0)), ((7.0, -3.0), (12.0, -3.0))),
        wall_clearance=ANT_CLEARANCE,
        success="the ant has passed x = 20",
        least_reward=-3.38,  # QDax's figure for an episode's mean, not a bound for this ant
        summary="an ant is rewarded for running forward; a trap blocks the direct path, so the ant must go round it",
    ),
    **{name: goal_maze(name) for name in MAZES},
}
"""Descriptions of the shipped tasks by name. A test compares each with the task's module."""
SHIPPED_IN = {"point_maze": "point_maze", "ant_maze": "ant", "ant_trap": "ant"}
"""Task without a maze of cells -> the module with the function of its name that makes it."""
ADAPTERS = {"brax": "brax_task", "mujoco": "mujoco_gym"}
"""Prefix of tasks in JAX from elsewhere -> the module that describes and makes them. For SUITES, it is `suite_task`."""


@dataclass(frozen=True)
class Environment:
    """A task as pure functions of one environment's state; rollouts vmap and compile them.

    A state is any pytree of arrays. The functions do not depend on episodes, time limits, policies or statistics.
    """

    reset: Callable[[Any], Any]
    """Function from a stream key (uint32 [4]) to a state."""
    observe: Callable[[Any], Any]
    """Function from a state to an observation [O], float32."""
    step: Callable[[Any, Any], tuple[Any, Any, Any]]
    """Function (state, action [A]) -> (next state, reward, done). The task clips actions outside [-1, 1]."""
    descriptor: Callable[[Any], Any]
    """Function from a state to the descriptor [B] of an episode that ends in it."""
    goal_distance: Callable[[Any], Any]
    """Function from a state to the distance to the goal, NaN if the task has no goal."""
    success: Callable[[Any, Any], Any] = lambda state, before: before
    """Function (state, whether the episode would have succeeded in the state before) -> whether it succeeds if it ends
    in this state; always False if the task does not declare success."""
    viewer: Viewer | None = None
    """Data for replays in three dimensions; None if the task has no bodies."""
    compiles_drawn_resets: bool = False
    """Whether simd may compile a reset that draws by `jax.random`. JAX computes it if not, as it always has for Brax's
    environments and for tasks of users, so that their runs keep their bits."""
    control_step: ControlStep | None = None
    """What a step is to C MuJoCo, with which `doctor` compares it; None if it has no model of MuJoCo."""
    metrics: Callable[[Any], Any] | None = None
    """Function from a state to the metrics [M] of an episode that ends in it; None if the task has none."""


def make_environment(name: str, options: Mapping[str, Any]) -> Environment:
    """Functions of a task; imports its module, and with it JAX and the physics engine that it needs.

    Args:
        name: a key of SHIPPED, `brax:NAME`, `mujoco:ID`, `SUITE:NAME` or `package.module:Class`.
        options: options of the task and their values.

    Raises:
        TaskError: the task does not exist or cannot be used.
    """
    prefix, colon, rest = name.partition(":")
    if name in MAZES:
        return importlib.import_module("workers.environments.goal_maze").make(name, **options)
    if not colon:
        return getattr(importlib.import_module(f"workers.environments.{SHIPPED_IN[name]}"), name)(**options)
    if prefix in ADAPTERS:
        return _adapter(prefix).make(rest, **options)
    if prefix in SUITES:
        from workers.environments import suite_task

        return suite_task.make(name, options)
    from workers.environments import user_task

    return user_task.make(name, options)


def _adapter(prefix: str) -> Any:
    return importlib.import_module(f"workers.environments.{ADAPTERS[prefix]}")


def is_host_task(name: str) -> bool:
    """Whether a name is that of a task of Python objects."""
    kind, _, rest = name.partition(":")
    return kind == LIBRARY or (kind == "python" and ":" in rest)


def is_function_task(name: str) -> bool:
    kind, _, rest = name.partition(":")
    return kind == "function" and ":" in rest


def make_function_task(name: str, options: Mapping[str, OptionValue]) -> FunctionTask:
    """A function that is a task; imports its module, but no JAX.

    Args:
        name: `function:package.module:name`.

    Raises:
        TaskError: the function does not exist or cannot be used.
    """
    from workers.environments import function_task

    return function_task.make(name.partition(":")[2], options)


def make_host_task(
    name: str, options: Mapping[str, OptionValue], choices: HostChoices = NO_CHOICES, descriptor_size: int = 0
) -> HostTask:
    """A task of Python objects; imports its module, but no JAX.

    Args:
        name: `python:package.module:Class`, or `gymnasium:ID`.
        options: options of the task and their values.
        choices: what a config chooses besides.
        descriptor_size: how many numbers the descriptor has that it chooses.

    Raises:
        TaskError: the task does not exist or cannot be used.
    """
    from workers.environments.declared import with_descriptor
    from workers.environments.host_task import with_choices
    from workers.environments.python_task import with_metrics

    kind, _, rest = name.partition(":")
    if kind == LIBRARY:
        from workers.environments import gymnasium_task as module
    else:
        from workers.environments import python_task as module
    chosen = with_metrics(with_choices(module.make(rest, options), choices), choices)
    return with_descriptor(chosen, choices.descriptor, descriptor_size)


def settings_of_description(name: str, options: Mapping[str, OptionValue], choices: HostChoices) -> dict[str, Any]:
    """The choices of a config without which a task cannot be described, as plain data; none for most tasks."""
    settings: dict[str, Any] = {}
    if name.startswith(f"{LIBRARY}:"):
        settings["options"] = dict(options)
    if is_host_task(name):
        settings |= {key: value for key, value in vars(choices).items() if value != getattr(NO_CHOICES, key)}
    return settings


def choices_of(settings: Mapping[str, Any]) -> HostChoices:
    """The choices among `settings_of_description`, also as JSON has them."""
    descriptor = settings.get("descriptor")
    return HostChoices(
        tuple(descriptor) if isinstance(descriptor, list) else descriptor,
        settings.get("success"),
        settings.get("new_objects", False),
        tuple(settings.get("metrics", ())),
    )


def describe_environment(name: str, settings: Mapping[str, Any] = MappingProxyType({})) -> TaskSpec:
    """Description of a task that is no shipped one, from its module. Those of Python objects and
    functions do not import JAX.

    Args:
        settings: `settings_of_description`, and `options` with which it is tried if they are not the defaults.

    Raises:
        TaskError: the task does not exist or cannot be used.
    """
    kind, _, rest = name.partition(":")
    options = settings.get("options", {})
    if kind in ADAPTERS:
        return _adapter(kind).describe(rest, options)
    if kind in SUITES:
        from workers.environments import suite_task

        return suite_task.describe(name, options)
    if is_host_task(name):
        if kind == LIBRARY:
            from workers.environments import gymnasium_task

            return gymnasium_task.describe(rest, options, choices_of(settings))
        from workers.environments import python_task

        return python_task.describe(rest, choices_of(settings), options)
    if is_function_task(name):
        from workers.environments import function_task

        return function_task.describe(rest)
    if meant := meant_environment(name):
        raise TaskError(f"{name} is no class; did you mean {meant}?")
    if kind in PATH_FOLLOWS:
        what, (module, _, last) = "name" if kind == "function" else "Class", rest.rpartition(".")
        such_as = f"{kind}:{module or 'my_module'}:{last or what}"
        raise TaskError(f"{name} has one colon; must be {kind}:module:{what}, such as {such_as}")
    from workers.environments import user_task

    return user_task.describe(name, options)
