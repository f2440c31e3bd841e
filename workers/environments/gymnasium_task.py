"""Environments of Gymnasium as tasks, named `gymnasium:ID`, such as `gymnasium:Ant-v5`.

An ID may have the module that registers it before it, `gymnasium:package.module:Name-v0`; else, if it has a namespace
that is the name of a module, that module is imported. Ours have the namespace `es_service`. Observations are those of a
Box, flattened, or of a Discrete, one number for each value; actions those of a Box, between whose bounds the actions of
a policy are put, or of a Discrete, among which the policy chooses. `task.options` are keyword arguments of
`gymnasium.make`, and FLATTENED: with it, observations may be a Dict or a Tuple, also of such. They are then the numbers
of all parts, keys of a Dict sorted, row by row, as float32.

An episode ends where the environment says that it is terminated or truncated, or after `task.episode_steps`; the time
limit that Gymnasium adds is left out, and its number of steps is the default. The checks that Gymnasium adds to each
step are left out, too.

A vector entry point of the registration is not used: `VectorEnv.reset` takes one seed for all environments (or, in
some, one for each), those of Gymnasium draw the resets of all from one generator, and episodes that end are reset on
their own at the next step. So an episode would depend on the others of its batch, and no attribute tells whether it
does.
"""

from __future__ import annotations

import copy
import importlib
import importlib.util
import inspect
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import HostChoices, TaskSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers, seed_of, uniforms
from es_service.protocol.options import Option, OptionValue
from es_service.protocol.sources import LIBRARY, OUR_ENVIRONMENTS, OUR_NAMESPACE, user_path
from es_service.protocol.user_code import import_user_module, users_error, why_not_imported
from workers.environments import TaskError
from workers.environments.declared import describe_descriptor
from workers.environments.host_task import (
    LENGTH,
    HostTask,
    action_bounds,
    chosen,
    length,
    said_success,
    success_in_words,
    try_out,
    with_choices,
    within_bounds,
)
from workers.environments.python_task import missing_metrics, with_metrics

EPISODE_STEPS = 1000
"""Default length of an episode where the environment has no limit."""
FLATTENED = "flatten_observation"
"""Option of this project, no argument of `gymnasium.make`."""
OURS = {
    "max_episode_steps": "the length of an episode is the key task.episode_steps; set that instead",
    "disable_env_checker": "the checks that Gymnasium adds to each step are left out in every run; leave it out",
}
"""Arguments of `gymnasium.make` that a run decides, each with what to do instead."""


def describe(name: str, options: Mapping[str, OptionValue], choices: HostChoices) -> TaskSpec:
    """Description of the environment with the ID `name`.

    Args:
        options: keyword arguments of `gymnasium.make`.
        choices: what the config chooses besides.

    Raises:
        TaskError: there is no such environment, it cannot be made, or its spaces are not supported.
    """
    task, spec = with_metrics(with_choices(make(name, options), choices), choices), _registered(name)
    made = task.make()
    observations, actions = made.observation_space, made.action_space
    size = int(actions.n) if _is(actions, "Discrete") else int(np.prod(actions.shape))
    try:
        told = try_out(task, size)
    except TaskError as error:
        if not options or error.__cause__ is None:
            raise
        raise _refused(task.name, "do a step", options, error.__cause__) from error
    steps = spec.max_episode_steps or EPISODE_STEPS
    names, bounds = (LENGTH,), ((0.0, float(steps)),)
    if choices.descriptor is not None:
        names, bounds = describe_descriptor(task, choices.descriptor, _bounds(observations), size)
    success, notes = success_in_words(choices, told)
    return TaskSpec(
        name=task.name,
        observation_size=task.observation_size,
        action_size=size,
        episode_steps=steps,
        descriptor_names=names,
        descriptor_bounds=bounds,
        final_fitness=False,
        has_goal=False,
        options=_options(made, spec, options),
        summary=f"{type(made.unwrapped).__name__} of Gymnasium",
        success=success,
        notes=(*notes, *missing_metrics(task, told)),
        kind="python",
        metric_names=task.metric_names,
        discrete_actions=_is(actions, "Discrete"),
        action_bounds=() if _is(actions, "Discrete") else action_bounds(_pairs(actions), size),
    )


def make(name: str, options: Mapping[str, OptionValue]) -> HostTask:
    """The environment with the ID `name` as a task of Python objects."""
    gymnasium, spec, task = gymnasium_package(), copy.deepcopy(_registered(name)), f"{LIBRARY}:{name}"
    if wrong := [f"task.options.{key} = {options[key]!r}: {why}" for key, why in OURS.items() if key in options]:
        raise TaskError("; ".join(wrong))
    spec.order_enforce = False  # a wrapper that would check the order of calls
    arguments = {key: value for key, value in options.items() if key != FLATTENED}

    def construct() -> Any:
        try:
            return gymnasium.make(spec, max_episode_steps=-1, disable_env_checker=True, **arguments)
        except Exception as error:  # the environment's code can raise anything
            raise _refused(task, "be made", arguments, error) from error

    environment = construct()
    if options.get(FLATTENED) and _keys(environment.observation_space) is None:
        why = f"{task} has observations of one part, {environment.observation_space}; leave it out"
        raise TaskError(f"task.options.{FLATTENED} = true: {why}")
    size, flat = _observed(task, environment.observation_space, flattened=options.get(FLATTENED) is True)
    return HostTask(
        name=task,
        make=construct,
        observation_size=size,
        flat=flat,
        actions=_acted(task, environment.action_space),
        descriptor_size=1,
        descriptor=length,
        success=said_success,
        reset_by_key=_reset_by_key,
    )


def _reset_by_key(environment: Any, key: Any) -> Any:
    """Begin an episode whose start the environment draws from the noise of a stream key.

    The first reset seeds whatever the environment has besides Gymnasium's generator, which the second one uses.
    """
    environment.reset(seed=seed_of(key))
    environment.unwrapped.np_random = KeyedGenerator(key)
    return environment.reset()


def _refused(task: str, what: str, options: Mapping[str, OptionValue], error: BaseException) -> TaskError:
    """What an environment raised with the options of a config."""
    why = users_error(error, task) or f"{type(error).__name__}: {error}"
    return TaskError(f"{task} cannot {what} with the options {dict(options)}: {why}")


def gymnasium_package() -> Any:
    """The package gymnasium. Raises TaskError if it is not installed."""
    try:
        import gymnasium
    except ModuleNotFoundError:
        raise TaskError(
            "the package gymnasium is not installed; install es-service with its extra: pip install "
            "'es-service[gymnasium]'"
        ) from None
    return gymnasium


def _registered(name: str) -> Any:
    """The specification under which an environment is registered, after its module has been imported."""
    gymnasium, own = gymnasium_package(), user_path(f"{LIBRARY}:{name}")
    module = own.partition(":")[0]
    try:
        if own and (":" in name or _exists(module)):
            import_user_module(own)
        elif name.startswith(f"{OUR_NAMESPACE}/"):
            importlib.import_module(OUR_ENVIRONMENTS)
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{LIBRARY}:{name}: {why_not_imported(module, error)}") from error
    environment = name.partition(":")[2] if ":" in name else name
    try:
        return gymnasium.spec(environment)
    except gymnasium.error.Error as error:
        near = get_close_matches(environment, gymnasium.registry, 1, 0.5)
        hint = f"; did you mean {LIBRARY}:{near[0]}?" if near else ""
        if ":" not in name:
            hint += f"; if the import of a module registers it, name this module: {LIBRARY}:MODULE:{environment}"
        raise TaskError(f"{LIBRARY}:{name} is not registered in Gymnasium ({error}){hint}") from error


def _exists(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def _is(space: Any, kind: str) -> bool:
    return isinstance(space, getattr(gymnasium_package().spaces, kind))


def _observed(task: str, space: Any, *, flattened: bool) -> tuple[int, Callable[[Any], Any]]:
    """(size of an observation, function from an observation to numbers)."""
    if _is(space, "Box") or _is(space, "MultiBinary"):
        return _size(task, "observations", space), lambda observation: observation
    if _is(space, "Discrete"):
        values = np.arange(space.n) + space.start
        return int(space.n), lambda observation: values == observation
    if (keys := _keys(space)) is None:
        raise TaskError(
            f"{task} has observations of the space {space}; Box, Discrete, MultiBinary, Dict and Tuple of these are "
            "supported. Register the environment with a wrapper that makes a Box of them, such as "
            "gymnasium.wrappers.FlattenObservation"
        )
    if not flattened:
        raise TaskError(
            f"{task} has observations of the space {space}, which has several parts. The numbers of all of them, in "
            f"the order {', '.join(map(str, keys))}, are the observation with task.options.{FLATTENED}=true"
        )
    parts = [(key, *_observed(task, space[key], flattened=True)) for key in keys]

    def flat(observation: Any) -> Any:
        return np.concatenate([np.asarray(of(observation[key]), np.float32).reshape(-1) for key, _, of in parts])

    return sum(size for _, size, _ in parts), flat


def _keys(space: Any) -> list[Any] | None:
    """Keys of the parts of a Dict, sorted, or of a Tuple; None for any other space."""
    if _is(space, "Dict"):
        return sorted(space.keys())
    return [*range(len(space.spaces))] if _is(space, "Tuple") else None


def _acted(task: str, space: Any) -> Callable[[Any], Any]:
    """Function from actions of a policy [L, A] to actions of an environment."""
    if _is(space, "Box"):
        _size(task, "actions", space)
        bounded = within_bounds(_pairs(space), space.dtype)
        return lambda action_L_A: bounded(action_L_A).reshape(-1, *space.shape)
    if _is(space, "Discrete"):
        first = int(space.start)
        return chosen if first == 0 else lambda action_L_A: [first + action for action in chosen(action_L_A)]
    raise TaskError(
        f"{task} has actions of the space {space}; Box and Discrete are supported. Register the environment with a "
        "wrapper that takes one of these, such as gymnasium.wrappers.TransformAction"
    )


def _pairs(box: Any) -> Any:
    """(low, high) of each number of a Box."""
    return np.stack([box.low.reshape(-1), box.high.reshape(-1)], axis=-1)


def _size(task: str, what: str, box: Any) -> int:
    size = int(np.prod(box.shape))
    if not size:
        raise TaskError(f"{task} has {what} of the space {box}, which are empty; a policy needs at least one number")
    return size


def _bounds(space: Any) -> list[tuple[float, float]]:
    """Bounds of each number of a flat observation."""
    if (keys := _keys(space)) is not None:
        return [pair for key in keys for pair in _bounds(space[key])]
    if _is(space, "MultiBinary"):
        return [(0.0, 1.0)] * int(np.prod(space.shape))
    if _is(space, "Discrete"):
        return [(0.0, 1.0)] * int(space.n)
    low_O, high_O = ([float(str(number)) for number in bound.reshape(-1)] for bound in (space.low, space.high))
    return list(zip(low_O, high_O, strict=True))  # by their texts, since -1.2 in float32 is -1.2000000476837158


def _options(made: Any, spec: Any, given: Mapping[str, OptionValue]) -> dict[str, Option]:
    """The keyword arguments that a config can set; those whose default is no plain value, such as a tuple, have none
    here, and the environment's own unless the config sets them."""
    parameters = [*inspect.signature(type(made.unwrapped).__init__).parameters.values()][1:]
    named = [one for one in parameters if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    defaults = {one.name: one.default for one in named} | spec.kwargs
    if _keys(made.observation_space) is not None:
        defaults[FLATTENED] = False
    plain = {name: value if type(value) in (bool, int, float, str) else None for name, value in defaults.items()}
    for name, value in given.items():
        if plain.get(name) is None or (type(plain[name]), type(value)) == (int, float):
            plain[name] = value  # a whole number as a default does not say that others are not allowed
    return {name: Option(value) for name, value in plain.items()}


class KeyedGenerator(np.random.Generator):
    """A generator of NumPy whose uniform and normal variates are those of a stream, one coordinate after another.

    An environment that draws its start with it has the start of a task in JAX that draws the same variates of the key
    in the same order. Other methods draw from PCG64 with the seed of the key, as do calls with further arguments.
    """

    def __init__(self, reset_key_4: NDArray[np.uint32]) -> None:
        super().__init__(np.random.PCG64(seed_of(reset_key_4)))
        self._key, self._next = reset_key_4, 0

    def random(self, size: Any = None, *more: Any, **named: Any) -> Any:
        if more or named:
            return super().random(size, *more, **named)
        return self._drawn(uniforms, size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        shape = np.broadcast_shapes(np.shape(low), np.shape(high)) if size is None else size
        return low + (np.asarray(high) - low) * self._drawn(uniforms, shape or None)

    def standard_normal(self, size: Any = None, *more: Any, **named: Any) -> Any:
        if more or named:
            return super().standard_normal(size, *more, **named)
        return self._drawn(lambda key, at: normal_integers(np, key, at) / NORMAL_STD, size)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        shape = np.broadcast_shapes(np.shape(loc), np.shape(scale)) if size is None else size
        return loc + scale * self.standard_normal(shape or None)

    def _drawn(self, variates: Any, size: Any) -> Any:
        """Variates at the next coordinates: a number, or an array of the shape `size`."""
        count = 1 if size is None else int(np.prod(size))
        coordinate = np.arange(self._next, self._next + count, dtype=np.uint32)
        self._next += count
        drawn = np.asarray(variates(self._key, coordinate), np.float64)
        return float(drawn[0]) if size is None else drawn.reshape(size)
