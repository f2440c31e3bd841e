"""What the benchmark of baselines certifies and writes, as far as it works without their libraries."""

import math

import numpy as np
import pytest

import es_service
from tests.benchmarks.baselines.episodes import certification_episodes
from tests.benchmarks.baselines.our_run import OurRun
from tests.benchmarks.baselines.rows import COLUMNS, in_words, put, read
from workers.policy import act, split_layers


@pytest.mark.usefixtures("workers_here")
@pytest.mark.parametrize("number", [0, 2])
def test_policies_of_others_are_certified_in_the_episodes_that_certify_has(number):
    given = {"task": {"environment": "point_maze"}, "policy": {"hidden": [8]}, "search": {"algorithm": "es"}, "seed": 5}
    config = es_service.load_config(given | {"budget": {"generations": 1}})
    shape = es_service.config.workload.worker_spec(config, es_service.config.tasks.task_of(config)).policy
    parameters_D = np.random.default_rng(0).normal(size=shape.parameters).astype(np.float32)
    layers = split_layers(shape, parameters_D)
    found = certification_episodes(
        lambda observation: act(np, shape, layers, None, observation)[0], "point_maze", seed=5, number=number, count=20
    )
    [expected] = es_service.certify(parameters_D[None], config, episodes=20, number=number)
    np.testing.assert_allclose(found.return_E, expected.episodes.return_E, rtol=1e-4)
    np.testing.assert_allclose(found.last_reward_E, expected.episodes.last_reward_E, atol=1e-4)
    np.testing.assert_allclose(found.goal_distance_E, expected.episodes.goal_distance_E, atol=1e-4)
    np.testing.assert_allclose(found.descriptor_E_B, expected.episodes.descriptor_E_B, atol=1e-4)
    assert np.array_equal(found.steps_E, expected.episodes.steps_E)
    assert np.array_equal(found.success_E, expected.episodes.success_E)
    assert len(set(found.return_E)) == 20


def test_a_later_row_of_a_run_replaces_the_earlier_one(tmp_path):
    table = tmp_path / "table.csv"
    row = dict.fromkeys(COLUMNS, 1.5) | {"task": "ant_trap", "system": "td3", "seed": 0, "steps": 100_000}
    put(table, row | {"is_finished": False, "success": math.nan})
    put(table, row | {"system": "sac", "seed": 1, "is_finished": True, "success": 0.25})
    put(table, row | {"system": "sac", "is_finished": True, "success": 0.5, "goal_distance_mean": math.nan})
    put(table, row | {"steps": 200_000, "is_finished": False, "success": None})
    rows = read(table)
    assert [(one["system"], one["seed"], one["steps"]) for one in rows] == [
        ("sac", 0, 100_000),
        ("sac", 1, 100_000),
        ("td3", 0, 200_000),
    ]
    assert in_words(rows).splitlines()[4:] == [
        "| TD3 | 0 | 0.2M, goes on | 2 | 1.5 | 1.5 |  | 1.50 | 1131 ± 4 |",
        "| SAC | 0, 1 | 0.1M | 2 | 1.5 | 1.5 | 50%, 25% | , 1.50 | 1075 ± 7 |",
    ]
    with pytest.raises(ValueError, match="but this one has task, system"):
        put(table, {"task": "ant_trap", "system": "td3"})


@pytest.mark.slow
def test_a_run_of_ours_goes_on_and_is_certified(tmp_path):
    def begun() -> OurRun:
        return OurRun("point_maze", "map_elites", 3, tmp_path)

    run = begun()
    run.work(20_000, 1e9)
    assert 20_000 <= run.steps < 40_000
    run.keep()
    again = begun()
    assert (again.steps, again.cpu_seconds >= run.cpu_seconds * 0.5) == (run.steps, True)
    again.work(40_000, 1e9)
    row = again.row(is_finished=True, episodes=20)
    assert {*row} == {*COLUMNS}
    assert (row["steps"], row["network"], row["updates_per_step"]) == (again.steps, "64x64", 0)
    assert row["candidates"] > 1
    assert row["return_low"] < row["return_mean"] < row["return_high"]
