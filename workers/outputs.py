"""Outputs of evaluation episodes that are computed only if a run names them, besides those that every result has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from workers.environments import Environment


class Output(NamedTuple):
    """An output as pure functions of one episode; its value is an array whose shape and dtype stay the same."""

    begin: Callable[[Environment, Any], Any]
    """Function (environment, state of the reset) -> value before the first step."""
    after: Callable[[Environment, Any, Any, Any], Any]
    """Function (environment, state after a step, its reward, value before it) -> value after it. Steps after `done`
    never count."""


def _success(environment: Environment, state: Any, before: Any) -> Any:
    return jnp.asarray(environment.success(state, before), bool)


OUTPUTS: Mapping[str, Output] = {
    "success": Output(
        lambda environment, state: _success(environment, state, jnp.array(False)),
        lambda environment, state, reward, before: _success(environment, state, before),
    ),
    "last_reward": Output(
        lambda environment, state: jnp.float32(0.0),
        lambda environment, state, reward, before: jnp.asarray(reward, jnp.float32),
    ),
}
"""All outputs by name."""
