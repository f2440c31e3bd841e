"""The status of a run, which runs a folder stands for, and what happened in the recent generations of a run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from es_service.config.sections import BudgetConfig
from es_service.config.tasks import CALLER
from es_service.errors import ConfigError, StoreError, WayOut
from es_service.loop.budget import MOST_DURATIONS, REACHED, durations, limits_of, only_started, raised, spent
from es_service.loop.history import Row
from es_service.runs.certified import all_certifications, failed_tries, target_reached
from es_service.runs.view import Run
from es_service.store.folder import CONFIG, DATABASE, holds_run, runs_inside
from es_service.store.lock import last_end, last_output, lock_holder
from es_service.store.reader import read_evaluations, read_history, read_newest

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
    sizes = {"search.pairs": "pairs", "search.batch": "policies", "search.population_size": "members"}
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


# Which runs a folder stands for: itself, or the runs of a sweep, or those of any folder that contains runs.

INSIDE = ".sweep"
"""Folder beside the runs of a sweep, with the config that each is given, what it prints, and its group."""
GROUPS = "groups.json"
"""File there: name of a run -> name of its group."""
_MOST_CHARACTERS = 200


def group_of(run: Path) -> str:
    """Name of the group to which its sweep counts a run; empty if there is none."""
    return _groups(run.parent / INSIDE).get(run.name, "")


def write_groups(inside: Path, groups: Mapping[str, str]) -> None:
    """Add the groups of runs to those that a sweep has written before. Raises OSError."""
    if known := {**_groups(inside), **{name: group for name, group in groups.items() if group}}:
        (inside / GROUPS).write_text(json.dumps(known, indent=1))


def _groups(inside: Path) -> dict[str, str]:
    try:
        found = json.loads((inside / GROUPS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    pairs = found.items() if isinstance(found, dict) else ()
    return {name: group[:_MOST_CHARACTERS] for name, group in pairs if isinstance(group, str)}


def runs_of(folder: Path) -> list[Path]:
    """The folder itself, or the folders of the runs that it holds, also of those that a sweep has not started yet.

    They are in the order of their names, with numbers in the order of their values. Raises StoreError as `holds_run`.
    """
    if holds_run(folder):
        return [folder]
    found = runs_inside(folder) | {folder / file.stem for file in (folder / INSIDE).glob("*.yaml")}
    return sorted(found, key=lambda run: _in_order(run.name)) or [folder]


def output_of(run: Path) -> Path | None:
    """The file with what the process of a sweep's run has printed; None if there is none."""
    log = run.parent / INSIDE / f"{run.name}.log"
    return log if log.is_file() else None


def _in_order(name: str) -> list[str | float]:
    """Key by which seed=2 comes before seed=10, and sigma=0.05 before sigma=0.1: texts and numbers by turns."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", name)
    return [float(part) if number % 2 else part for number, part in enumerate(parts)]


# What happened in the recent generations of a run: what their centres climb, and the faults that were handled.
#
# This is read from many rows of the history. So that a damaged one hides nothing else of a run, the problem is
# returned.
#
# Centres climb fitness, novelty or both, by the weight of fitness of every evaluated centre. A row of the history has
# the weight of one centre only, the fittest of its generation. The centres of some methods differ, in a generation or
# from block to block: each either explores, that is, climbs novelty alone (weight 0), or exploits, that is, climbs
# fitness alone (weight 1). So the table of evaluated centres is read, and no method needs to be known. Only centres
# that a population has moved count: no population has used the weight of initial centres or policies.

CENTRES = 1000
"""About so many centres, of whole generations, are recent."""
FAULTS_OF = 1000
"""Newest generations whose faults are counted; a report shows those of all."""


@dataclass(frozen=True)
class Recent:
    """What happened in the recent generations of a run; None stands for what is not known."""

    newest: Climbed | None = None
    """What the centres of the newest generation climb."""
    objectives: Climbed | None = None
    """What the centres of recent generations climb, the newest included."""
    lost_workers: int = 0
    retries: int = 0
    invalid_members: str = ""
    """What `invalid_members` returns for these generations."""
    problem: str | None = None
    """Why nothing is known, such as a damaged row."""


def read_recent(run: Run, generation: int) -> Recent:
    """What happened in a run up to a generation, its newest."""
    try:
        newest, recent, evaluated = _objectives(run, generation)
        rows = run.history_rows(generation - FAULTS_OF + 1)
    except StoreError as error:
        return Recent(problem=error.sentence)
    # A fork may have no numbers (NaN) for the generations of its parent.
    lost, retries = (sum(row[name] for row in rows if row[name] > 0) for name in ("lost_workers", "retries"))
    invalid = invalid_members(run.constants, [row["invalid_members"] for row in rows], newest.centres, evaluated)
    return Recent(newest, recent, lost, retries, invalid)


def invalid_members(constants: Mapping[str, Any], invalid_G: Sequence[float], moved: int, evaluated: int) -> str:
    """How many members of the newest generations were invalid, in words such as "26 % of the last generation"; empty if
    there was none.

    Args:
        constants: those of the run.
        invalid_G: invalid members of the generations, the newest last; NaN where it is not known.
        moved: centres of the newest generation that a population has moved.
        evaluated: centres and policies of the newest generation.
    """
    recent = [int(invalid) for invalid in invalid_G[-FAULTS_OF:] if invalid > 0]
    if not recent:
        return ""
    last, members = invalid_G[-1], 2 * constants.get("search.pairs", 0) * moved
    if not last > 0:
        return f"none in the last generation, {sum(recent):,} in the last {min(len(invalid_G), FAULTS_OF):,}"
    if moved != evaluated or members < last:  # the number of members is not stored
        return f"{int(last):,} in the last generation"
    return f"{100 * last / members:.3g} % of the last generation"


def _objectives(run: Run, generation: int) -> tuple[Climbed, Climbed, int]:
    """What the centres of a generation climb, those of recent generations, this one included, and how many centres and
    policies the generation evaluated."""
    [newest] = read_evaluations(run.folder, generation, 1) or [[]]  # a driver that falls back may have deleted it
    count = min(generation + 1, max(1, CENTRES // max(1, len(newest))))
    recent = read_evaluations(run.folder, generation + 1 - count, count)
    of_generation, of_all = (
        np.array([centre["fitness_weight"] for centre in centres if np.isfinite(centre["update_norm"])])
        for centres in (newest, [centre for each in recent for centre in each])
    )
    return objectives(of_generation), objectives(of_all), len(newest)


class Climbed(NamedTuple):
    """What some centres climb."""

    centres: int
    exploring: int
    """Centres that climb novelty alone."""
    exploiting: int
    """Centres that climb fitness alone."""
    fitness_weight: float
    """Mean weight of fitness; NaN for no centre."""

    @property
    def are_separate(self) -> bool:
        """Whether each centre climbs one of the two alone, and both occur."""
        return min(self.exploring, self.exploiting) > 0 and self.exploring + self.exploiting == self.centres


def objectives(weight_N: NDArray[np.float64]) -> Climbed:
    """What centres with these weights of fitness climb."""
    exploring, exploiting = (int((weight_N == alone).sum()) for alone in (0.0, 1.0))
    return Climbed(weight_N.size, exploring, exploiting, float(weight_N.mean()) if weight_N.size else float("nan"))


def weights(centres: Mapping[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Generation and weight of fitness of each centre that a population has moved, [N], in order.

    Args:
        centres: columns of the evaluated centres, in which NaN stands for no value.
    """
    moved_N = np.isfinite(centres["update_norm"])
    return centres["generation"][moved_N], centres["fitness_weight"][moved_N]
