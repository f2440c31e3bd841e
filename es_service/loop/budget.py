"""The budget of a run and how its time is spent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from es_service.config.sections import BudgetConfig
from es_service.errors import counted

REACHED = {
    "generations": "generation",
    "env_steps": "env_steps",
    "wall_clock_s": "wall_clock_s",
    "rollout_s": "rollout_s",
    "cpu_s": "cpu_s",
    "target_fitness": "best_fitness",
}
"""The column of the history that each key of the budget limits."""
MOST_DURATIONS = 5
"""Newest generations by whose durations a run judges whether another one can end within `wall_clock_s`."""
STARTING = {"wall_clock_s": "s", "cpu_s": "seconds of processors"}
"""Keys of budgets of time for which starting counts, too, and the words for their unit."""
SECONDS = ("rollout_s", "cpu_s")
"""Keys of budgets of time that end a run after the generation that reaches them."""
PHASES = ("seconds_rollout", "seconds_gradient", "seconds_evaluation", "seconds_driver", "seconds_store")
"""Columns of the history whose sum is the duration of a generation."""
_REASONS: Mapping[str, Callable[[float], str]] = {
    "generations": lambda limit: f"the budget of {counted(int(limit), 'generation')} is spent",
    "env_steps": lambda limit: f"the budget of {counted(int(limit), 'environment step')} is spent",
    "rollout_s": lambda limit: f"the budget of {limit:g} seconds of rollouts is spent",
    "cpu_s": lambda limit: f"the budget of {limit:g} seconds of processors is spent",
    "target_fitness": lambda limit: f"the target fitness {limit:g} is reached",
}


def limits_of(budget: BudgetConfig) -> dict[str, float]:
    return {key: limit for key in REACHED if (limit := getattr(budget, key)) is not None}


def durations(rows: Iterable[Mapping[str, float]]) -> tuple[float, ...]:
    """Seconds of generations, by their rows of the history; without generation 0, which only evaluates, and generations
    of which they are not known."""
    seconds = (sum(row[phase] for phase in PHASES) for row in rows if row["generation"] > 0)
    return tuple(duration for duration in seconds if math.isfinite(duration))


def spent(limits: Mapping[str, float], row: Mapping[str, float], recent: Sequence[float] = ()) -> dict[str, str]:
    """Why a run is over, in words, by key of the budget; empty if it is not over.

    Budgets are checked between generations, so a run may take more steps and more time than its limit. It is over by
    `wall_clock_s` also if the shortest of the recent generations would end after the limit: one alone says nothing,
    since workers may have compiled in it.

    Args:
        row: the newest generation's row of the history; only the columns in REACHED are used.
        recent: `durations` of the newest generations, at most MOST_DURATIONS.
    """
    reached = _reached(limits, row)
    if only_started(limits, row):
        return {
            key: f"only starting took place: the budget of {limits[key]:g} {STARTING[key]} was spent before the first "
            f"generation, exceeded by {row[REACHED[key]] - limits[key]:.1f} s, by starting workers, compiling and "
            "evaluating the initial centres"
            for key in reached
        }
    reasons = {key: _REASONS[key](limits[key]) for key in reached if key in _REASONS}
    for key in reasons.keys() & {"env_steps", *SECONDS}:
        if over := row[REACHED[key]] - limits[key]:
            reasons[key] += f", exceeded by {over:,.1f} s" if key in SECONDS else f", exceeded by {over:,.0f}"
    if (limit := limits.get("wall_clock_s")) is not None:
        seconds, least = row["wall_clock_s"], min(recent) if len(recent) > 1 else 0.0
        budget = f"the budget of {limit:g} s"
        if seconds >= limit:
            reasons["wall_clock_s"] = f"{budget} is spent, exceeded by {seconds - limit:.1f} s"
        elif seconds + least > limit:
            reasons["wall_clock_s"] = (
                f"{budget} has no time for another generation: {seconds:.1f} s are spent, and each of the last "
                f"{len(recent)} generations took at least {least:.3g} s"
            )
    return reasons


def only_started(limits: Mapping[str, float], row: Mapping[str, float]) -> bool:
    """Whether a run is over before its first generation by limits that starting counts for alone, and so is not
    finished."""
    reached = _reached(limits, row)
    return row["generation"] < 1 and bool(reached) and STARTING.keys() >= {*reached}


def _reached(limits: Mapping[str, float], row: Mapping[str, float]) -> list[str]:
    return [key for key, limit in limits.items() if row.get(REACHED[key], -math.inf) >= limit]


def raised(
    limits: Mapping[str, float], row: Mapping[str, Any], recent: Sequence[float] = ()
) -> dict[str, float | None]:
    """Limits to set, by key, so that a run that is over can continue; empty if it is not over.

    A limit that is spent is doubled, and a target fitness that is reached becomes None.
    """
    wanted: dict[str, float | None] = {}
    for key in spent(limits, row, recent):
        limit, reached = limits[key], row[REACHED[key]]  # steps may exceed twice their limit
        wanted[key] = None if key == "target_fitness" else math.ceil(2 * (limit if 2 * limit > reached else reached))
    if "target_fitness" in wanted and limits.keys() == {"target_fitness"}:
        wanted["generations"] = 2 * max(1, row["generation"])  # otherwise nothing would end the run
    return wanted


# Measurement of how the time of a run is spent.


class Clock:
    """Measures how the time of each generation is spent. The time in which a generation is stored counts for the
    following one, whose episodes are computed meanwhile.

    Args:
        before_s: seconds spent in earlier sessions of the run.
    """

    def __init__(self, before_s: float) -> None:
        self._origin = time.perf_counter() - before_s
        self._last = self._generation_start = time.perf_counter()
        self._laps: dict[str, float] = {}

    def total(self) -> float:
        """Seconds spent in this run, earlier sessions included."""
        return time.perf_counter() - self._origin

    def lap(self, name: str) -> None:
        """Add the time since the last lap to the total of `name`."""
        now = time.perf_counter()
        self._laps[name] = self._laps.get(name, 0.0) + now - self._last
        self._last = now

    @staticmethod
    def now() -> float:
        """Seconds, for `meanwhile`."""
        return time.perf_counter()

    def meanwhile(self, name: str, since: float) -> float:
        """Add the seconds since then to the total of `name`, instead of to the lap in which they passed; now."""
        now = self.now()
        self._laps[name] = self._laps.get(name, 0.0) + now - since
        self._last += now - since
        return now

    def finish_generation(self) -> tuple[float, dict[str, float]]:
        """End a generation: (seconds since the end of the last one, seconds of its laps by history column)."""
        now = time.perf_counter()
        seconds, laps = now - self._generation_start, self._laps
        self._generation_start, self._laps = now, {}
        return seconds, {name: laps.get(name, 0.0) for name in PHASES}
