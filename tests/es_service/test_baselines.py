"""What the benchmark of baselines certifies and writes, as far as it works without their libraries."""

import math

import numpy as np
import pytest

import es_service
from tests.benchmarks.baselines.episodes import certification_episodes
from tests.benchmarks.baselines.rows import COLUMNS, in_words, put, read
from workers.policies.policy import act, split_layers


@pytest.mark.usefixtures("workers_here")
@pytest.mark.parametrize("number", [0, 2])
def test_policies_of_others_are_certified_in_the_episodes_that_certify_has(number):
    given = {"task": {"environment": "point_maze"}, "policy": {"hidden": [8]}, "search": {"algorithm": "es"}, "seed": 5}
    config = es_service.load_config(given | {"budget": {"generations": 1}})
    shape = es_service.config.model.worker_spec(config, es_service.config.tasks.task_of(config)).policy
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
    row = dict.fromkeys(COLUMNS, 1.5) | {"task": "ant_trap", "system": "td3", "seed": 0, "steps": 100}
    put(table, row | {"is_finished": False, "success": math.nan})
    put(table, row | {"system": "sac", "is_finished": True, "success": 0.25})
    put(table, row | {"steps": 200, "is_finished": False, "success": None})
    rows = read(table)
    assert [(one["system"], one["steps"]) for one in rows] == [("sac", 100), ("td3", 200)]
    assert in_words(rows).splitlines()[2:] == [
        "| ant_trap | sac | 0 | 100 | 2 | 1.5 (1.5 to 1.5) | 25% |",
        "| ant_trap | td3 | 0 | 200 | 2, goes on | 1.5 (1.5 to 1.5) |  |",
    ]
    with pytest.raises(ValueError, match="but this one has task, system"):
        put(table, {"task": "ant_trap", "system": "td3"})
