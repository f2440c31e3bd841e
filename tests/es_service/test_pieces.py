"""However chunks are cut or put together, the rows of a request are the same: results know their addresses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.episodes import apart, gathered, pieces_of, together
from es_service.protocol.messages import GradientChunk, PolicySpec, TrainingChunk, evaluation_chunks, with_subject
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.policies import ALL_TOGETHER, POLICY_SLOTS, IsoLine, recipes_of
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


ROWS = "fitness", "returns", "descriptor", "steps", "trace_T_B"


def assert_same(one, other):
    for name in ROWS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    for name in ("outputs", "of_steps"):
        for key, array in getattr(other, name).items():
            np.testing.assert_array_equal(getattr(one, name)[key], array, err_msg=key)


def drifting(policies: int, episodes: int):
    """Chunks of a centre and of policies, and the leading axes of both requests."""
    subject = centre(random_parameters(0, DRIFT.policy.parameters), observation_size=3)
    parameters_N_D = np.stack([random_parameters(seed, DRIFT.policy.parameters) for seed in range(policies)])
    statistics = np.zeros((policies, 3), np.float32), np.ones((policies, 3), np.float32)
    asked = policy_work(parameters_N_D, statistics, episodes, seed=3, generation=2, request=1, traces=True)
    work = [*with_subject(subject, evaluation_chunks(2, 23, first=4)), *asked.work]
    return work, [(1, 23), asked.shape]


@pytest.mark.parametrize(("most", "policies"), [(1, 21), (3, 5), (5, 35), (16, 21), (40, 21)])
def test_pieces_in_any_order_have_the_rows_of_whole_chunks(most, policies):
    run = make_worker(DRIFT)
    work, shapes = drifting(policies, 3)
    results = [result for one in work for piece in pieces_of(one, most) for result in run([piece])]
    assert max(len(result.fitness) for result in results) == min(most, POLICY_SLOTS)
    np.random.default_rng(most).shuffle(results)
    for found, shape, expected in zip(gathered(shapes, results), shapes, gathered(shapes, run(work)), strict=True):
        assert found.fitness.shape == shape
        assert found.trace_T_B is not None
        assert found.trace_T_B.shape[0] == shape[0]
        assert_same(found, expected)
    subject = work[0][0]
    for chunk in (TrainingChunk(1, 0), GradientChunk(1, 0, np.ones(4, np.float32))):
        assert pieces_of((subject, chunk), most) == [(subject, chunk)]


def test_rows_are_those_of_single_episodes():
    """Each row of a request is what its policy and its episode have alone."""
    run, (work, shapes) = make_worker(DRIFT), drifting(5, 3)
    _, all_ = gathered(shapes, run(work))
    subject = work[-1][0]
    for policy, first in ((0, 0), (3, 3), (4, 4)):
        alone = replace(subject, first=first, parameters_N_D=subject.parameters_N_D[policy : policy + 1])
        alone = replace(alone, observation_mean_N_O=None, observation_std_N_O=None)
        (one,) = gathered([(1, 3)], run([(alone, replace(work[-1][1], chunk_id=0, request=0))]))
        np.testing.assert_array_equal(one.fitness[0], all_.fitness[policy])
        np.testing.assert_array_equal(one.trace_T_B[0], all_.trace_T_B[policy])
        np.testing.assert_array_equal(one.steps[0], all_.steps[policy])


def test_a_row_that_is_missing_or_comes_twice_is_no_result():
    work, shapes = drifting(5, 3)
    results = make_worker(DRIFT)(work)
    for wrong in (results[1:], [*results, results[-1]]):
        with pytest.raises((AssertionError, ValueError)):
            gathered(shapes, wrong)


def test_an_engine_cuts_what_workers_compute():
    work, shapes = drifting(20, 2)
    found = []
    for limits in (Limits(1), replace(Limits(2), episodes_together=1)):
        with inline_engine(DRIFT, limits) as engine:
            found.append(gathered(shapes, engine.evaluate(work)))
    for one, other in zip(*found, strict=True):
        assert_same(one, other)


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
    assert_same(*(gathered([asked.shape], rows)[0] for rows in (results, expected)))


def test_what_is_sent_has_the_parents_that_it_needs_and_no_others():
    for subject, chunk in together(asked_for(40).work, 16):
        used = subject.parameters_N_D
        assert len(used) == min(POLICY_SLOTS, 40 - subject.first)
        assert sorted(set(used.parent_N_2.ravel().tolist())) == list(range(len(used.names)))
        assert chunk.count == POLICY_SLOTS
        expected = recipes(40).made()[subject.first : subject.first + len(used)]
        np.testing.assert_array_equal(used.made(), expected)


@pytest.mark.parametrize("policies", [16, 17, 70])
def test_policies_for_several_cores_are_sent_as_one_chunk_that_comes_apart_into_what_it_was(policies):
    work = [*asked_for(policies).work, *asked_for(35, episodes=2).work, *asked_for(20, ask=1).work]
    sent = together(work, ALL_TOGETHER)
    assert len(sent) == 1 + len(asked_for(35, episodes=2).work) + 1
    for (subject, chunk), (whole, same) in zip(apart(sent), work, strict=True):
        assert (chunk, subject.first, subject.episodes) == (same, whole.first, whole.episodes)
        np.testing.assert_array_equal(subject.parameters_N_D.made(), whole.parameters_N_D.made())


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
    (expected,) = gathered([asked.shape], make_worker(MAZE)(asked.work))
    with inline_engine(MAZE, Limits(1, policies_together=128)) as engine:
        for _ in range(2):
            (found,) = gathered([asked.shape], engine.evaluate(asked.work))
            np.testing.assert_array_equal(found.fitness, expected.fitness)
            np.testing.assert_array_equal(found.trace_T_B, expected.trace_T_B)
