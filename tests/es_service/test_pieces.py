"""Chunks in pieces have the results of the whole chunks, whatever the size of the pieces and the workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.loop.policies import no_statistics, policy_episodes, policy_work
from es_service.protocol.messages import GradientChunk, PolicySpec, TrainingChunk, evaluation_chunks, with_subject
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.pieces import pieces_of, separated, together, whole
from es_service.protocol.policies import POLICY_SLOTS
from es_service.protocol.recipes import IsoLine, recipes_of
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
    work = [*with_subject(subject, evaluation_chunks(2, 23)), *asked.work]
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
    work = [*with_subject(subject, [TrainingChunk(1, 0), *evaluation_chunks(2, 20)]), *asked.work]
    found = []
    for limits in (Limits(1), replace(Limits(2), episodes_together=1)):
        with inline_engine(DRIFT, limits) as engine:
            results = engine.evaluate(work)
        found.append((results[:3], policy_episodes(asked, results[3:])))
    for one, other in zip((*found[0][0], found[0][1]), (*found[1][0], found[1][1]), strict=True):
        np.testing.assert_array_equal(one.fitness, other.fitness)
        np.testing.assert_array_equal(one.trace_T_B, other.trace_T_B)


MAZE = spec(policy=PolicySpec((2, 8, 2)), rollout="simd", outputs=("last_reward", "observation"))
PARENTS = [random_parameters(seed, MAZE.policy.parameters) for seed in range(6)]


def recipes(policies: int):
    parent_N_2 = np.random.default_rng(policies).integers(len(PARENTS), size=(policies, 2))
    keys = stream_keys(0, Domain.VARIATION, 1, np.arange(policies))
    return recipes_of(IsoLine(0.1, 0.2), PARENTS, parent_N_2, keys)


def asked_for(policies: int, episodes: int = 1, ask: int = 0):
    return policy_work(
        recipes(policies), no_statistics(policies, 2), episodes, seed=3, generation=2, ask=ask, traces=True
    )


@pytest.mark.parametrize(("policies", "most", "sizes"), [(16, 128, [16]), (70, 128, [70]), (70, 40, [32, 38])])
def test_policies_with_one_episode_are_sent_as_one_chunk_and_have_the_results_of_their_own(policies, most, sizes):
    run, asked = make_worker(MAZE), asked_for(policies)
    sent = together(asked.work, most)
    assert [len(subject.parameters_N_D) for subject, _ in sent] == sizes
    results, expected = run(sent), [result for one in asked.work for result in run([one])]
    assert [len(result.fitness) for result in results] == sizes
    for found, wanted in zip(separated(asked.work, results), expected, strict=True):
        for name in ("fitness", "returns", "descriptor", "steps", "trace_T_B"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
        for name in ("outputs", "of_steps"):
            for key, array in getattr(wanted, name).items():
                np.testing.assert_array_equal(getattr(found, name)[key], array, err_msg=key)


def test_what_is_sent_has_the_parents_that_it_needs_and_no_others():
    for subject, chunk in together(asked_for(40).work, 16):
        used = subject.parameters_N_D
        assert len(used) == min(POLICY_SLOTS, 40 - subject.first)
        assert sorted(set(used.parent_N_2.ravel().tolist())) == list(range(len(used.names)))
        assert chunk.count == POLICY_SLOTS
        expected = recipes(40).made()[subject.first : subject.first + len(used)]
        np.testing.assert_array_equal(used.made(), expected)


def test_only_neighbours_of_one_ask_are_one_chunk():
    several, first, second = asked_for(40, episodes=2).work, asked_for(33).work, asked_for(33, ask=1).work
    of_policies = np.ones((40, MAZE.policy.parameters), np.float32)
    explicit = policy_work(of_policies, no_statistics(40, 2), 1, seed=3, generation=2).work
    work = [*several, *first, *second, second[0], *explicit]
    counts = [chunk.count for _, chunk in together(work, 128)]
    assert counts == [16] * len(several) + [33, 33, 16] + [16] * len(explicit)
    subjects = {id(subject) for subject, _ in together(several, 128)}
    assert len(subjects) == 3, "chunks of the same policies share them"
    training = with_subject(
        centre(random_parameters(0, 10), observation_size=2), [TrainingChunk(1, 0), TrainingChunk(1, 1)]
    )
    assert together(training, 128) == training


@pytest.mark.slow
def test_an_engine_sends_policies_together():
    asked = asked_for(70)
    expected = policy_episodes(asked, make_worker(MAZE)(asked.work))
    with inline_engine(MAZE, Limits(1, policies_together=128)) as engine:
        for _ in range(2):
            found = policy_episodes(asked, engine.evaluate(asked.work))
            np.testing.assert_array_equal(found.fitness, expected.fitness)
            np.testing.assert_array_equal(found.trace_T_B, expected.trace_T_B)
