"""Environments of suites in JAX as tasks, such as `gymnax:CartPole-v1`: what they have in common.

An adapter gives a `Suite`: pure functions of a key, a state and an action. This module makes a task of it:

- The key of an episode is the first two words of the stream key, a raw key of JAX. The reset gets it folded with 0, and
  step t, from 1 on, folded with t; so an environment that draws nothing does not pay for keys.
- Nothing resets by itself. An episode ends where the suite says that it terminates or is truncated.
- An observation is the numbers of all arrays that the suite observes, in JAX's order of pytrees (keys of a dict sorted,
  fields of a named tuple as declared), row by row, as float32.
- An action is a number for each actuator, of which -1 and 1 are the bounds and what is beyond is clipped; or one number
  for each choice, of which the greatest is taken, the first of equal ones. With several choices at a time, these follow
  one another. Choices that a mask forbids are not taken.
- `task.options.descriptor` has the indices of numbers of the last observation; without it,
  the descriptor is the number of steps.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import UNBOUNDED, Bounds, TaskSpec
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import Option, OptionValue
from workers.environments import Environment, TaskError
from workers.environments.brax_task import quietly
from workers.environments.host_task import action_bounds
from workers.environments.user_task import words_in_place_of_keys


@dataclass(frozen=True)
class Suite:
    name: str
    """As in `task.environment`."""
    reset: Callable[[Any], tuple[Any, Any]]
    """Function from a raw key of JAX, uint32 [2], to (state, observation)."""
    step: Callable[[Any, Any, Any], tuple[Any, Any, Any, Any]]
    """Function (key, state, action) -> (state, observation, reward, done)."""
    actions: Choices | Actuators
    episode_steps: int
    """The suite's own limit."""
    observation_bounds: Bounds = ()
    """(low, high) of each number of an observation, or empty."""
    mask: Callable[[Any], Any] | None = None
    """Function from a state to the choices that are allowed, bool [numbers of an action]; None: all are."""


@dataclass(frozen=True)
class Choices:
    """Actions that are whole numbers from 0 on."""

    counts: tuple[int, ...]
    """Numbers of choices; with a single one, the suite's action is a number and not an array."""
    single: bool = True
    bounds: ClassVar[Bounds] = ()

    @property
    def size(self) -> int:
        """Numbers in an action of the policy."""
        return sum(self.counts)

    def of(self, action_A: Any, allowed_A: Any) -> Any:
        action_A = jnp.where(allowed_A, action_A, -jnp.inf)
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


def suite_package(module: str, way: str) -> Any:
    """The package of a suite. Raises TaskError with the way to install it, which is given, if it is not installed."""
    try:
        with quietly():
            return importlib.import_module(module)
    except ModuleNotFoundError as error:
        why = "is not installed" if error.name == module.partition(".")[0] else f"lacks the package {error.name}"
        raise TaskError(f"the package {module} {why}; install it with {way}") from None


def require_known(suite: str, name: str, names: Iterable[str]) -> None:
    """Raise TaskError with the nearest name if a suite has no environment of a name."""
    known = sorted(names)
    if name not in known:
        near = get_close_matches(name, known, n=1, cutoff=0.3)
        hint = f"; did you mean {suite}:{near[0]}?" if near else ""
        raise TaskError(f"{suite}:{name} is not in the installed suite, which has {', '.join(known)}{hint}")


def describe_suite(suite: Suite, options: Mapping[str, Option], given: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of an environment of a suite; `given` are values of options that are not the defaults."""
    with quietly():
        _, observation = jax.eval_shape(suite.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
    size = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(observation))
    indices = _indices(given.get("descriptor"), size)
    bounds = [suite.observation_bounds[index] if suite.observation_bounds else UNBOUNDED for index in indices]
    names = [f"observation_{index}" for index in indices]
    if not indices:
        names, bounds = ["length"], [(0.0, float(suite.episode_steps))]
    return TaskSpec(
        name=suite.name,
        observation_size=size,
        action_size=suite.actions.size,
        episode_steps=suite.episode_steps,
        descriptor_names=tuple(names),
        descriptor_bounds=tuple(bounds),
        final_fitness=False,
        has_goal=False,
        options={"descriptor": Option(None), **options},
        action_bounds=suite.actions.bounds,
        discrete_actions=isinstance(suite.actions, Choices) and suite.actions.single and suite.mask is None,
        summary=f"an environment of {suite.name.partition(':')[0]}",
    )


def _indices(given: Any, size: int) -> list[int]:
    """The places of the descriptor's numbers in an observation, none if none are given. Raises TaskError if they are
    no places."""
    if given is None:
        return []
    if not isinstance(given, list) or not given or any(type(n) is not int or not 0 <= n < size for n in given):
        raise TaskError(
            f"task.options.descriptor = {given!r} is not allowed; must be a list of places in an observation, "
            f"0 to {size - 1}"
        )
    return given


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
        allowed_A = True if suite.mask is None else suite.mask(state.suite)
        number = state.step + 1
        with quietly():
            after, observation, reward, done = suite.step(
                jax.random.fold_in(state.key, number), state.suite, suite.actions.of(action_A, allowed_A)
            )
        reward = jnp.asarray(reward, jnp.float32).reshape(())
        return _SuiteState(after, flat(observation), state.key, number), reward, jnp.asarray(done, bool).reshape(())

    first = jax.eval_shape(reset_as_it_is, jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32))
    stepped = jax.eval_shape(step_as_it_is, first, jax.ShapeDtypeStruct((suite.actions.size,), jnp.float32))[0]
    indices = np.array(_indices(descriptor, first.observation_O.shape[0]), np.int32)

    def described(state: _SuiteState) -> Any:
        return state.observation_O[indices] if indices.size else state.step[None].astype(jnp.float32)

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
            lambda state: jnp.float32(jnp.nan),
            compiles_drawn_resets=True,
        )
    )
