"""The commands of a run of a sweep, one after another: run it, certify it at some points of cost, and at its end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from es_service.config.model import RunConfig
from es_service.errors import StoreError
from es_service.loop.budget import limits_of, only_started, spent
from es_service.loop.history import Row
from es_service.runs.certified import certified_over_time, target_reached
from es_service.runs.run_status import recent_durations
from es_service.runs.sweep_plan import PlannedRun
from es_service.store.folder import explained, holds_run
from es_service.store.reader import read_newest


@dataclass(frozen=True)
class Certifying:
    """When the runs of a sweep are certified: at their ends, and at some points of cost."""

    at: Sequence[float] = ()
    """Environment steps of these points."""

    def next_point(self, planned: PlannedRun, row: Row | None, *, ended: bool) -> float | None:
        """Environment steps until which a run goes on before it is certified; infinite for its end. None: all of its
        certifications are there.

        Args:
            ended: whether its budget is spent.
        """
        done = _certified_steps(planned.folder)
        limit, steps = planned.config.budget.env_steps or math.inf, -1 if row is None else row["env_steps"]
        points = [] if ended else [at for at in sorted(self.at) if at < limit and not any(was >= at for was in done)]
        return points[0] if points else None if ended and steps in done else math.inf


@dataclass
class Command:
    """What a run of a sweep consists of, one command after another."""

    planned: PlannedRun
    run: list[str]
    """Words of `es-service` that start it, or continue it."""
    certify: list[str]
    """Words that certify it."""
    certifying: Certifying | None
    before: list[str] = field(default_factory=list)
    """Words of the process before, so that none is repeated that has changed nothing."""

    def next_words(self) -> list[str]:
        """Words of the next process; none if the run is over and certified."""
        row = newest(self.planned.folder)
        state, _ = end(self.planned.folder, self.planned.config, row)
        if self.certifying is None or state == "stopped":
            return self.run if state == "waiting" else []
        point = self.certifying.next_point(self.planned, row, ended=state == "finished")
        if point is None:
            return []
        if state == "finished" or (row is not None and row["env_steps"] >= point):
            return self.certify
        return self.run if point == math.inf else [*self.run, "--set", f"budget.env_steps={math.ceil(point)}"]


def command_of(
    run: PlannedRun,
    workers: int | Literal["auto"],
    inside: Path,
    options: Sequence[str],
    certifying: Certifying | None,
) -> Command:
    """The commands of a run. Its config is written now, so that an edited file does not reach runs that start later."""
    file = inside / f"{run.name}.yaml"
    try:
        file.write_text(run.config.given_yaml({"compute.workers": workers}))
    except OSError as error:
        raise explained(error, inside, f"writing {file.name}", "start the sweep again") from error
    share = [] if workers == "auto" else ["--workers", str(workers)]
    return Command(
        run,
        ["run", str(file), "--or-resume", "--out", str(run.folder), *options],
        ["evaluate", str(run.folder), "--certify", *share],
        certifying,
    )


def _certified_steps(folder: Path) -> list[int]:
    """Environment steps at which a run has been certified; none if this cannot be read, which its own process tells."""
    with suppress(StoreError):
        if holds_run(folder):
            return [row["env_steps"] for row in certified_over_time(folder) if row["env_steps"] is not None]
    return []


def end(folder: Path, config: RunConfig, row: Row | None) -> tuple[Literal["waiting", "finished", "stopped"], str]:
    """Whether a run that no process computes is over, and why; it is "waiting" if it is not, or if it cannot be read,
    which its own process tells, and "stopped" if starting took all of its time."""
    if row is None:
        return "waiting", ""
    with suppress(StoreError):
        if reached := target_reached(folder, config.budget.target_certified, config.task.fitness):
            return "finished", reached
    limits = limits_of(config.budget)
    reason = next(iter(spent(limits, row, recent_durations(folder, limits, row)).values()), "")
    return ("stopped" if only_started(limits, row) else "finished" if reason else "waiting"), reason


def newest(folder: Path) -> Row | None:
    """Newest history row of a run; None if there is none, or if the run cannot be read, which its own process tells."""
    try:
        return read_newest(folder) if holds_run(folder) else None
    except StoreError:
        return None
