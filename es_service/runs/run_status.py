"""The status of a run: its newest generation, its budget, and whether it waits, is running, finished or stopped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from es_service.config.sections import BudgetConfig
from es_service.config.tasks import CALLER
from es_service.errors import ConfigError, StoreError, WayOut
from es_service.loop.budget import MOST_DURATIONS, REACHED, durations, limits_of, only_started, raised, spent
from es_service.loop.history import Row
from es_service.runs.certified import all_certifications, failed_tries, target_reached
from es_service.runs.view import Run
from es_service.store.folder import CONFIG, DATABASE, runs_inside
from es_service.store.lock import last_end, last_output, lock_holder
from es_service.store.reader import read_history, read_newest

TARGET = "target_certified"
"""Key of the budget that certified policies reach."""


@dataclass(frozen=True)
class RunStatus:
    """A run at the moment when it was read."""

    run: Run
    driver: Mapping[str, Any] | None
    """The process that is writing, as `lock_holder` returns it; None if there is none."""
    row: Row | None
    """History row of the newest generation; None before the first."""
    limits: Mapping[str, float]
    """Limits of the run's present budget by key; empty if the budget cannot be read."""
    problem: str = ""
    """Why the budget cannot be read; empty if it can."""
    certified: str = ""
    """Why the run is over by `budget.target_certified`; empty if it is not."""
    target_certified: float | None = None
    """`budget.target_certified`; None if it is not set, or if the budget cannot be read."""
    tries: tuple[float, ...] = ()
    """Mean fitness of each policy that did not reach it in new episodes, in order."""
    end: str = ""
    """How the last session ended, in words, if there is no driver; empty if it is not known."""
    output: tuple[str, ...] = ()
    """The newest lines that workers have printed, each after its worker."""
    durations: tuple[float, ...] = ()
    """`budget.durations` of the newest generations, if a limit of the time needs them."""

    @property
    def reasons(self) -> dict[str, str]:
        """Why the run is over, by key of the budget; empty if it is not."""
        reached = {TARGET: self.certified} if self.certified else {}
        return reached | (spent(self.limits, self.row, self.durations) if self.row else {})

    @property
    def only_started(self) -> bool:
        """Whether the run is over, but not finished, since starting took all of its time."""
        return self.row is not None and not self.certified and only_started(self.limits, self.row)


def population_size(constants: Mapping[str, Any]) -> str:
    """The size of a generation's populations, or of its batch of policies, in words; empty if it is not known."""
    sizes = {"search.pairs": "pairs", "search.batch": "policies"}
    return next((f"{constants[key]:,} {unit}" for key, unit in sizes.items() if key in constants), "")


def newest_runs(folder: Path) -> list[Path]:
    """The runs directly below a folder, that written last first; empty if the folder does not exist."""
    databases = {run: run / DATABASE for run in runs_inside(folder)}
    written = {run: file.stat().st_mtime for run, file in databases.items() if file.exists()}
    return sorted(written, key=lambda run: written[run], reverse=True)


def read_status(run: Run) -> RunStatus:
    """The present status of a run. Raises StoreError if the run cannot be read."""
    driver = lock_holder(run.folder)  # read before the history, so that the last row is not missed
    return status_at(run, driver, read_newest(run.folder))


def status_at(run: Run, driver: Mapping[str, Any] | None, row: Row | None) -> RunStatus:
    """The status of a run whose driver and newest history row were read before; see `RunStatus`."""
    try:
        budget = BudgetConfig.model_validate(run.present_config["budget"])
    except ConfigError as error:
        return RunStatus(run, driver, row, {}, " ".join(error.sentence.split()))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, ("budget", *first["loc"])))
        return RunStatus(run, driver, row, {}, f"{run.folder / CONFIG}: {key}: {first['msg']}")
    target, fitness = budget.target_certified, run.meta.config["task"]["fitness"]
    certified, tries = "", ()
    try:
        if target is not None:
            certified = target_reached(run.folder, target, fitness)
            tries = tuple(failed_tries(all_certifications(run.folder), target, fitness))
    except StoreError:
        pass  # damage of a certification, which `verify` names
    end, limits = "" if driver else last_end(run.folder), limits_of(budget)
    recent = recent_durations(run.folder, limits, row)
    return RunStatus(run, driver, row, limits, "", certified, target, tries, end, last_output(run.folder), recent)


def recent_durations(folder: Path, limits: Mapping[str, float], row: Row | None) -> tuple[float, ...]:
    """`budget.durations` of the newest generations of a run; none if no limit needs them, or if they cannot be read."""
    if row is None or "wall_clock_s" not in limits:
        return ()
    try:
        return durations(read_history(folder, max(0, int(row["generation"]) + 1 - MOST_DURATIONS), MOST_DURATIONS))
    except StoreError:
        return ()


def is_waiting(status: RunStatus) -> bool:
    """Whether the driver runs and waits for a first place in the cluster."""
    return status.driver is not None and status.driver["waiting_since"] is not None


def doing(status: RunStatus) -> str:
    """What the driver is doing, in words, if that takes long and no generation shows it; else empty."""
    return (status.driver["doing"] or "") if status.driver else ""


def state(status: RunStatus) -> str:
    """The state of a run in words: waiting, running, finished or stopped, with details."""
    if status.driver:
        where = f"on {status.driver['host']}, pid {status.driver['pid']}"
        if is_waiting(status):
            return f"waiting for a first place in the cluster since {status.driver['waiting_since']}; driver {where}"
        left = to_go(status)
        return "; ".join([f"running {where}", *([f"{left} left"] if left else []), *filter(None, [doing(status)])])
    if status.problem:
        return f"stopped, and its budget cannot be read: {status.problem}"
    if status.reasons:
        how = "stopped before its first generation" if status.only_started else "finished"
        return f"{how}: {next(iter(status.reasons.values()))}"
    return "stopped before its budget was spent" + (f": {status.end}" if status.end else "")


def how_to_continue(status: RunStatus) -> WayOut:
    """The way to continue a run that is not running."""
    if status.run.constants["task.environment"] == CALLER:
        return WayOut("ask_tell", "continue it", str(status.run.folder))
    return WayOut("resume", "continue it", str(status.run.folder), more(status))


def more(status: RunStatus) -> dict[str, float | None]:
    """Settings with which a finished run can continue; empty if it is not finished."""
    if status.row is None:
        return {}
    reached: dict[str, float | None] = {TARGET: None} if status.certified else {}
    if reached and not status.limits:
        reached["generations"] = 2 * max(1, status.row["generation"])  # otherwise nothing would end the run
    return {
        f"budget.{key}": value for key, value in (reached | raised(status.limits, status.row, status.durations)).items()
    }


def to_go(status: RunStatus) -> str:
    """Estimate of the remaining time at the run's average speed, such as "about 4 h"; empty if there is none."""
    row = status.row
    if row is None:
        return ""
    fractions = [
        limit / row[REACHED[key]]
        for key, limit in status.limits.items()
        if key != "target_fitness" and row[REACHED[key]] > 0
    ]
    if not fractions:
        return ""
    seconds = row["wall_clock_s"] * max(0.0, min(fractions) - 1.0)
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit}"
    return f"about {seconds:.0f} s"
