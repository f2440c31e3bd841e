"""What happened in the recent generations of a run: what their centres climb, and the faults that were handled.

This is read from many rows of the history. So that a damaged one hides nothing else of a run, the problem is returned.

Centres climb fitness, novelty or both, by the weight of fitness of every evaluated centre. A row of the history has the
weight of one centre only, the fittest of its generation. The centres of some methods differ, in a generation or from
block to block: each either explores, that is, climbs novelty alone (weight 0), or exploits, that is, climbs fitness
alone (weight 1). So the table of evaluated centres is read, and no method needs to be known. Only centres that a
population has moved count: no population has used the weight of initial centres or policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.errors import StoreError
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


def _objectives(run: Run, generation: int) -> tuple[Objectives, Objectives, int]:
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


class Objectives(NamedTuple):
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


def objectives(weight_N: NDArray[np.float64]) -> Objectives:
    """What centres with these weights of fitness climb."""
    exploring, exploiting = (int((weight_N == alone).sum()) for alone in (0.0, 1.0))
    return Objectives(weight_N.size, exploring, exploiting, float(weight_N.mean()) if weight_N.size else float("nan"))


def weights(centres: Mapping[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Generation and weight of fitness of each centre that a population has moved, [N], in order.

    Args:
        centres: columns of the evaluated centres, in which NaN stands for no value.
    """
    moved_N = np.isfinite(centres["update_norm"])
    return centres["generation"][moved_N], centres["fitness_weight"][moved_N]
