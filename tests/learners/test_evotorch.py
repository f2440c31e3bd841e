"""EvoTorch on our tasks."""

from __future__ import annotations

import pytest

pytest.importorskip("evotorch", reason="evotorch is not installed: tests.learners.environment")

from evotorch.algorithms import PGPE
from evotorch.neuroevolution import VecGymNE

from es_service.environments.vector import TaskVectorEnv


def test_it_searches_with_many():
    problem = VecGymNE(
        lambda num_envs, **_: TaskVectorEnv("point_maze", num_envs, max_episode_steps=50),
        "Linear(obs_length, act_length)",
        max_num_envs=16,
    )
    search = PGPE(problem, popsize=16, center_learning_rate=0.1, stdev_learning_rate=0.1, stdev_init=0.1)
    search.run(2)
    best = float(search.status["best_eval"])
    assert -2.4 * 50 < best < 0
