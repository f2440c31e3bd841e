"""A policy for each goal of a task, out of the map of one run: for each goal, a run polishes the policies near it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from es_service.config.given import Overrides
from es_service.config.tasks import task_of
from es_service.config.text import unknown_name
from es_service.errors import ConfigError
from es_service.runs.certified import newest_certified
from es_service.runs.checked_config import changed_config
from es_service.runs.lineage import polish_source
from es_service.runs.sweep_plan import Labelled
from es_service.runs.view import open_run
from es_service.store.reader import read_newest

ALL = "all"
"""What stands for all goals of a task."""


def goal_configs(
    parent: str | os.PathLike[str], goals: Sequence[str] = (ALL,), overrides: Overrides = ()
) -> list[Labelled]:
    """For each goal the config of a run that polishes policies of another run for this goal, for `sweep`.

    Each begins with the policies that ended nearest to the goal, and ranks by it: those that end within the goal's
    radius by their fitness, the others by their distance. Unless `overrides` set a limit, all of them together have the
    number of environment steps of the other run as their budget.

    Args:
        parent: folder of the other run.
        goals: values of the option `goal` of its task; `all`: all of them.
        overrides: what the configs will be changed by; only a limit of the budget counts.

    Raises:
        ConfigError: the task declares no goals, or not these. NotInRunError: the run has no finished generation.
    """
    run = open_run(parent)
    task = task_of(changed_config(run.present_config, name=str(run.config_file)))
    if not task.goals:
        raise ConfigError(
            f"{task.name} declares no goals; to polish for one place, set search.objective.kind = target and "
            "search.objective.descriptor",
            field="goals",
            value=list(goals),
            run=run.folder,
        )
    names = list(dict.fromkeys(name for given in goals for name in (task.goals if given == ALL else [given])))
    for name in names:
        if name not in task.goals:
            raise unknown_name("goal", name, list(task.goals), "goals")
    source = polish_source(run, overrides, len(names))
    return [Labelled(name, _for_goal(source, name, task.goals[name], task.goal_radius)) for name in names]


def _for_goal(source: Mapping[str, Any], name: str, place: Sequence[float], radius: float) -> dict[str, Any]:
    objective = {"kind": "target", "descriptor": list(place), "radius": radius}
    task, search = source["task"], source["search"]
    return {
        **source,
        "task": {**task, "options": {**task["options"], "goal": name}},
        "search": {**search, "candidate_choice": "place", "objective": objective},
    }


def goals_reached(folders: Iterable[str | os.PathLike[str]]) -> pd.DataFrame:
    """What the certified policy of each run of `goal_configs` does, a row each.

    The columns are goal, seed, success (the share of the episodes that succeed) with success_low and success_high (its
    interval of 95 %, Wilson's), return_mean, episodes, env_steps of the run, and run, its folder. A run without a
    certified policy has no values of episodes.
    """
    rows = []
    for folder in map(Path, folders):
        run, certified = open_run(folder), newest_certified(folder)
        values = {} if certified is None else certified.row()
        has_success = values.get("successes") is not None
        rows.append(
            {
                "goal": run.constants["task.options.goal"],
                "seed": run.constants["seed"],
                "success": values["successes"] / values["episodes"] if has_success else None,
                **{name: values.get(name) for name in ("success_low", "success_high", "return_mean", "episodes")},
                "env_steps": (read_newest(folder) or {}).get("env_steps"),
                "run": str(folder),
            }
        )
    return pd.DataFrame(rows).astype({"success": "Float64", "episodes": "Int64"} if rows else {})
