"""What happened in the recent generations of a run: what their centres climb, and the faults that were handled.

This is read from many rows of the history. So that a damaged one hides nothing else of a run, the problem is returned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from es_service.errors import StoreError
from es_service.runs.objectives import Objectives, objectives
from es_service.runs.view import Run
from es_service.store.reader import read_evaluations

CENTRES = 1000
"""About so many centres, of whole generations, are recent."""
FAULTS_OF = 1000
"""Newest generations whose faults are counted; a report shows those of all."""


@dataclass(frozen=True)
class Recent:
    """What happened in the recent generations of a run; None stands for what is not known."""

    newest: Objectives | None = None
    """What the centres of the newest generation climb."""
    objectives: Objectives | None = None
    """What the centres of recent generations climb, the newest included."""
    lost_workers: int = 0
    retries: int = 0
    problem: str | None = None
    """Why nothing is known, such as a damaged row."""


def read_recent(run: Run, generation: int) -> Recent:
    """What happened in a run up to a generation, its newest."""
    try:
        newest, recent = _objectives(run, generation)
        rows = run.history_rows(generation - FAULTS_OF + 1)
    except StoreError as error:
        return Recent(problem=error.sentence)
    # A fork may have no numbers (NaN) for the generations of its parent.
    lost, retries = (sum(row[name] for row in rows if row[name] > 0) for name in ("lost_workers", "retries"))
    return Recent(newest, recent, lost, retries)


def _objectives(run: Run, generation: int) -> tuple[Objectives, Objectives]:
    """What the centres of a generation climb, and those of recent generations, this one included."""
    [newest] = read_evaluations(run.folder, generation, 1) or [[]]  # a driver that falls back may have deleted it
    count = min(generation + 1, max(1, CENTRES // max(1, len(newest))))
    recent = read_evaluations(run.folder, generation + 1 - count, count)
    of_generation, of_all = (
        np.array([centre["fitness_weight"] for centre in centres if np.isfinite(centre["update_norm"])])
        for centres in (newest, [centre for each in recent for centre in each])
    )
    return objectives(of_generation), objectives(of_all)
