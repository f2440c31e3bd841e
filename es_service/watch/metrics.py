"""The newest numbers of all runs as text for Prometheus."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from es_service.errors import ServiceError
from es_service.runs.recent import FAULTS_OF, read_recent
from es_service.watch.runs import Summary

GAUGES = {
    "generation": ("generation", "Newest committed generation."),
    "env_steps": ("env_steps", "Environment steps until then."),
    "steps_per_second": ("steps_per_second", "Environment steps a second of the newest generation."),
    "best_fitness": ("best_fitness", "Highest mean fitness of an evaluated centre or policy: selected, not certified."),
    "coverage": ("coverage", "Filled cells as a share of all cells."),
    "workers": ("workers", "Workers of the newest generation."),
}
"""Metric -> history column, meaning."""
OTHERS = {
    "running": "Whether a driver is writing.",
    "readable": "Whether the run can be read.",
    "certified_fitness": "Mean fitness, in certified episodes, of the policy that the newest certification put first.",
    "certified_elsewhere_fitness": "The same in the other task that the label elsewhere names.",
    "certified_gap": "Mean fitness there minus that of the same policy in the task of the run.",
    "lost_workers": f"Workers lost in the newest {FAULTS_OF} generations.",
    "retries": f"Chunks sent again in the newest {FAULTS_OF} generations.",
}
PREFIX = "es_service_"


def metrics(summaries: Iterable[Summary]) -> str:
    """A gauge for each number of each run, labelled with the run, its task and its search."""
    values: dict[str, list[str]] = {name: [] for name in (*GAUGES, *OTHERS)}
    for summary in summaries:
        labels = {"run": summary.found.name}
        numbers = _values(summary)
        if summary.status is not None:
            constants = summary.status.run.constants
            labels |= {"task": constants["task.environment"], "search": constants["search.algorithm"]}
        lines = [(labels, numbers)]
        lines += [
            (labels | {"elsewhere": task}, _elsewhere(one.row(), summary)) for task, one in summary.elsewhere.items()
        ]
        for labelled, of in lines:
            shown = ",".join(f'{name}="{_escaped(str(text))}"' for name, text in labelled.items())
            for name, value in of.items():
                if math.isfinite(value):
                    values[name].append(f"{PREFIX}{name}{{{shown}}} {value!r}\n")
    about = {name: text for name, (_, text) in GAUGES.items()} | OTHERS
    return "".join(
        f"# HELP {PREFIX}{name} {about[name]}\n# TYPE {PREFIX}{name} gauge\n{''.join(lines)}"
        for name, lines in values.items()
        if lines
    )


def _values(summary: Summary) -> Mapping[str, float]:
    numbers: dict[str, float] = {"readable": float(summary.status is not None)}
    if summary.status is None:
        return numbers
    row = summary.status.row
    numbers["running"] = float(summary.status.driver is not None)
    if summary.certified_fitness is not None:
        numbers["certified_fitness"] = summary.certified_fitness
    if row is not None:
        numbers |= {name: float(row[column]) for name, (column, _) in GAUGES.items() if column in row}
        try:
            recent = read_recent(summary.status.run, int(row["generation"]))
        except ServiceError:  # it was deleted meanwhile
            return numbers
        if recent.problem is None:
            numbers |= {"lost_workers": float(recent.lost_workers), "retries": float(recent.retries)}
    return numbers


def _elsewhere(row: Mapping[str, Any], summary: Summary) -> Mapping[str, float]:
    """The numbers of a policy that was certified in another task."""
    columns = {"certified_elsewhere_fitness": "elsewhere", "certified_gap": "gap"}
    return {name: row[f"{prefix}_{summary.measure}_mean"] for name, prefix in columns.items()}


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
