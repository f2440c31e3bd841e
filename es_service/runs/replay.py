"""Recording of episodes of a run's stored policies, for replays: the very episodes that the run evaluated.

A policy's first evaluation episode is recorded, the one whose path the map stores. The recording is compared with that
path, so that a replay never passes for something that it is not.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from es_service.config.compute import ENGINE_IMPLIES
from es_service.config.model import worker_spec
from es_service.config.tasks import task_of
from es_service.errors import EvaluationError
from es_service.protocol.messages import Centre
from es_service.protocol.process_environment import child_environment
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from es_service.runs.checked_config import changed_config
from es_service.runs.evaluation import Candidate, candidates
from es_service.runs.view import Run

RECORD_S = 600.0
"""Longest time for the recordings of one report, compilation included."""


@dataclass(frozen=True)
class Replay:
    """A recorded episode of a stored policy."""

    candidate: Candidate
    recording: Recording
    difference: float | None
    """Largest difference between the recorded and the stored path, in units of the descriptor: 0 if the recorded
    episode is the stored one to the bit. None if no path is stored for this policy."""


def record(run: Run, *, best: bool, cells: Sequence[Sequence[int]]) -> tuple[list[Replay], Recordings]:
    """Record the first evaluation episode of the best centre and of elites, in a child process on this machine.

    Raises:
        NotInRunError: a cell does not exist or is empty, or the run has no finished generation. ConfigError: the task
            cannot be used on this machine. EvaluationError: the recording failed.
    """
    overrides = {"compute.engine": "inline", **ENGINE_IMPLIES["inline"], "compute.workers": "auto"}
    config = changed_config(run.present_config, overrides)
    chosen = candidates(run, best=best, centre=False, cells=cells, every=False)
    requests = [RecordRequest(_centre(one, config.search.sigma), _ask(run, one)) for one in chosen]
    found = _answer((worker_spec(config, task_of(config)), requests))
    traces = {one.cell: run.elite(cell).trace_T_B for one, cell in zip(chosen[int(best) :], cells, strict=True)}
    replays = [
        Replay(one, recording, _difference(recording, traces.get(one.cell)))
        for one, recording in zip(chosen, found.recordings, strict=True)
    ]
    return replays, found


def _centre(one: Candidate, sigma: float) -> Centre:
    policy = one.policy
    return Centre(one.generation, policy.parameters_D, sigma, policy.observation_mean_O, policy.observation_std_O)


def _ask(run: Run, one: Candidate) -> int:
    """The place of a policy among those that its generation evaluated, found by its fitness; the first if unknown."""
    table = run.evaluations
    fitness = table[table["generation"] == one.generation]["fitness_mean"].tolist()
    return fitness.index(one.stored_fitness) if one.stored_fitness in fitness else 0


def _difference(recording: Recording, trace_T_B: np.ndarray | None) -> float | None:
    if trace_T_B is None or trace_T_B.shape != recording.trace_T_B.shape:
        return None
    return float(np.abs(recording.trace_T_B - trace_T_B).max())


def _answer(question: tuple) -> Recordings:
    with tempfile.TemporaryDirectory() as folder:
        requests, answer = Path(folder) / "requests", Path(folder) / "answer"
        requests.write_bytes(pickle.dumps(question))
        words = [sys.executable, "-m", "workers.recording", str(requests), str(answer)]
        try:
            process = subprocess.run(
                words, env=child_environment(), capture_output=True, text=True, timeout=RECORD_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise EvaluationError(f"episodes could not be recorded within {RECORD_S:g} s; choose fewer") from None
        if process.returncode:
            last = (process.stderr.strip().splitlines() or ["it printed nothing"])[-1]
            raise EvaluationError(f"episodes could not be recorded: {last}")
        return pickle.loads(answer.read_bytes())
