"""Environments of suites in JAX as tasks, such as `gymnax:CartPole-v1`: what they have in common.

The module `NAME_task` of a suite has `PACKAGE`, `names()`, and `suite(name, options)`, which gives a `Suite`: pure
functions of a key, a state and an action. This module makes a task of it:

- The key of an episode is the first two words of the stream key, a raw key of JAX. The reset gets it folded with 0, and
  step t, from 1 on, folded with t; so an environment that draws nothing does not pay for keys.
- Nothing resets by itself. An episode ends where the suite says that it terminates or is truncated.
- An observation is the numbers of all arrays that the suite observes, in JAX's order of pytrees (keys of a dict sorted,
  fields of a named tuple as declared), row by row, as float32.
- An action is a number for each actuator, of which -1 and 1 are the bounds and what is beyond is clipped; or one number
  for each choice, of which the greatest is taken, the first of equal ones. With several choices at a time, these follow
  one another, or there is one number for each combination if a mask is one of combinations. Choices that a mask forbids
  are not taken: `argmax` and `categorical` choose among the others.
- `task.options.descriptor` has indices of numbers of the last observation and names of measures, which are arrays that
  the suite tells besides, or is `module:function`, a function of the user's from the suite's last state to an array.
  Without it, the descriptor is the suite's own, or the number of steps.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.errors import WayOut
from es_service.protocol.messages import UNBOUNDED, Bounds, TaskSpec
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import Option, OptionValue
from es_service.protocol.user_code import users_error
from workers.environments import Environment, TaskError
from workers.environments.brax_task import quietly
from workers.environments.declared import Described, dimensions, import_named
from workers.environments.host_task import action_bounds
from workers.environments.user_task import words_in_place_of_keys


@dataclass(frozen=True)
class Package:
    """The package of a suite."""

    module: str
    """What is imported first."""
    brings: str
    """What an installation of the extra of ours brings that has the suite's name, in words."""
    command: str = ""
    """The command that installs it where no extra can."""


@dataclass(frozen=True)
class Suite:
    """An environment of a suite."""

    name: str
    """As in `task.environment`."""
    reset: Callable[[Any], tuple[Any, Any]]
    """Function from a raw key of JAX, uint32 [2], to (state, observation)."""
    step: Callable[[Any, Any, Any], tuple[Any, Any, Any, Any]]
    """Function (key, state, action) -> (state, observation, reward, done)."""
    actions: Choices | Actuators
    episode_steps: int
    """The suite's own limit."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Options of the task besides `descriptor`."""
    observation_bounds: Bounds = ()
    """(low, high) of each number of an observation, or empty."""
    mask: Callable[[Any], Any] | None = None
    """Function from a state to the choices that are allowed, bool [numbers of an action]; None: all are."""
    measures: Callable[[Any], Mapping[str, Any]] = lambda state: {}
    """Function from a state to arrays of which a descriptor may be made, by name."""
    described: Mapping[str, Described] = field(default_factory=dict)
    """Names and bounds of the numbers of some measures. The first of these measures is the suite's own descriptor."""
    goal_distance: Callable[[Any], Any] = lambda state: jnp.float32(jnp.nan)
    """Function from a state to the distance to the goal, NaN if there is none."""
    success: Callable[[Any, Any], Any] = lambda state, before: before
    """As `Environment.success`."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Other fields of its `TaskSpec`, such as `walls`."""


@dataclass(frozen=True)
class Choices:
    """Actions that are whole numbers from 0 on."""

    counts: tuple[int, ...]
    """Numbers of choices; with a single one, the suite's action is a number and not an array."""
    single: bool = True
    together: bool = False
    """Whether an action of the policy has a number for each combination, row by row, and not for each choice."""
    bounds: ClassVar[Bounds] = ()

    @property
    def size(self) -> int:
        """Numbers in an action of the policy."""
        return math.prod(self.counts) if self.together else sum(self.counts)

    def of(self, action_A: Any, allowed_A: Any) -> Any:
        """The suite's action."""
        action_A = jnp.where(allowed_A, action_A, -jnp.inf)
        if self.together:
            return jnp.stack(jnp.unravel_index(jnp.argmax(action_A), self.counts)).astype(jnp.int32)
        ends = np.cumsum([0, *self.counts]).tolist()
        chosen = [jnp.argmax(action_A[start:end]).astype(jnp.int32) for start, end in pairwise(ends)]
        return chosen[0] if self.single else jnp.stack(chosen)


@dataclass(frozen=True)
class Actuators:
    """Actions that are numbers between bounds."""

    low: Any
    high: Any
    """Arrays in the shape of the suite's action."""

    @property
    def size(self) -> int:
        """Numbers in an action of the policy."""
        return int(np.size(self.low))

    @property
    def bounds(self) -> Bounds:
        """What the actions -1 and 1 of a policy become, for each number."""
        pairs = zip(np.ravel(self.low).tolist(), np.ravel(self.high).tolist(), strict=True)
        return action_bounds(tuple(pairs), self.size)

    def of(self, action_A: Any, allowed_A: Any) -> Any:
        """The suite's action."""
        low, high = (np.asarray(bound, np.float32) for bound in (self.low, self.high))
        half = (0.5 * (high - low)).astype(np.float32)
        return low + half * (jnp.clip(action_A, -1.0, 1.0).reshape(low.shape) + 1.0)


class _SuiteState(NamedTuple):
    suite: Any
    observation_O: Any
    key: Any
    step: Any


def suite_module(suite: str, package: Package, module: str = "") -> Any:
    """The package of a suite, or a module of it. Raises TaskError with the way to install it if it is not installed."""
    try:
        with quietly():
            return importlib.import_module(module or package.module)
    except ModuleNotFoundError as error:
        why = "is not installed" if error.name == package.module else f"lacks the package {error.name}"
        way = package.command or WayOut("install", "", extra=suite).call()
        raise TaskError(f"the package {package.module} {why}; install {package.brings} {way}") from None


def adapter(suite: str) -> Any:
    """The module with the environments of a suite."""
    return importlib.import_module(f"workers.environments.{suite}_task")


def describe(name: str, given: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of `SUITE:NAME` as a task; `given` are values of options that are not the defaults.

    Raises:
        TaskError: the suite is not installed, has no such environment, or one that cannot be a task.
    """
    return describe_suite(_made(name, given), given)


def make(name: str, options: Mapping[str, OptionValue]) -> Environment:
    """Functions of `SUITE:NAME` with values of its options."""
    return make_suite(_made(name, options), options.get("descriptor"))


def _made(name: str, options: Mapping[str, OptionValue]) -> Suite:
    suite, _, rest = name.partition(":")
    require_known(suite, rest, adapter(suite).names())
    try:
        with quietly():
            return adapter(suite).suite(rest, options)
    except TaskError:
        raise
    except Exception as error:  # the network, git, or a folder that cannot be written
        raise TaskError(
            f"{name} cannot be loaded ({type(error).__name__}: {error}); if it downloads models or data, "
            "load it once where there is a network, and copy what it has stored"
        ) from error


def parameters_with(defaults: Any, length: str, given: Mapping[str, OptionValue]) -> tuple[dict[str, Option], Any]:
    """Options for the single numbers among a suite's parameters, apart from the length of an episode, and the
    parameters with the values that are given for them."""
    numbers = {field.name: getattr(defaults, field.name) for field in fields(defaults) if field.name != length}
    options = {name: Option(value) for name, value in numbers.items() if type(value) in (bool, int, float)}
    return options, defaults.replace(**{name: value for name, value in given.items() if name in options})


def require_known(suite: str, name: str, names: Iterable[str]) -> None:
    """Raise TaskError with the nearest name if a suite has no environment of a name."""
    known = sorted(names)
    if name not in known:
        near = get_close_matches(name, known, n=1, cutoff=0.3)
        hint = f"; did you mean {suite}:{near[0]}?" if near else ""
        raise TaskError(f"{suite}:{name} is not in the installed suite{hint}; these are: {', '.join(known)}")


def describe_suite(suite: Suite, given: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of an environment of a suite; `given` are values of options that are not the defaults."""
    (names, bounds), _, size = _descriptor(suite, given.get("descriptor"))
    has_choices = isinstance(suite.actions, Choices)
    takes_one = isinstance(suite.actions, Choices) and suite.actions.single and suite.mask is None
    facts = {"final_fitness": False, "has_goal": False, "summary": f"an environment of {suite.name.partition(':')[0]}"}
    return TaskSpec(
        name=suite.name,
        observation_size=size,
        action_size=suite.actions.size,
        episode_steps=suite.episode_steps,
        descriptor_names=names,
        descriptor_bounds=bounds,
        options={"descriptor": Option(None), **suite.options},
        action_bounds=suite.actions.bounds,
        discrete_actions=takes_one,
        ranked_actions=has_choices and not takes_one,
        **{**facts, **suite.facts},
    )


def _descriptor(suite: Suite, given: Any) -> tuple[Described, Callable[[_SuiteState], Any], int]:
    """Names and bounds of a descriptor, what computes it, and the numbers of an observation. Raises TaskError if it
    cannot be chosen."""
    with quietly():
        state, observation = jax.eval_shape(suite.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
    size = _size(jax.tree.leaves(observation))
    chosen = next(iter(suite.described), None) if given is None else given
    if chosen is None:
        length = ("length",), ((0.0, float(suite.episode_steps)),)
        return length, lambda state: state.step[None].astype(jnp.float32), size
    if isinstance(chosen, str) and ":" in chosen:
        return *_of_user(chosen, state), size
    measured = {name: _size([array]) for name, array in jax.eval_shape(suite.measures, state).items()}
    parts = chosen if isinstance(chosen, list) else [chosen]
    found: list[Described] = []
    for part in parts:
        if type(part) is int and 0 <= part < size:
            bounds = suite.observation_bounds[part] if suite.observation_bounds else UNBOUNDED
            found.append(((f"observation_{part}",), (bounds,)))
        elif isinstance(part, str) and part in measured:
            found.append(suite.described.get(part) or dimensions(suite.name, re.sub(r"\W", "_", part), measured[part]))
    if not parts or len(found) != len(parts) or len({*parts}) < len(parts):
        names = f", names of measures ({', '.join(measured)})" if measured else ""
        raise TaskError(
            f"task.options.descriptor = {given!r} is not allowed; must be a list of different places in an "
            f"observation, 0 to {size - 1}{names}, or module:function"
        )

    def described(state: _SuiteState) -> Any:
        arrays = suite.measures(state.suite)
        taken = [state.observation_O[part] if type(part) is int else arrays[part] for part in parts]
        return jnp.concatenate([jnp.ravel(one).astype(jnp.float32) for one in taken])

    names, bounds = (sum(column, ()) for column in zip(*found, strict=True))
    return (names, bounds), described, size


def _size(arrays: Iterable[Any]) -> int:
    return sum(math.prod(array.shape) for array in arrays)


def _of_user(path: str, state: Any) -> tuple[Described, Callable[[_SuiteState], Any]]:
    """Names and bounds of a descriptor that is a function of the user's, and what computes it."""
    function = import_named(path, "function")
    try:
        size = _size([jax.eval_shape(lambda state: jnp.ravel(jnp.asarray(function(state))), state)])
    except Exception as error:  # the user's function can raise anything
        why = users_error(error, path) or error
        raise TaskError(f"task.options.descriptor = {path}: {why}") from None
    described = dimensions(f"task.options.descriptor = {path}", path, size, function)
    return described, lambda state: jnp.ravel(jnp.asarray(function(state.suite), jnp.float32))


def make_suite(suite: Suite, descriptor: Any = None) -> Environment:
    """Functions of an environment of a suite; `descriptor` is the option of that name."""

    def flat(observation: Any) -> Any:
        leaves = [jnp.asarray(leaf).astype(jnp.float32).reshape(-1) for leaf in jax.tree.leaves(observation)]
        return jnp.concatenate(leaves)

    def reset_as_it_is(key: Any) -> _SuiteState:
        with quietly():
            state, observation = suite.reset(jax.random.fold_in(key[:2], 0))
        return _SuiteState(state, flat(observation), key[:2], jnp.int32(0))

    def step_as_it_is(state: _SuiteState, action_A: Any) -> tuple[_SuiteState, Any, Any]:
        allowed_A = True if suite.mask is None else jnp.ravel(suite.mask(state.suite))
        number = state.step + 1
        with quietly():
            after, observation, reward, done = suite.step(
                jax.random.fold_in(state.key, number), state.suite, suite.actions.of(action_A, allowed_A)
            )
        reward = jnp.asarray(reward, jnp.float32).reshape(())
        return _SuiteState(after, flat(observation), state.key, number), reward, jnp.asarray(done, bool).reshape(())

    first = jax.eval_shape(reset_as_it_is, jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32))
    stepped = jax.eval_shape(step_as_it_is, first, jax.ShapeDtypeStruct((suite.actions.size,), jnp.float32))[0]
    _, described, _ = _descriptor(suite, descriptor)

    def settled(state: _SuiteState) -> _SuiteState:
        """A state with the dtypes that steps give, since resets write numbers such as 0 without one."""
        return jax.tree.map(lambda leaf, like: jnp.asarray(leaf).astype(like.dtype), state, stepped)

    def step(state: _SuiteState, action_A: Any) -> tuple[_SuiteState, Any, Any]:
        after, reward, done = step_as_it_is(state, action_A)
        return settled(after), reward, done

    return words_in_place_of_keys(
        Environment(
            lambda key: settled(reset_as_it_is(key)),
            lambda state: state.observation_O,
            step,
            described,
            lambda state: suite.goal_distance(state.suite),
            lambda state, before: suite.success(state.suite, before),
            compiles_drawn_resets=True,
        )
    )
