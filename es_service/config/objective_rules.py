"""Rules of objectives that depend on the task: the dimensions of a target set, and whether there is a goal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from es_service.config.problems import problem_of
from es_service.config.yaml_text import show
from es_service.errors import Problem
from es_service.protocol.messages import TaskSpec

OBJECTIVE, OBJECTIVES = "search.objective", "search.objectives"
PLACES = ("target", "nearness")
"""Kinds with a place among the descriptors."""


def objective_problems(values: Mapping[str, Any], task: TaskSpec) -> list[Problem]:
    """Problems of `search.objective` and of the entries of `search.objectives` with this task.

    Args:
        values: valid values of the config by dotted key.
        task: the task with the chosen descriptor.
    """
    problems = []
    for key, objective in _objectives(values):
        names, kind = task.descriptor_names, objective.get("kind")
        middle = list(objective.get("descriptor") or ())
        if kind in PLACES and len(middle) != len(names):
            what = (
                f"{show(middle)} has {len(middle)} numbers, but the descriptor of {task.name} has {len(names)}, "
                f"{', '.join(names)}; give descriptor one number for each"
            )
            problems.append(problem_of(key, middle, what))
        if kind == "final" and not task.final_fitness:
            what = f"final says little about an episode of {task.name}; choose return or another objective"
            problems.append(problem_of(key, kind, what, suggestion="return"))
        if kind == "goal_distance" and not task.has_goal:
            what = f"goal_distance is not known in {task.name}, which has no goal; choose another objective"
            problems.append(problem_of(key, kind, what))
    chosen = values.get("search.candidate_choice")
    if chosen == "place" and values.get(f"{OBJECTIVE}.kind") != "target":
        what = f"place needs {OBJECTIVE}.kind = target, whose middle is the place; choose fitness or novelty"
        problems.append(problem_of("search.candidate_choice", chosen, what, suggestion="fitness"))
    return problems


def _objectives(values: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Key and content of each objective of a config."""
    if f"{OBJECTIVE}.kind" in values:
        prefix = f"{OBJECTIVE}."
        content = {key.removeprefix(prefix): value for key, value in values.items() if key.startswith(prefix)}
        yield f"{prefix}descriptor" if content["kind"] in PLACES else f"{prefix}kind", content
    for objective in values.get(OBJECTIVES) or ():
        yield OBJECTIVES, objective
