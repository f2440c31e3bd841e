"""What members are ranked by: hand-worked target sets, the other kinds, and schedules and the gate of steps."""

from __future__ import annotations

import numpy as np
import pytest

from es_service.config.parts import (
    FitnessObjective,
    GoalObjective,
    MixtureObjective,
    NoveltyObjective,
    ReturnObjective,
    TargetObjective,
)
from es_service.loop.generation import halves
from es_service.protocol.episodes import completed
from es_service.protocol.messages import EpisodesResult, GradientChunk, GradientResult, TrainingChunk
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.common import first_state, scheduled
from es_service.search.novelty import empty_archive, extended
from es_service.search.shaping import (
    SHAPINGS,
    centred_ranks,
    target_values,
    utilities,
    values,
    weight_of_fitness,
    weighted,
)
from tests.laws.es_runs import run_in_memory, small_config

INF, NAN = np.inf, np.nan


def results_of(fitness, descriptor=None, returns=None, distance=None) -> EpisodesResult:
    fitness = np.asarray(fitness, np.float32)
    nothing = np.full((*fitness.shape, 2), np.nan, np.float32)
    return EpisodesResult(
        fitness=fitness,
        returns=fitness if returns is None else np.asarray(returns, np.float32),
        descriptor=nothing if descriptor is None else np.asarray(descriptor, np.float32),
        steps=np.ones(fitness.shape, np.int32),
        goal_distance=nothing if distance is None else np.asarray(distance, np.float32),
        moments=None,
    )


def order(values_N) -> list[int]:
    return np.argsort(-np.asarray(values_N), kind="stable").tolist()


def test_inside_of_a_target_set_fitness_decides_and_outside_the_distance_below_all_of_those():
    target = TargetObjective(descriptor=(10.0, 0.0), radius=2.0)
    places = [[10, 0], [12, 0], [10, 2.1], [0, 0], [11, 1]]  # inside, on the border, outside, far outside, inside
    fitness = [-5.0, 3.0, 1000.0, 2000.0, -6.0]
    found = target_values(target, fitness, places)
    assert order(found) == [1, 0, 4, 2, 3]
    assert found.tolist() == [0.25, 0.5, -0.25, -0.5, 0.0]


def test_equal_members_of_a_target_set_share_a_rank_and_invalid_ones_have_none():
    target = TargetObjective(descriptor=(0.0,), radius=1.0)
    found = target_values(target, [1.0, 1.0, NAN, 4.0, 9.0], [[0.5], [-0.5], [0.0], [3.0], [-3.0]])
    assert found[0] == found[1] > found[3] == found[4]
    assert np.isnan(found[2])
    assert np.isnan(target_values(target, [1.0, 2.0], [[NAN], [0.0]])[0])
    both_P_S = target_values(target, [[1.0, 2.0], [0.0, 3.0]], np.zeros((2, 2, 1)))
    assert np.allclose(both_P_S, [[-1 / 6, 1 / 6], [-0.5, 0.5]])


def test_of_equally_fit_members_of_a_target_set_the_nearer_ranks_higher_if_distance_decides():
    places = [[0.0], [0.9], [-0.5], [0.1], [2.0], [-0.5]]
    fitness = [0.0, 1.0, 0.0, 0.0, 5.0, 0.0]
    share, distance = (
        target_values(TargetObjective(descriptor=(0.0,), radius=1.0, ties=ties), fitness, places)
        for ties in ("share", "distance")
    )
    assert order(share) == [1, 0, 2, 3, 5, 4]
    assert share[0] == share[2] == share[3] == share[5]
    assert order(distance) == [1, 0, 3, 2, 5, 4]
    assert distance[2] == distance[5]  # equally far
    without_ties = np.random.default_rng(0).normal(size=6)
    assert (
        target_values(TargetObjective(descriptor=(0.0,), ties="distance"), without_ties, places)
        == target_values(TargetObjective(descriptor=(0.0,)), without_ties, places)
    ).all()


def test_adding_a_constant_to_the_fitness_changes_no_rank_of_a_target_set():
    rng = np.random.default_rng(0)
    fitness, places = rng.normal(size=40), rng.normal(size=(40, 2))
    target = TargetObjective(descriptor=(0.2, 0.1), radius=0.8)
    first = target_values(target, fitness, places)
    assert (target_values(target, fitness - 1e5, places) == first).all()
    inside = np.linalg.norm(places - [0.2, 0.1], axis=1) <= 0.8
    assert 5 < inside.sum() < 35
    assert first[inside].min() > first[~inside].max()
    assert (centred_ranks(first[inside]) == centred_ranks(fitness[inside])).all()


def test_each_kind_ranks_by_what_it_names():
    results = results_of([1, 2, 3], returns=[3, 2, 1], distance=[[5, 0], [4, 9], [6, 0]])
    assert order(values(FitnessObjective(), results)) == [2, 1, 0]
    assert order(values(ReturnObjective(), results)) == [0, 1, 2]
    assert order(values(GoalObjective(), results)) == [1, 0, 2]
    for objective in (FitnessObjective(), ReturnObjective(), GoalObjective()):
        invalid = results_of([1, NAN, 3], returns=[3, 2, 1], distance=[[5, 0], [4, 9], [6, 0]])
        assert np.isnan(values(objective, invalid)).tolist() == [False, True, False]


def test_final_is_the_fitness_that_final_rewards_are():
    """A run whose objective is `final` takes the first step of one whose fitness is `final`."""

    def first_steps(fitness, objective):
        config = small_config(algorithm="me_es", objectives=[{"kind": objective}])
        task = config.task.model_copy(update={"fitness": fitness})
        budget = config.budget.model_copy(update={"generations": 1})
        state, store, evaluator, _ = run_in_memory(config.model_copy(update={"task": task, "budget": budget}))
        populations = [one for _, chunk, one in evaluator.recorded if isinstance(chunk, TrainingChunk)]
        return [one.centre_D.tobytes() for one in state.search.centres], populations, store

    (final, _, _), (by_fitness, populations, _) = first_steps("sum", "final"), first_steps("final", "fitness")
    assert final == by_fitness
    assert final != first_steps("sum", "fitness")[0]
    assert not populations[0].outputs


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_a_mixture_is_the_weighted_sum_of_what_it_mixes(weight):
    config = small_config(algorithm="nsr_es")
    archive = empty_archive(2)
    for place in ([0.0, 0.0], [1.0, 0.0], [0.3, 0.4]):
        archive = extended(archive, np.array(place), 0, 0)
    rng = np.random.default_rng(1)
    population = results_of(rng.normal(size=(8, 2)), rng.normal(size=(8, 2, 2)))
    for shaping in (config.search.shaping,):
        arguments = population, archive, config.novelty, shaping
        novel, fit = (utilities(one, *arguments) for one in (NoveltyObjective(), FitnessObjective()))
        mixed = utilities(MixtureObjective(weight=weight), *arguments)
        assert np.allclose(mixed, (1 - weight) * novel + weight * fit)
        assert (utilities(weighted(weight), *arguments) == mixed).all()
        assert (fit == SHAPINGS[shaping.kind](shaping, population.fitness)).all()
    assert weight_of_fitness(weighted(weight)) == weight


def test_a_schedule_falls_by_its_factor_to_its_limit():
    assert [scheduled(0.5, 0.5, 0.1, generation) for generation in (1, 2, 3, 4, 90)] == [0.5, 0.25, 0.125, 0.1, 0.1]
    assert scheduled(0.02, 1.0, 0.5, 7) == 0.02  # a limit above the start has no effect
    assert scheduled(0.02, 0.5, 0.5, 7) == 0.02


def test_a_generation_has_the_sigma_and_the_rate_of_its_schedules_and_a_step_heeds_the_rate():
    config = small_config(
        sigma_decay=0.5,
        sigma_limit=0.03,
        learning_rate_decay=0.25,
        step={"kind": "plain", "learning_rate": 0.4, "l2": 0},
    )
    method, search = ALGORITHMS["es"](config), config.search
    state = first_state([np.zeros(3, np.float32)], 2, 1.0, search=search)
    asked = [method.ask(state, generation)[0] for generation in (1, 2, 3)]
    assert [one.sigma for one in asked] == [0.1, 0.05, 0.03]
    assert [one.rate for one in asked] == [1.0, 0.25, 0.0625]
    ones_D = np.ones(3, np.float32)
    steps = [method.step(state, one, ones_D).centres[0].centre_D[0] for one in asked]
    assert np.allclose(steps, [0.4, 0.1, 0.025])


def test_a_gated_run_takes_steps_as_long_as_the_halves_agree():
    def first_step(**settings):
        config = small_config(step={"kind": "plain", "learning_rate": 0.4, "l2": 0}, **settings)
        config = config.model_copy(update={"budget": config.budget.model_copy(update={"generations": 1})})
        _, store, evaluator, _ = run_in_memory(config)
        gradients = [one for _, chunk, one in evaluator.recorded if isinstance(chunk, GradientChunk)]
        return store.rows[-1]["update_norm"], [one.sum_D for one in gradients if one.sum_D is not None]

    whole, _ = first_step()
    gated, sums = first_step(step_gate=True)
    blocks = len(sums) // 2  # of each half
    halves_D = [np.sum(of, axis=0, dtype=np.float64) for of in (sums[:blocks], sums[blocks:])]
    lengths = [np.linalg.norm(one) for one in halves_D]
    cosine = float(halves_D[0] @ halves_D[1] / np.prod(lengths))
    assert gated == pytest.approx(whole * max(0.0, cosine), rel=1e-4)
    assert gated < whole


class Noise:
    """An evaluator of gradients whose pairs have these noises [P, D]."""

    def __init__(self, noise_P_D: np.ndarray) -> None:
        self.noise_P_D = noise_P_D

    def evaluate(self, work):
        return [self.partial(chunk) for _, chunk in work]

    def partial(self, chunk: GradientChunk) -> GradientResult:
        size = len(chunk.weights_P)
        noise_P_D = self.noise_P_D[chunk.chunk_id * size : (chunk.chunk_id + 1) * size]
        return GradientResult(np.asarray(chunk.weights_P @ noise_P_D, np.float32))


def test_the_halves_of_a_population_add_up_and_agree_as_the_cosine_between_them():
    noise_P_D = np.array([[1, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    evaluator, ones = Noise(noise_P_D), np.ones(4, np.float32)
    for weights, agreement in (
        (ones, 1 / np.sqrt(5)),  # [2, 0] and [1, 2]
        (ones * [1, 1, 0, 0], 1.0),  # pairs without weight are in neither half: [1, 0] and [1, 0]
        (ones * [0, 1, 0, 0], 0.0),  # one half is 0
        (ones * [1, 0, 0, -1], 0.0),  # they point away from each other
        (ones * [1, 0, 0, 0] + ones * [0, 0, -1, 1], 1.0),  # [1, 0] and [1, 0]
    ):
        [gradient_D], [found] = completed(halves(1, [np.asarray(weights, np.float32)], 2), evaluator.evaluate)
        assert np.allclose(gradient_D, weights @ noise_P_D / 4)
        assert found == pytest.approx(agreement)
