"""What a user's class declares of itself as a task: its import, its attributes, and what is wrong with them.

Tasks in JAX and tasks of Python objects share this; nothing here imports JAX.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

import numpy as np

from es_service.protocol.episodes import METRIC_FORM, wrong_metric_names
from es_service.protocol.messages import UNBOUNDED, Bounds, DescriptorChoice, TaskKind, TaskSpec
from es_service.protocol.options import Option, OptionValue, declared_options
from es_service.protocol.user_code import import_user_module, in_no_file, users_error, why_not_imported
from workers.environments import TaskError
from workers.environments.host_task import HostEnvironment, HostEpisode, HostTask

Described = tuple[tuple[str, ...], Bounds]
"""Names and bounds of numbers of a descriptor."""
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


def import_named(path: str, what: str = "class") -> Any:
    """The object `package.module:name`.

    Args:
        what: the word for it in messages.

    Raises:
        TaskError: the module cannot be imported, or has nothing of this name.
    """
    module, _, name = path.partition(":")
    if problem := in_no_file(path):
        raise TaskError(problem)
    try:
        imported = import_user_module(path)
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{path}: {why_not_imported(module, error)}") from error
    if not hasattr(imported, name):
        fits = inspect.isclass if what == "class" else callable
        own = {other.lower(): other for other, value in vars(imported).items() if fits(value)}
        near = get_close_matches(name.lower(), own, 1)
        hint = f"; did you mean {module}:{own[near[0]]}?" if near else ""
        raise TaskError(f"{path}: the module {module} has no {what} {name}{hint}")
    return getattr(imported, name)


def construct(task: Any, options: Mapping[str, OptionValue]) -> Any:
    """An object of a user's class.

    Raises:
        TaskError: the constructor cannot be called with the options. Otherwise whatever it raises.
    """
    try:
        return task(**options)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is not None:
            raise  # it was called, and its own code has raised
        given = f"the options {', '.join(options)}" if options else "no arguments"
        kind = getattr(task, "__qualname__", task)
        raise TaskError(
            f"the constructor of {kind} cannot be called with {given} ({error}); give each argument a default, and "
            "declare in the attribute options what a config may set"
        ) from None


KEPT_ATTRIBUTES = (
    "walls",
    "wall_clearance",
    "goal",
    "goal_places",
    "goal_radius",
    "least_reward",
    "final_fitness",
    "metric_names",
)
"""What a class of any kind may declare as attributes, which a constructor must not change, since a run takes them from
the class."""
OF_EVERY_CLASS = (*KEPT_ATTRIBUTES, "options", "goal_distance", "success", "metrics")
"""What a class of any kind may declare, as attributes or methods."""
NEAR = 0.88
"""Similarity (of `difflib`) of names of which one is taken for a misspelling of the other: a letter of nine."""
OF_GYMNASIUM = {
    "observation_space": "observation_size",
    "action_space": "action_size",
    "max_episode_steps": "episode_steps",
}
"""Attribute of environments of Gymnasium that has no effect here -> what a class declares instead."""


def unknown_attributes(path: str, task: Any, known: Collection[str]) -> tuple[str, ...]:
    """Sentences on attributes and methods that have no effect because of their names.

    Only names that are nearly those of something that the class could have and has not, and those of Gymnasium: all
    others are the author's own, and so is every name that begins with `_`.

    Args:
        path: name of the task.
        known: what a class of this kind may have.
    """
    open_names = [name for name in known if not hasattr(task, name)]
    own = [name for name in dir(task) if not name.startswith("_") and name not in known]
    meant = {name: near for name in own for near in get_close_matches(name.lower(), open_names, 1, NEAR)}
    meant |= {name: instead for name, instead in OF_GYMNASIUM.items() if name in own}
    alone = callable(getattr(task, "metrics", None)) and not hasattr(task, "metric_names")
    nameless = (f"{path}: metrics records nothing, since the class has no metric_names",) if alone else ()
    return nameless + tuple(
        f"{path}: {name} has no effect, since a task declares nothing of this name; did you mean {instead}? (Begin the "
        "names of your own attributes with _, if this note is to be left out.)"
        for name, instead in meant.items()
    )


def missing_names(task: Any, needed: Collection[str], help_text: str) -> str:
    """What a class lacks, in words: " has no X; HELP" with the attributes that may be meant; empty if nothing."""
    if inspect.isfunction(task):
        return f" is a function and no class; did you mean function:{task.__module__}:{task.__qualname__}?"
    missing = [name for name in needed if not hasattr(task, name)]
    own = {name.lower(): name for name in dir(task) if not name.startswith("_")}
    near = [own[other] for name in missing for other in get_close_matches(name, own.keys() - {*needed}, 1, NEAR)]
    meant = f" (but {', '.join(near)})" if near else ""
    return f" has no {', '.join(missing)}{meant}; {help_text}" if missing else ""


def wrong_values(task: Any, names: Any, bounds: Any, sizes: tuple[str, ...]) -> list[str]:
    """Problems of the attributes of a class whose types are right.

    Args:
        names, bounds: of the descriptor.
        sizes: attributes that are positive whole numbers.
    """
    wrong = []
    if len(names) != len(bounds) or not len(names):
        wrong.append(f"{len(names)} descriptor_names but {len(bounds)} descriptor_bounds")
    wrong += wrong_pairs("descriptor_bounds", bounds)
    wrong += clashes(tuple(map(str, names)))
    if not _are_walls(getattr(task, "walls", None)):
        wrong.append(f"walls = {task.walls!r} is not a tuple of segments ((x, y), (x, y))")
    least = getattr(task, "least_reward", None)
    goal = getattr(task, "goal", None)
    if goal is not None and not (are_finite(goal) and len(goal) == 2):
        wrong.append(f"goal = {goal!r} is not a place (x, y) of finite numbers")
    wrong += _wrong_goals(task, len(names))
    numbers = {
        "goal_radius": getattr(task, "goal_radius", 0.0),
        "wall_clearance": getattr(task, "wall_clearance", 0.0),
        "least_reward": 0.0 if least is None else least,
    }
    wrong += [f"{name} = {x!r} is not a finite number" for name, x in numbers.items() if not are_finite((x,))]
    wrong += wrong_metrics(task)
    return wrong + [f"{name} = {size} is not positive" for name in sizes if (size := getattr(task, name)) < 1]


def task_of_class(
    path: str, task: Any, kind: TaskKind, descriptor: tuple[tuple[str, ...], Bounds], options: dict[str, Option]
) -> TaskSpec:
    """Description of a class whose declarations are right.

    Args:
        path: name of the task.
        descriptor: names and bounds of its dimensions.
    """
    names, bounds = descriptor
    return TaskSpec(
        name=path,
        observation_size=task.observation_size,
        action_size=task.action_size,
        episode_steps=task.episode_steps,
        descriptor_names=tuple(map(str, names)),
        descriptor_bounds=tuple((float(low), float(high)) for low, high in bounds),
        final_fitness=bool(getattr(task, "final_fitness", False)),
        has_goal=hasattr(task, "goal_distance"),
        options=options,
        summary=(task.__doc__ or "").strip().partition("\n")[0],
        walls=getattr(task, "walls", None),
        wall_clearance=float(getattr(task, "wall_clearance", 0.0)),
        goal=getattr(task, "goal", None),
        goals={name: tuple(map(float, place)) for name, place in getattr(task, "goal_places", {}).items()},
        goal_radius=float(getattr(task, "goal_radius", 0.0)),
        least_reward=getattr(task, "least_reward", None),
        success=_success_in_words(task),
        kind=kind,
        metric_names=tuple(getattr(task, "metric_names", ())),
    )


def _wrong_goals(task: Any, size: int) -> list[str]:
    """Problems of the goals that a class declares for `polish --goals`.

    Args:
        size: number of dimensions of the descriptor.
    """
    goals: Any = getattr(task, "goal_places", {})
    if not isinstance(goals, Mapping) or not all(are_finite(place) and len(place) == size for place in goals.values()):
        return [f"goal_places = {goals!r} is not a mapping from names to tuples of finite numbers, {size} in each"]
    option = declared_options(task)[0].get("goal")
    lacking = [name for name in goals if option is None or name not in option.choices]
    wrong = [f"goal_places has {', '.join(map(str, lacking))}, which the option goal cannot be"] if lacking else []
    if goals and not getattr(task, "goal_radius", 0.0) > 0.0:
        wrong.append(
            "goal_places needs goal_radius, the distance within which an episode has reached its goal, above 0"
        )
    return wrong


def wrong_metrics(task: Any) -> list[str]:
    """Problems of what a class says of its metrics; a class without `metric_names` has none."""
    names = getattr(task, "metric_names", ())
    if hasattr(task, "metric_names") and not callable(getattr(task, "metrics", None)):
        return ["metric_names needs a method metrics, which returns as many numbers"]
    if not isinstance(names, tuple):
        return [f"metric_names = {names!r} is not a tuple"]
    if wrong := wrong_metric_names(names):
        return [f"metric_names has {', '.join(wrong)}; each name must be different and of {METRIC_FORM}"]
    return []


def _success_in_words(task: Any) -> str:
    """The first line of the docstring of a class's method `success`; empty if it has no such method."""
    if not hasattr(task, "success"):
        return ""
    return (task.success.__doc__ or "").strip().partition("\n")[0].rstrip(".") or "as the task's method success says"


def wrong_pairs(name: str, bounds: tuple) -> list[str]:
    """Problems of the bounds that an attribute has."""
    return [
        f"{name}: {pair!r} is not a pair (low, high) of finite numbers with low < high"
        for pair in bounds
        if not (are_finite(pair) and len(pair) == 2 and pair[0] < pair[1])
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
        and all(are_finite(end) and len(end) == 2 for wall in walls for end in wall)
    )


def are_finite(numbers: Any) -> bool:
    """Whether a value is a tuple of finite numbers."""
    return isinstance(numbers, tuple) and all(isinstance(x, int | float) and math.isfinite(x) for x in numbers)


# Descriptors that a config chooses for a task of Python objects: `task.descriptor`.

SOME_STEPS = 20
"""Steps within which a key of `info` must be known, and a descriptor be computed, to see how many numbers it has."""


def with_descriptor(task: HostTask, choice: DescriptorChoice | None, size: int | None = None) -> HostTask:
    """The task with the descriptor that a config chooses.

    Args:
        size: how many numbers it has; None: any number.

    Raises:
        TaskError: there is no such descriptor.
    """
    if choice is None:
        return task
    if isinstance(choice, tuple):
        wrong = [index for index in choice if not 0 <= index < task.observation_size]
        if wrong or not choice:
            raise TaskError(
                f"task.descriptor = {list(choice)}: observations of {task.name} have {task.observation_size} numbers, "
                f"which are named 0 to {task.observation_size - 1}"
            )
        indices_B = np.array(choice)
        return replace(task, descriptor=lambda episode: episode.observation_O[indices_B], descriptor_size=len(choice))
    if ":" in choice:
        function = import_named(choice, "function")
        return replace(task, descriptor=function, descriptor_size=size or 0, keeps_all=True)
    return replace(task, descriptor=_of_info(choice, size or 1), descriptor_size=size or 0)


def describe_descriptor(
    task: HostTask, choice: DescriptorChoice, bounds_O: Sequence[tuple[float, float]], action_size: int
) -> Described:
    """(names, bounds) of the dimensions of a descriptor that a config chooses.

    Args:
        bounds_O: of the numbers of an observation; infinite where there are none.

    Raises:
        TaskError: there is no such descriptor, or what it declares does not fit.
    """
    task = with_descriptor(task, choice)
    if isinstance(choice, tuple):
        if len(set(choice)) < len(choice):
            raise TaskError(f"task.descriptor = {list(choice)} is not allowed; name each place in the observation once")
        names = tuple(f"observation_{index}" for index in choice)
        return names, tuple(finite_bounds(*bounds_O[index]) for index in choice)
    try:
        size = _size(task, choice, action_size)
    except TaskError:
        raise
    except Exception as error:  # the user's function can raise anything
        raise TaskError(f"task.descriptor = {choice}: {users_error(error, choice) or error}") from None
    function = import_named(choice, "function") if ":" in choice else None
    return dimensions(f"task.descriptor = {choice}", choice, size, function)


def dimensions(where: str, name: str, size: int, function: Any = None) -> Described:
    """Names and bounds of an array that is a descriptor, or a part of one.

    Args:
        where: what chooses it, for messages.
        name: of the array, from which names are made; or `module:function`.
        function: a function of the user's that computes it and may have `descriptor_names` and `descriptor_bounds`.

    Raises:
        TaskError: what the function declares does not fit, or a name is that of a column.
    """
    name = name.rpartition(":")[2]
    names = (name,) if size == 1 else tuple(f"{name}_{index}" for index in range(size))
    names = tuple(map(str, getattr(function, "descriptor_names", names)))
    bounds: Any = getattr(function, "descriptor_bounds", (UNBOUNDED,) * size)
    wrong = wrong_pairs("descriptor_bounds", bounds)
    if {len(names), len(bounds)} != {size}:
        wrong.append(f"{size} numbers, but {len(names)} descriptor_names and {len(bounds)} descriptor_bounds")
    wrong += clashes(names)
    if wrong:
        raise TaskError(f"{where}: {'; '.join(wrong)}")
    return names, tuple((float(low), float(high)) for low, high in bounds)


def _of_info(key: str, size: int) -> Callable[[HostEpisode], Any]:
    """The newest value of a key of `info` in the episode; NaN before the first."""
    return lambda episode: episode.said.get(key, np.full(size, np.nan))


def _size(task: HostTask, choice: str, action_size: int) -> int:
    """How many numbers a descriptor has, from some steps."""
    environment = HostEnvironment(task)
    (action,) = task.actions(np.zeros((1, action_size), np.float32))
    environment.reset(0)
    for _ in range(SOME_STEPS):
        done = environment.step(copy(action))[2]
        if ":" in choice or choice in environment.info:
            return environment.measured_size()
        if done:
            environment.reset(0)
    known = ", ".join(map(str, environment.info)) or "no keys"
    raise TaskError(f"task.descriptor = {choice}: the info of {task.name} has {known} after {SOME_STEPS} steps")


def finite_bounds(low: float, high: float) -> tuple[float, float]:
    """Bounds as a description has them: UNBOUNDED if one is infinite, or so large that it says nothing."""
    return (low, high) if math.isfinite(low) and math.isfinite(high) and abs(low) + abs(high) < 1e6 else UNBOUNDED
