"""A run that polishes policies of another one: its config, and certified values before and after it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping

from es_service.config.given import Overrides, parse_overrides
from es_service.config.model import RunConfig
from es_service.config.parts import TargetObjective
from es_service.config.search import CandidatesConfig
from es_service.config.tasks import task_of
from es_service.errors import NotInRunError
from es_service.runs.certification import certify_run
from es_service.runs.certified import EPISODES, Certified, certified_policies, measure_of
from es_service.runs.checked_config import load_config
from es_service.runs.view import Run, open_run
from es_service.search.algorithms import ALGORITHMS

LIMITS = ("generations", "env_steps", "wall_clock_s", "rollout_s", "cpu_s")
"""Limits of a budget that are reached in any case."""
METHOD = next(name for name, method in ALGORITHMS.items() if issubclass(method.settings, CandidatesConfig))
"""The method that starts from several policies of another run."""


def polish_config(parent: str | os.PathLike[str], overrides: Overrides = ()) -> RunConfig:
    """The config of a run that polishes policies of another one.

    It has the task, the policy and the map of that run, defaults for everything else, and unless `overrides` set a
    limit, the number of environment steps of that run as its budget.

    Args:
        parent: folder of the other run.
        overrides: changes, as for `load_config`.

    Raises:
        ConfigError: lists every problem found. NotInRunError: the run has no finished generation.
    """
    run = open_run(parent)
    if run.generation is None:
        raise NotInRunError(f"{run.folder} has no finished generation yet, and so no policies", run=run.folder)
    present = run.present_config
    sections = {name: present[name] for name in ("task", "policy", "map", "seed")}
    steps = int(run.history_rows(run.generation)[-1]["env_steps"])
    search = {"algorithm": METHOD, "init_from": str(run.folder)}
    overrides = overrides if isinstance(overrides, str | Mapping) else tuple(overrides)
    is_limited = any(parse_overrides(overrides)[0].get(f"budget.{name}") is not None for name in LIMITS)
    budget = {} if is_limited else {"env_steps": steps}
    return load_config({**sections, "search": search, "budget": budget}, overrides, name=str(run.config_file))


def certified_for(
    run: Run,
    config: RunConfig,
    on_notice: Callable[[str], None],
    on_output: Callable[[str], None] = lambda line: None,
    *,
    workers: int | None,
    centre: bool = False,
) -> list[Certified]:
    """Newest certified policies of a run as polishing compares them: with as many episodes as `certify_run` takes, of
    which none has decided that the run is over, and selected by the same measure before and after. What is not
    certified so is certified now.

    With a target set in a task that declares success, policies are selected by success.

    Args:
        config: that of the run that polishes.
        centre: whether the newest centre is a candidate, too.

    Raises:
        RunLockedError: a driver writes to the run. Otherwise as `certify_run`.
    """
    search, by = config.search, measure_of(config.task.fitness)
    has_target = isinstance(search, CandidatesConfig) and isinstance(search.objective, TargetObjective)
    if has_target and task_of(config).success:
        by = "success"
    certified = [
        policy
        for policy in certified_policies(run.folder)
        if policy.selected_by == by and policy.episodes.count >= EPISODES
    ]
    if certified:
        newest = max(policy.number for policy in certified)
        return [policy for policy in certified if policy.number == newest]
    return certify_run(run.folder, centre=centre, by=by, workers=workers, on_notice=on_notice, on_output=on_output)
