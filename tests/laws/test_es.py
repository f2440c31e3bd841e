"""ES against its reference implementation; budgets, invalid members, and what the driver holds."""

import dataclasses
import tracemalloc
from functools import partial

import numpy as np
import pytest

from es_service.api import load_config
from es_service.config.workload import worker_spec
from es_service.errors import EvaluationError
from es_service.loop import driver
from es_service.loop.state import merge_moments, no_observations
from es_service.protocol.episodes import DispatchCounts, addressed
from es_service.protocol.messages import (
    EpisodesResult,
    GradientChunk,
    GradientResult,
    PolicySpec,
    TrainingChunk,
)
from es_service.protocol.noise import Domain, normals, stream_keys
from es_service.search.algorithms import ALGORITHMS
from tests.helpers import AtTheEnd, MemoryStore
from tests.laws.es_runs import SHAPE, Tampering, run_in_memory, small_config
from tests.references import es as reference
from workers.environments import SHIPPED
from workers.policy import initial_parameters
from workers.simd.backend import target
from workers.simd.episodes import compiled
from workers.simd.episodes import rollout as simd_rollout


@pytest.fixture(scope="module")
def finished():
    config = small_config()
    return config, *run_in_memory(config)


def test_twenty_generations_equal_the_reference(finished):
    config, state, _, evaluator, _ = finished
    assert_equals_the_reference(config, state, evaluator)


@pytest.mark.parametrize("shaping", ["signs", "returns"])
def test_other_shapings_equal_the_reference(finished, shaping):
    config = small_config(shaping={"kind": shaping})
    state, _, evaluator, _ = run_in_memory(config)
    assert_equals_the_reference(config, state, evaluator)
    assert not np.allclose(state.search.centres[0].centre_D, finished[1].search.centres[0].centre_D)


def assert_equals_the_reference(config, state, evaluator):
    search = config.search
    first, step = initial_parameters(SHAPE, config.policy.init, 0), search.step
    es = reference.ES(first, step.learning_rate, step.l2, search.shaping.kind)
    for generation in range(1, 21):
        results = [
            (chunk.chunk_id, result.fitness)
            for _, chunk, result in evaluator.recorded
            if isinstance(chunk, TrainingChunk) and chunk.generation == generation
        ]
        fitness_P_S = np.concatenate([fitness for _, fitness in sorted(results, key=lambda item: item[0])])
        keys = stream_keys(0, Domain.PARAMETER_NOISE, generation, np.arange(48))
        es.generation([normals(key, SHAPE.parameters) for key in keys], fitness_P_S)
    difference = np.linalg.norm(state.search.centres[0].centre_D - es.centre) / np.linalg.norm(es.centre)
    assert difference < 1e-6


def test_history_counts_what_the_workers_did(finished):
    _, state, store, evaluator, reason = finished
    assert reason == "the budget of 20 generations is spent"
    assert [row["generation"] for row in store.rows] == list(range(21))
    trained = [r for _, chunk, r in evaluator.recorded if isinstance(chunk, TrainingChunk)]
    evaluated = [r for _, chunk, r in evaluator.recorded if type(chunk).__name__ == "EvaluationChunk"]
    used = [r.steps if i % 2 == 0 else r.steps[:4] for i, r in enumerate(evaluated)]  # 20 of 32 episodes
    steps = sum(int(r.steps.sum()) for r in trained) + sum(int(s.sum()) for s in used)
    assert state.env_steps == store.rows[-1]["env_steps"] == steps
    assert state.episodes == 20 * 96 + 21 * 20
    last_two = np.concatenate([evaluated[-2].fitness, evaluated[-1].fitness[:4]]).astype(float)
    assert store.rows[-1]["centre_fitness_mean"] == pytest.approx(last_two.mean())
    assert store.rows[-1]["centre_fitness_std"] == pytest.approx(last_two.std())
    best = max(row["centre_fitness_mean"] for row in store.rows)
    assert store.rows[-1]["best_fitness"] == state.best.fitness == best
    assert store.rows[state.best.generation]["centre_fitness_mean"] == best


def test_observation_statistics_are_those_of_the_generation_s_start(finished):
    """All chunks of a generation see the same statistics, gathered from the training steps of earlier ones only."""
    _, state, _, evaluator, _ = finished
    by_generation = {}
    for point, chunk, result in evaluator.recorded:
        if isinstance(chunk, GradientChunk):
            continue  # it needs no centre
        by_generation.setdefault(chunk.generation, []).append((point, chunk, result))
    total = 0.0
    for generation in range(21):
        seen = {
            (p.observation_mean_O.tobytes(), p.observation_std_O.tobytes()) for p, _, _ in by_generation[generation]
        }
        assert len(seen) == 1
        if generation in (0, 1):
            assert by_generation[generation][0][0].observation_std_O.tolist() == [1.0, 1.0]
        trained = [r for _, chunk, r in by_generation[generation] if isinstance(chunk, TrainingChunk)]
        total += sum(r.moments.count for r in trained)
    assert (
        state.observations.count
        == total
        == sum(int(r.steps.sum()) for _, c, r in evaluator.recorded if isinstance(c, TrainingChunk))
    )


def test_normalisation_off_means_raw_observations():
    config = load_config(
        {
            "task": {"environment": "point_maze"},
            "policy": {"hidden": [8, 8], "observation_normalization": False},
            "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 2},
            "budget": {"generations": 2},
        }
    )
    _, _, evaluator, _ = run_in_memory(config)
    for point, chunk, _ in evaluator.recorded:
        if isinstance(chunk, GradientChunk):
            continue
        assert point.observation_mean_O.tolist() == [0.0, 0.0]
        assert point.observation_std_O.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("isa", ["avx2", "four"])
def test_vectors_of_another_width_give_the_same_run(finished, monkeypatch, isa):
    """What a processor without AVX-512 computes: everything that is kept has the same bits."""
    config, state, store, _, _ = finished
    assert config.compute.rollout == "simd"
    for module in (simd_rollout, compiled):
        monkeypatch.setattr(module, "host_target", partial(target.host_target, isa))
    again, other, _, _ = run_in_memory(config)
    assert again.generation == state.generation
    assert other.parts.keys() == store.parts.keys()
    for name, part in store.parts.items():
        for key, array in part.items():
            np.testing.assert_array_equal(other.parts[name][key], array, err_msg=f"{name} {key}")


@pytest.mark.parametrize(
    ("budget", "generations", "reason"),
    [
        ({"generations": 2}, 2, "the budget of 2 generations is spent"),
        ({"env_steps": 30_000}, 2, "the budget of 30,000 environment steps is spent"),
        ({"target_fitness": -1e9}, 0, "the target fitness -1e+09 is reached"),
        ({"wall_clock_s": 1e-6, "generations": 50}, 0, "only starting took place: the budget of 1e-06 s was spent"),
    ],
)
def test_the_first_spent_budget_ends_the_run(budget, generations, reason):
    mapping = small_config().model_dump(mode="json") | {"budget": budget}
    state, _, _, why = run_in_memory(load_config(mapping))
    assert state.generation == generations
    assert reason in why


def test_invalid_members_rank_last_are_counted_and_do_not_stop_the_run():
    def spoil(chunk, result):
        if isinstance(chunk, TrainingChunk) and chunk.chunk_id == 1:
            result.fitness[0, 0] = np.nan
            result.descriptor[1, 1] = np.inf
        return result

    config = small_config()
    state, store, _, _ = run_in_memory(config, Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil))
    assert [row.get("invalid_members") for row in store.rows[1:]] == [2] * 20
    assert np.isfinite(state.search.centres[0].centre_D).all()
    assert all(np.isfinite(row["population_fitness_min"]) for row in store.rows[1:])


@pytest.mark.parametrize("shaping", ["ranks", "returns"])
def test_infeasible_members_rank_as_invalid_ones_do_and_are_counted_apart(shaping):
    """Their fitness is -inf. They do not count as invalid, also where their descriptor is not finite."""

    def spoil(value):
        def spoiled(chunk, result):
            if isinstance(chunk, TrainingChunk) and chunk.chunk_id == 1:
                result.fitness[:, 0] = value
                result.descriptor[1, 0] = np.nan
            return result

        return spoiled

    def run(value, **search):
        config = small_config(shaping={"kind": shaping}, **search)
        state, store, *_ = run_in_memory(config, Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil(value)))
        return state, store.rows[1:]

    (invalid, of_invalid), (state, rows) = run(np.nan), run(-np.inf, allow_infeasible=True, max_invalid_fraction=0.0)
    np.testing.assert_array_equal(state.search.centres[0].centre_D, invalid.search.centres[0].centre_D)
    count = of_invalid[0]["invalid_members"]
    assert count > 0
    assert "infeasible_members" not in of_invalid[0]
    assert {(row["invalid_members"], row["infeasible_members"]) for row in rows} == {(0, count)}


def test_too_many_invalid_members_stop_the_run_with_a_named_error():
    def spoil(chunk, result):
        if isinstance(chunk, TrainingChunk) and chunk.generation == 3:
            result.fitness[:9] = np.nan
        return result

    config = small_config(max_invalid_fraction=0.25)
    with pytest.raises(
        EvaluationError,
        match=r"generation 3: 54 of 96 members returned a fitness that is not finite \(54\), more than "
        r"search.max_invalid_fraction \(0.25\) .* smaller values of search.sigma and search.step.learning_rate may",
    ):
        run_in_memory(config, Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil))


def test_a_centre_that_is_not_finite_stops_the_run_before_it_is_kept():
    config, store = small_config(step={"learning_rate": 1e300}), MemoryStore()
    with pytest.raises(EvaluationError, match=r"generation 1: a centre is not finite.*learning_rate = 1e\+300"):
        run_in_memory(config, store=store)
    assert store.generation == 0


def test_an_invalid_centre_is_never_the_best():
    def spoil(chunk, result):
        if type(chunk).__name__ == "EvaluationChunk" and chunk.generation != 4:
            spoilt = slice(1) if chunk.generation == 0 else slice(None)  # one episode is enough
            result.fitness[spoilt] = np.nan
        return result

    config = small_config()
    state, store, _, _ = run_in_memory(config, Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil))
    assert state.best.generation == 4
    assert store.rows[3]["best_fitness"] == -np.inf


@pytest.mark.parametrize(("name", "value"), [("return", np.nan), ("return", -np.inf), ("descriptor", np.inf)])
def test_a_task_that_gives_no_finite_number_is_told_before_anything_is_kept(name, value):
    def spoil(chunk, result):
        if name == "return":
            return dataclasses.replace(result, fitness=result.fitness + value, returns=result.returns + value)
        return dataclasses.replace(result, descriptor=result.descriptor + value)

    config, store = small_config(), MemoryStore()
    evaluator = Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil)
    with pytest.raises(EvaluationError, match=f"the {name} is NaN or infinite in each of the 20 episodes") as error:
        run_in_memory(config, evaluator, store)
    assert (error.value.field, error.value.value) == ("task.environment", "point_maze")
    assert store.generation is None


def test_an_infinite_fitness_gives_no_warning():
    """Warnings are errors in tests."""

    def spoil(chunk, result):
        result.fitness[1], result.returns[1] = np.inf, np.inf
        return result

    config = small_config()
    state, store, _, _ = run_in_memory(config, Tampering(worker_spec(config, SHIPPED["point_maze"]), spoil))
    assert (state.generation, state.best.fitness) == (20, -np.inf)
    assert np.isnan(store.rows[5]["centre_fitness_std"])


class Inventing(AtTheEnd):
    """Answers every chunk at once, with made-up numbers and one shared partial gradient."""

    counts = DispatchCounts()

    def __init__(self, parameters):
        self.sum_D = np.ones(parameters, np.float32)
        self.rng = np.random.default_rng(0)

    def evaluate(self, work):
        return [self.answer(*subject_chunk) for subject_chunk in work]

    def answer(self, subject, chunk):
        if isinstance(chunk, GradientChunk):
            return GradientResult(self.sum_D)
        axes = (64, 2) if isinstance(chunk, TrainingChunk) else (chunk.episodes,)
        fitness = self.rng.normal(size=axes).astype(np.float32)
        steps = np.full(axes, 200, np.int32)
        descriptor = np.zeros((*axes, 2), np.float32)
        trace = None if isinstance(chunk, TrainingChunk) else np.zeros((64, 2), np.float32)
        result = EpisodesResult(fitness, fitness, descriptor, steps, descriptor, no_observations(2), trace)
        return addressed((subject, chunk), result)


def test_the_driver_holds_no_population_times_parameters_array():
    """2,048 pairs of 4,482 parameters would be 37 MB; the driver gets by with a few vectors of parameters."""
    mapping = {"task": {"environment": "point_maze"}, "search": {"algorithm": "es", "pairs": 2048}}
    config = load_config(mapping | {"budget": {"generations": 3}})
    shape = PolicySpec((2, 64, 64, 2))
    first = initial_parameters(shape, "unit_columns", 0)
    search = driver.Search(
        config, ALGORITHMS["es"](config), lambda: ([first], no_observations(2)), SHIPPED["point_maze"]
    )
    evaluator = Inventing(shape.parameters)
    tracemalloc.start()
    driver.drive(driver.run(search, MemoryStore(), None, lambda row: None), evaluator)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2048 * shape.parameters * 4 / 10


def test_statistics_are_merged_in_the_order_of_chunks():
    state, _, evaluator, _ = run_in_memory(small_config())
    total = no_observations(2)
    for generation in range(1, 21):
        of_chunk = {
            chunk.chunk_id: result.moments
            for _, chunk, result in evaluator.recorded
            if isinstance(chunk, TrainingChunk) and chunk.generation == generation
        }
        total = merge_moments(total, [of_chunk[number] for number in sorted(of_chunk)])
    np.testing.assert_array_equal(state.observations.mean_O, total.mean_O)
    np.testing.assert_array_equal(state.observations.m2_O, total.m2_O)
