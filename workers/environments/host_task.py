"""Tasks of Python objects, which their rollout steps: one object for each episode at a time.

An object has a state of its own, and only `reset` starts its next episode. So its results are pure functions of the
seed and the actions as far as the object keeps nothing from one episode to the next.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Bounds, FloatArray, HostChoices
from es_service.protocol.user_code import raised
from workers.environments import TaskError

IS_SUCCESS = "is_success"
"""Key of `info` that says whether an episode has succeeded, if a config chooses no other."""
TRIED_STEPS = 3
"""Steps that are done with a new task, to see what its object returns."""
LENGTH = "length"
"""Name of the descriptor of a task that declares none: the number of steps of the episode."""


@dataclass
class HostEpisode:
    """The present episode of a Python object so far."""

    environment: Any
    """The object itself."""
    observation_O: FloatArray
    """The newest observation, flat."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """The `info` that came with the newest observation."""
    said: dict[str, Any] = field(default_factory=dict)
    """The newest value of every key that `info` has had in this episode."""
    steps: int = 0
    counted: dict[str, list[Any]] = field(default_factory=dict)
    """All values that the keys `HostTask.counted` of `info` have had in this episode."""
    observations: list[FloatArray] = field(default_factory=list)
    """All observations from the reset on, and"""
    rewards: list[float] = field(default_factory=list)
    """all rewards, if the descriptor is a function of the episode that the config names; else empty."""


def no_metrics(episode: HostEpisode) -> tuple[()]:
    return ()


@dataclass(frozen=True)
class HostTask:
    """A task of Python objects as functions; only what they make has a state."""

    name: str
    make: Callable[[], Any]
    """Makes an object with `reset(seed)` and `step(action)`, which return what those of Gymnasium return, or only an
    observation, and (observation, reward, done)."""
    observation_size: int
    flat: Callable[[Any], Any]
    """Function from an observation of the object to numbers, in any shape; what is no numbers stays that."""
    actions: Callable[[FloatArray], Any]
    """Function from actions of a policy [L, A] to a sequence [L] of actions of the object."""
    descriptor_size: int
    descriptor: Callable[[HostEpisode], Any]
    """Function from an episode that ends now to its descriptor [B]."""
    success: Callable[[HostEpisode], Any]
    """Function from an episode that ends now to whether it has succeeded."""
    goal_distance: Callable[[HostEpisode], Any] | None = None
    """Function from an episode to the present distance to the goal; None if there is no goal."""
    reset_by_key: Callable[[Any, NDArray[np.uint32]], Any] | None = None
    """Function (object, stream key) that begins an episode and returns what `reset` returns, with the noise of the key
    as far as the object can draw it; None if it takes nothing but a seed."""
    keeps_all: bool = False
    """Whether `HostEpisode` has all observations and rewards."""
    new_objects: bool = False
    """Whether each episode has a new object, so that nothing is carried over from one to the next."""
    metric_names: tuple[str, ...] = ()
    metrics: Callable[[HostEpisode], Any] = no_metrics
    """Function from an episode that ends now to its metrics [M]."""
    counted: tuple[str, ...] = ()
    """Keys of `info` of which `HostEpisode` has all values."""


CONTRACTS = {
    "reset": "reset(seed) must start an episode that depends only on the seed, and return an observation of {}, "
    "or (observation, info)",
    "step": "step(action) must do one step, and return (observation, reward, done), or (observation, reward, "
    "terminated, truncated, info)",
}
"""Method -> what it must take and return, in words; {} is for the size of an observation."""


class HostEnvironment:
    """A Python object as an environment: one episode after another, with observations as flat arrays.

    Its methods raise what the object raises, and TaskError if the object's methods take or return something else.
    """

    def __init__(self, task: HostTask) -> None:
        self._task, self._object = task, task.make()
        self._require_arguments("reset", "an argument named seed", seed=0)
        self._require_arguments("step", "an action", 0)
        self._episode = HostEpisode(self._object, np.zeros(0, np.float32))
        self._is_new = True
        self.first_observation_O = self._episode.observation_O
        """Observation [O] with which the present episode began."""

    def reset(self, seed: int, key: NDArray[np.uint32] | None = None) -> FloatArray:
        """Start an episode, and return its first observation [O].

        Args:
            key: stream key with whose noise the object draws the start if it can; None: with the seed alone.
        """
        if self._task.new_objects and not self._is_new:
            closes = getattr(self._object, "close", None)
            if callable(closes):
                closes()
            self._object = self._task.make()
        self._is_new = False
        if key is None or self._task.reset_by_key is None:
            result = self._object.reset(seed=seed)
        else:
            result = self._task.reset_by_key(self._object, key)
        is_pair = isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping | None)
        observation, info = result if is_pair else (result, {})  # as those of Gymnasium return, or the first alone
        self._require_info("reset", info)
        self._episode = HostEpisode(self._object, self._observed("reset", observation), info, dict(info))
        self.first_observation_O = self._episode.observation_O
        if self._task.keeps_all:
            self._episode.observations.append(self._episode.observation_O)
        return self._episode.observation_O

    def step(self, action: Any) -> tuple[FloatArray, float, bool]:
        """Do one step: (observation [O], reward, whether the episode has ended)."""
        result = self._object.step(action)
        if not isinstance(result, tuple | list) or len(result) not in (3, 5):
            returned = f"{len(result)} values" if isinstance(result, tuple | list) else _shown(result)
            raise self._broken("step", f"returned {returned}")
        observation, given, *ends = result
        try:
            episode, reward = self._episode, float(given)
        except (TypeError, ValueError):
            raise TaskError(f"{self._task.name}: step returned the reward {given!r}; it must be a number") from None
        episode.observation_O, episode.steps = self._observed("step", observation), episode.steps + 1
        episode.info = ends[2] if len(ends) == 3 else {}
        self._require_info("step", episode.info)
        episode.said |= episode.info
        for key in self._task.counted:
            if key in episode.info:
                episode.counted.setdefault(key, []).append(self._number(key, episode.info[key]))
        if self._task.keeps_all:
            episode.observations.append(episode.observation_O)
            episode.rewards.append(reward)
        names = ("done",) if len(ends) == 1 else ("terminated", "truncated")
        has_ended = False
        for name, end in zip(names, ends, strict=False):
            if isinstance(given, bool | np.bool_) and np.asarray(end).dtype.kind == "f":
                raise self._broken("step", f"returned the reward {given} and {name} = {end} (are the two swapped?)")
            if (is_true := _bool(end)) is None:
                raise self._broken("step", f"returned {name} = {_shown(end)}, which is not one bool (or 0 or 1)")
            has_ended |= is_true
        return episode.observation_O, reward, has_ended

    @property
    def info(self) -> Mapping[str, Any]:
        """The `info` that came with the newest observation."""
        return self._episode.info

    def descriptor(self) -> FloatArray:
        """Descriptor [B] of the episode if it ends now."""
        return self._numbers("the descriptor", self._task.descriptor(self._episode), self._task.descriptor_size)

    def measured_size(self) -> int:
        """How many numbers the descriptor has, for a task that does not know it yet."""
        return np.asarray(self._task.descriptor(self._episode), np.float32).size

    def goal_distance(self) -> float:
        """Present distance to the goal, NaN without one."""
        if self._task.goal_distance is None:
            return math.nan
        return self._numbers("goal_distance", self._task.goal_distance(self._episode), 1).item()

    def success(self) -> bool:
        """Whether the episode has succeeded if it ends now."""
        value = self._task.success(self._episode)
        if (has_succeeded := _bool(value)) is None:
            raise TaskError(f"{self._task.name}: success is {_shown(value)}; it must be one bool")
        return has_succeeded

    def metrics(self) -> FloatArray:
        """Metrics [M] of the episode if it ends now."""
        return self._numbers("the value of metrics", self._task.metrics(self._episode), len(self._task.metric_names))

    def _number(self, key: str, value: Any) -> float:
        return self._numbers(f"info[{key!r}], which task.metrics names,", value, 1).item()

    def _require_info(self, method: str, info: Any) -> None:
        if not isinstance(info, Mapping):
            raise TaskError(f"{self._task.name}: {method} returned the info {info!r}; it must be a mapping")

    def _require_arguments(self, method: str, takes: str, *arguments: Any, **named: Any) -> None:
        called = getattr(self._object, method)
        if not callable(called):
            raise self._broken(method, f"is no method, but {called!r}")
        try:
            signature = inspect.signature(called)
        except (TypeError, ValueError):  # some functions in C have none
            return
        try:
            signature.bind(*arguments, **named)
        except TypeError:
            raise self._broken(method, f"takes {signature} and not {takes}") from None

    def _broken(self, method: str, what: str) -> TaskError:
        contract = CONTRACTS[method].format(_counted(self._task.observation_size))
        return TaskError(f"{self._task.name}: {method} {what}; {contract}")

    def _numbers(self, what: str, value: Any, size: int) -> FloatArray:
        """A value as an array [N]; a copy, since an object may change the array that it has returned."""
        if (array_N := _array(value)) is None:
            raise TaskError(f"{self._task.name}: {what} is {_shown(value)}; it must be {_counted(size)}")
        return self._of_size(what, array_N, size)

    def _observed(self, method: str, observation: Any) -> FloatArray:
        flat_O = None if observation is None else _array(self._task.flat(observation))
        if flat_O is None:
            raise self._broken(method, f"returned the observation {_shown(observation)}")
        return self._of_size("an observation", flat_O, self._task.observation_size)

    def _of_size(self, what: str, array_N: FloatArray, size: int) -> FloatArray:
        if array_N.size != size:
            raise TaskError(f"{self._task.name}: {what} has {_counted(array_N.size)}, not {size}")
        return array_N


def length(episode: HostEpisode) -> float:
    return float(episode.steps)


def said_success(episode: HostEpisode) -> bool:
    """Whether the newest `info` says that the episode has succeeded."""
    return bool(episode.info.get(IS_SUCCESS, False))


def with_choices(task: HostTask, choices: HostChoices) -> HostTask:
    """The task with what a config chooses of it, but for the descriptor."""
    success = task.success
    if (key := choices.success) is not None:
        success = lambda episode: episode.info.get(key, False)  # noqa: E731
    return replace(task, success=success, new_objects=choices.new_objects)


def success_in_words(choices: HostChoices, told: Collection[str], own: str = "") -> tuple[str, tuple[str, ...]]:
    """Which episodes succeed, empty if the task does not tell; and what the author of a config should know of it.

    Args:
        told: keys of the `info` of the first steps.
        own: which succeed as the task itself says.
    """
    chosen = choices.success
    if chosen is None and (own or IS_SUCCESS not in told):
        return own, ()
    key, has = chosen or IS_SUCCESS, ", ".join(map(str, sorted(told, key=str))) or "no keys"
    note = f"task.success = {key}: the info of the first steps has {has}; without this key, no episode succeeds"
    return f"the info of the last step has a true {key}", () if key in told else (note,)


def try_out(task: HostTask, action_size: int) -> set[str]:
    """Do some steps with actions of zeros; returns the keys of the `info` that the steps have.

    Raises:
        TaskError: the object raises, or does not return what the task declares.
    """
    keys: set[str] = set()
    try:
        environment = HostEnvironment(task)
        (action,) = task.actions(np.zeros((1, action_size), np.float32))
        done = True
        for seed in range(TRIED_STEPS):
            if done:
                environment.reset(seed)
            _, _, done = environment.step(copy(action))  # an object may change its array
            for ask in (environment.descriptor, environment.goal_distance, environment.success, environment.metrics):
                ask()
            keys |= {*environment.info}
    except TaskError:
        raise
    except Exception as error:  # the user's code can raise anything
        raise TaskError(f"{task.name} cannot do a step: {raised(error, task.name)}") from error
    return keys


def within_bounds(bounds: Any, dtype: Any = np.float32) -> Callable[[FloatArray], NDArray[Any]]:
    """Function from actions of a policy to actions between bounds: -1 and 1 become the bounds, and what is beyond is
    clipped; whole numbers are rounded. A bound that is infinite clips nothing, and its dimension is not scaled.

    Args:
        bounds: (low, high) of each dimension, or of all.
    """
    pairs_A_2 = np.asarray(bounds).reshape(-1, 2)
    low_A, high_A = pairs_A_2.astype(np.float32).T
    is_finite_A = np.isfinite(low_A) & np.isfinite(high_A)
    with np.errstate(invalid="ignore", over="ignore"):
        middle_A = np.where(is_finite_A, 0.5 * low_A + 0.5 * high_A, 0.0).astype(np.float32)
        half_A = np.where(is_finite_A, 0.5 * high_A - 0.5 * low_A, 1.0).astype(np.float32)
    if np.dtype(dtype) == np.float32:
        return lambda action_L_A: np.clip(middle_A + half_A * action_L_A, low_A, high_A)
    # The bounds of other types need not be numbers of float32, nor those of 64-bit integers of float64.
    least_A = [np.nextafter(float(x), math.inf) if float(x) < x else x for x in pairs_A_2[:, 0].tolist()]
    most_A = [np.nextafter(float(x), -math.inf) if float(x) > x else x for x in pairs_A_2[:, 1].tolist()]
    nearest = np.rint if np.issubdtype(dtype, np.integer) else np.asarray
    between = partial(np.clip, a_min=np.array(least_A, np.float64), a_max=np.array(most_A, np.float64))
    return lambda action_L_A: between(nearest((middle_A + half_A * action_L_A).astype(np.float64))).astype(dtype)


def action_bounds(bounds: Any, size: int) -> Bounds:
    """What -1 and 1 become by `within_bounds`, for each of `size` dimensions; empty if they stay -1 and 1.

    The numbers are those of their texts, since -0.4 in float32 is -0.4000000059604645.
    """
    pairs_A_2 = np.broadcast_to(np.asarray(bounds).reshape(-1, 2), (size, 2))
    pairs = [
        (float(str(low)), float(str(high))) if np.isfinite([low, high]).all() else (-1.0, 1.0)
        for low, high in pairs_A_2
    ]
    return () if set(pairs) == {(-1.0, 1.0)} else tuple(pairs)


def chosen(action_L_A: FloatArray) -> list[int]:
    """Actions of a policy that chooses among several, as the numbers of the chosen ones."""
    return np.argmax(action_L_A, axis=-1).tolist()


def unchanged(action_L_A: FloatArray) -> FloatArray:
    """Actions of a policy as they are, in arrays that the object may change."""
    return action_L_A.copy()


def _counted(size: int) -> str:
    return "1 number" if size == 1 else f"{size} numbers"


def _array(value: Any) -> FloatArray | None:
    """A copy of numbers as an array [N], or None if they are no numbers."""
    if value is not None:  # which NumPy takes for NaN
        with suppress(TypeError, ValueError):
            return np.array(value, np.float32).reshape(-1)
    return None


def _bool(value: Any) -> bool | None:
    """What one bool says, or 0 or 1, also in an array; None for anything else."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    array = np.asarray(value)
    is_number = array.size == 1 and array.dtype.kind in "biuf"
    return bool(array.item()) if is_number and array.item() in (0, 1) else None


def _shown(value: Any) -> str:
    """A value in a message, on one line and not too long."""
    return "None (is a `return` missing?)" if value is None else shorten(repr(value), 100, placeholder=" ...")
