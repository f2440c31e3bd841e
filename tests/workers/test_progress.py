"""How far a worker is with what takes long, as another thread sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk
from tests.helpers import centre, spec
from tests.workers import host_tasks
from tests.workers.test_host import centre_of, drift
from workers import progress
from workers.worker import make_worker


class Looking(host_tasks.Drift):
    """A drift in which each call looks at the progress of its worker."""

    seen: list[tuple[str, progress.Seen]] = []  # noqa: RUF012

    def __init__(self, wind=0.05):
        self.seen.append(("make", progress.seen()))
        super().__init__(wind)

    def reset(self, seed):
        self.seen.append(("reset", progress.seen()))
        return super().reset(seed)

    def step(self, action):
        self.seen.append(("step", progress.seen()))
        return super().step(action)


def test_environments_are_made_before_the_first_chunk_of_a_kind_and_each_call_is_progress():
    """Made for the lanes that run, none twice; no two looks show the same, so that a deadline can follow each call."""
    worker_spec = replace(drift(), environment=f"python:{__name__}:Looking")
    run, subject = make_worker(worker_spec), centre_of(worker_spec)
    kinds = [(EvaluationChunk(1, 0, episodes=3), 3, 3), (TrainingChunk(1, 0), 5, 8)]
    for chunk, made, lanes in kinds:
        Looking.seen.clear()
        run.compile([(subject, chunk)])
        assert [(what, *seen[1:]) for what, seen in Looking.seen] == [
            ("make", "making", number, made) for number in range(made)
        ]
        assert progress.seen().doing == ""
        Looking.seen.clear()
        run([(subject, chunk)])
        resets = [(what, *seen[1:]) for what, seen in Looking.seen[:lanes]]
        assert resets == [("reset", "resetting", number, lanes) for number in range(lanes)]
        assert {(what, *seen[1:3]) for what, seen in Looking.seen[lanes:]} == {("step", "", 0)}
        moves = [seen.moves for _, seen in Looking.seen]
        assert len(set(moves)) == len(moves) > 2 * lanes


def looking(parameters):
    """The number of parts of the work that have been done, as it is seen from within."""
    ((_, moves),) = progress.seen().moves[-1]
    return moves


looking.parameters = 1


def test_each_call_of_a_function_and_each_chunk_is_progress():
    shape = PolicySpec((0, 1), bias=True)
    run = make_worker(
        spec(environment=f"function:{__name__}:looking", rollout="host", episode_steps=1, policy=shape, chunk_pairs=1)
    )
    subject = centre(np.zeros(1), observation_size=0)
    found = run([(subject, EvaluationChunk(1, chunk, episodes=3)) for chunk in range(2)])
    first, second = (result.fitness[:3] for result in found)
    np.testing.assert_array_equal(np.concatenate([first, second]) - first[0], [0, 1, 2, 4, 5, 6])


def test_what_raises_is_made_no_longer():
    with pytest.raises(ZeroDivisionError):
        [1 / number for number in progress.counted("making", [1, 0])]
    assert progress.seen().doing == ""
