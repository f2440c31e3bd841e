"""Outputs of episodes that are computed only if a run names them, besides those that every result has.

`es_service/protocol/outputs.py` has their names. A new output touches names, this file, and the method that reads it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from es_service.protocol.outputs import AT_THE_END, OF_STEPS
from workers.environments import Environment


class Step(NamedTuple):
    """One step of an episode."""

    before: Any
    """State of the environment before the step."""
    action_A: Any
    """Action as the environment gets it, with its noise."""
    state: Any
    """State after the step."""
    reward: Any
    done: Any


class Output(NamedTuple):
    """An output as pure functions of one episode; its value is an array whose shape and dtype stay the same.

    The result of an episode has the value after its last valid step. An output of `OF_STEPS` has that after each of
    them instead.
    """

    begin: Callable[[Environment, Any, Any], Any]
    """Function (environment, state of the reset, action of zeros [A]) -> value before the first step."""
    after: Callable[[Environment, Step, Any], Any]
    """Function (environment, step, value before it) -> value after it. Steps after `done` never count."""


def named_outputs(names: Sequence[str]) -> dict[str, Output]:
    """The outputs with these names. Raises ValueError for a name that none has."""
    unknown = sorted({*names} - {*OUTPUTS})
    if unknown:
        raise ValueError(f"no output of episodes has the name {unknown[0]!r}; choose among {', '.join(OUTPUTS)}")
    return {name: OUTPUTS[name] for name in names}


def _of_state(value: Callable[[Environment, Any], Any]) -> Output:
    """An output of the state alone."""
    return Output(
        lambda environment, state, _: value(environment, state),
        lambda environment, step, _: value(environment, step.state),
    )


def _success(environment: Environment, state: Any, before: Any) -> Any:
    return jnp.asarray(environment.success(state, before), bool)


def _observation(environment: Environment, state: Any) -> Any:
    return jnp.asarray(environment.observe(state), jnp.float32)


OUTPUTS: Mapping[str, Output] = {
    "success": Output(
        lambda environment, state, _: _success(environment, state, jnp.array(False)),
        lambda environment, step, before: _success(environment, step.state, before),
    ),
    "last_reward": Output(
        lambda environment, state, _: jnp.float32(0.0),
        lambda environment, step, before: jnp.asarray(step.reward, jnp.float32),
    ),
    "first_observation": Output(
        lambda environment, state, _: _observation(environment, state), lambda environment, step, before: before
    ),
    "last_observation": _of_state(_observation),
    "observation": Output(
        lambda environment, state, _: _observation(environment, state),
        lambda environment, step, before: _observation(environment, step.before),
    ),
    "action": Output(
        lambda environment, state, zeros_A: zeros_A,
        lambda environment, step, before: jnp.asarray(step.action_A, jnp.float32),
    ),
    "reward": Output(
        lambda environment, state, _: jnp.float32(0.0),
        lambda environment, step, before: jnp.asarray(step.reward, jnp.float32),
    ),
    "done": Output(
        lambda environment, state, _: jnp.array(False),
        lambda environment, step, before: jnp.asarray(step.done, bool),
    ),
    "step_descriptor": _of_state(lambda environment, state: jnp.asarray(environment.descriptor(state), jnp.float32)),
}
"""All outputs by name."""
assert {*OUTPUTS} == {*AT_THE_END, *OF_STEPS}
