"""TorchRL on our tasks."""

from __future__ import annotations

import gymnasium
import pytest

pytest.importorskip("torchrl", reason="torchrl is not installed: tests.learners.environment")

from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from es_service.environments.vector import TaskVectorEnv
from tests.es_service.test_environments import POLE


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("task", ["point_maze", POLE])
def test_its_own_check_passes_for_many(task, mode):
    envs = GymWrapper(TaskVectorEnv(task, 3, max_episode_steps=20, autoreset_mode=mode), device="cpu")
    check_env_specs(envs)
    rollout = envs.rollout(50, break_when_any_done=False)
    assert rollout.batch_size == (3, 50)
    assert rollout["next", "done"].sum() >= 3


def test_its_own_check_passes_for_a_single_one():
    check_env_specs(GymWrapper(gymnasium.make("es_service.gymnasium:es_service/PointMaze-v0"), device="cpu"))
