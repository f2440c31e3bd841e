"""Chunks in pieces have the results of the whole chunks, whatever the size of the pieces and the workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.loop.policies import policy_episodes, policy_work
from es_service.protocol.messages import GradientChunk, PolicySpec, TrainingChunk, around, evaluation_chunks
from es_service.protocol.pieces import pieces_of, whole
from tests.helpers import centre, random_parameters, spec
from workers.worker import make_worker

DRIFT = spec(
    environment="python:tests.workers.host_tasks:Drift",
    episode_steps=20,
    policy=PolicySpec((3, 8, 1)),
    rollout="host",
    chunk_pairs=4,
    outputs=("last_reward", "observation"),
)


@pytest.mark.parametrize("most", [1, 3, 5, 16, 40])
def test_the_results_of_pieces_are_those_of_whole_chunks(most):
    run, size = make_worker(DRIFT), DRIFT.policy.parameters
    subject = centre(random_parameters(0, size), observation_size=3)
    parameters_N_D = np.stack([random_parameters(seed, size) for seed in range(21)])
    statistics = np.zeros((21, 3), np.float32), np.ones((21, 3), np.float32)
    asked = policy_work(parameters_N_D, statistics, 3, seed=3, generation=2, traces=True)
    work = [*around(subject, evaluation_chunks(2, 23)), *asked.work]
    for one in work:
        pieces, [expected] = pieces_of(one, most), run([one])
        results = [result for piece in pieces for result in run([piece])]
        assert max(len(result.fitness) for result in results) == min(most, len(expected.fitness))
        found = whole(one, results)
        for name in ("fitness", "returns", "descriptor", "steps", "trace_T_B"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        for name in ("outputs", "of_steps"):
            for key, array in getattr(expected, name).items():
                np.testing.assert_array_equal(getattr(found, name)[key], array, err_msg=key)
    for chunk in (TrainingChunk(1, 0), GradientChunk(1, 0, np.ones(4, np.float32))):
        assert pieces_of((subject, chunk), most) == [(subject, chunk)]


def test_an_engine_puts_together_what_it_has_sent_in_pieces():
    subject = centre(random_parameters(0, DRIFT.policy.parameters), observation_size=3)
    parameters_N_D = np.stack([random_parameters(seed, DRIFT.policy.parameters) for seed in range(20)])
    statistics = np.zeros((20, 3), np.float32), np.ones((20, 3), np.float32)
    asked = policy_work(parameters_N_D, statistics, 2, seed=3, generation=2, traces=True)
    work = [*around(subject, [TrainingChunk(1, 0), *evaluation_chunks(2, 20)]), *asked.work]
    found = []
    for limits in (Limits(1), replace(Limits(2), episodes_together=1)):
        with inline_engine(DRIFT, limits) as engine:
            results = engine.evaluate(work)
        found.append((results[:3], policy_episodes(asked, results[3:])))
    for one, other in zip((*found[0][0], found[0][1]), (*found[1][0], found[1][1]), strict=True):
        np.testing.assert_array_equal(one.fitness, other.fitness)
        np.testing.assert_array_equal(one.trace_T_B, other.trace_T_B)
