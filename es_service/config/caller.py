"""The task `caller`, whose episodes are computed by the program that asks a search (`es_service.ask_tell`)."""

from __future__ import annotations

from collections.abc import Mapping

from es_service.protocol.messages import UNBOUNDED, TaskSpec
from es_service.protocol.options import Option, OptionValue, option_values
from es_service.protocol.parameters import FREE, ParameterSpec

CALLER = "caller"
"""Name of the task, and its kind."""
OPTIONS = {
    "observation_size": Option(0, low=0, high=1_000_000),
    "action_size": Option(0, low=0, high=1_000_000),
    "parameters": Option(0, low=0, high=10_000_000),
    "descriptor_size": Option(2, low=1, high=1000),
    "episode_steps": Option(1, low=1),
}
"""Either the sizes of a policy, or the number of parameters of something else; and the dimensions of the descriptor."""


def caller_task(options: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of the task with these options; those that are left out or not allowed have their defaults."""
    values = option_values(OPTIONS, options)
    observations, actions, parameters, dimensions, steps = (int(str(value)) for value in values.values())
    names = tuple(f"p{index}" for index in range(parameters))
    return TaskSpec(
        name=CALLER,
        observation_size=1 if parameters else max(1, observations),
        action_size=parameters or max(1, actions),
        episode_steps=max(1, steps),
        descriptor_names=tuple(f"d{index}" for index in range(max(1, dimensions))),
        descriptor_bounds=(UNBOUNDED,) * max(1, dimensions),
        final_fitness=False,
        has_goal=False,
        options=dict(OPTIONS),
        summary="episodes that the program computes which asks the search",
        kind=CALLER,
        parameters=ParameterSpec(names, (FREE,) * parameters, (0.0,) * parameters) if parameters else None,
    )
