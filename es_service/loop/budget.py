"""Compares the budget of a run with its progress, to decide whether the run is over."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from es_service.config.model import BudgetConfig

REACHED = {
    "generations": "generation",
    "env_steps": "env_steps",
    "wall_clock_s": "wall_clock_s",
    "target_fitness": "best_fitness",
}
"""The column of the history that each key of the budget limits."""
_REASONS = {
    "generations": "the budget of {:,} generations is spent",
    "env_steps": "the budget of {:,} environment steps is spent",
    "wall_clock_s": "the budget of {:g} s is spent",
    "target_fitness": "the target fitness {:g} is reached",
}


def limits_of(budget: BudgetConfig) -> dict[str, float]:
    """The limits that are set, by key of the budget."""
    return {key: limit for key in REACHED if (limit := getattr(budget, key)) is not None}


def spent(limits: Mapping[str, float], row: Mapping[str, float]) -> dict[str, str]:
    """Why a run is over, in words, by key of the budget; empty if it is not over.

    Budgets are checked between generations, so a run may take more steps than its limit.

    Args:
        row: the newest generation's row of the history; only the columns in REACHED are used.
    """
    return {key: _REASONS[key].format(limit) for key, limit in limits.items() if row[REACHED[key]] >= limit}


def raised(limits: Mapping[str, float], row: Mapping[str, Any]) -> dict[str, float | None]:
    """Limits to set, by key, so that a run that is over can continue; empty if it is not over.

    A limit that is spent is doubled, and a target fitness that is reached becomes None.
    """
    wanted: dict[str, float | None] = {}
    for key in spent(limits, row):
        limit, reached = limits[key], row[REACHED[key]]  # steps may exceed twice their limit
        wanted[key] = None if key == "target_fitness" else math.ceil(2 * (limit if 2 * limit > reached else reached))
    if "target_fitness" in wanted and limits.keys() == {"target_fitness"}:
        wanted["generations"] = 2 * max(1, row["generation"])  # otherwise nothing would end the run
    return wanted
