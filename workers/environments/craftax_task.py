"""Environments of Craftax 1.6 as tasks, such as `craftax:Craftax-Classic-Symbolic-v1`.

They are Craftax's own, in its variants that do not reset by themselves. The length of an episode is `max_timesteps` of
the default parameters; the other parameters that are single numbers are options. Measures are the achievements, each
by its name, and their number, which is the descriptor. Those that observe pixels process Craftax's textures for a
minute and keep them in the package's folder, if it can be written.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import jax.numpy as jnp

from es_service.protocol.options import OptionValue
from workers.environments.suite_task import Choices, Package, Suite, parameters_with, suite_module

PACKAGE = Package("craftax", "es-service with its extra, 90 MB,")
LENGTH = "max_timesteps"
ENVIRONMENTS = {
    f"Craftax-{variant}{kind}-v1": bool(variant) for variant in ("", "Classic-") for kind in ("Symbolic", "Pixels")
}
"""Name of an environment -> whether it is Craftax-Classic."""


def names() -> tuple[str, ...]:
    """Names of the environments."""
    suite_module("craftax", PACKAGE)
    return tuple(ENVIRONMENTS)


def suite(name: str, given: Mapping[str, OptionValue]) -> Suite:
    """Craftax's environment `name`, with values of its parameters that are not the defaults."""
    constants = _constants("craftax.craftax_classic" if ENVIRONMENTS[name] else "craftax.craftax")
    module = suite_module("craftax", PACKAGE, "craftax.craftax_env")
    environment = module.make_craftax_env_from_name(name, auto_reset=False)
    options, parameters = parameters_with(environment.default_params, LENGTH, given)
    achievements = {one.name.lower(): one.value for one in constants.Achievement}

    def reset(key: Any) -> tuple[Any, Any]:
        observation, state = environment.reset_env(key, parameters)
        return state, observation

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        observation, state, reward, done, _ = environment.step_env(key, state, action, parameters)
        return state, observation, reward, done

    def measures(state: Any) -> dict[str, Any]:
        count = jnp.sum(state.achievements).astype(jnp.float32)
        return {"achievements": count, **{key: state.achievements[place] for key, place in achievements.items()}}

    most = {"achievements": len(achievements)} | dict.fromkeys(achievements, 1)
    return Suite(
        f"craftax:{name}",
        reset,
        step,
        Choices((int(environment.action_space(parameters).n),)),
        int(getattr(parameters, LENGTH)),
        options,
        measures=measures,
        described={key: ((key,), ((0.0, float(high)),)) for key, high in most.items()},
    )


def _constants(package: str) -> Any:
    """Craftax's constants, which then keep textures only where they can."""
    constants = suite_module("craftax", PACKAGE, f"{package}.constants")
    save = suite_module("craftax", PACKAGE, "craftax.environment_base.util").save_compressed_pickle

    def save_if_allowed(*arguments: Any) -> None:
        with suppress(OSError):
            save(*arguments)

    constants.save_compressed_pickle = save_if_allowed
    return constants
