"""Stable-Baselines3 and sbx on our tasks."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.es_service.test_environments import POLE, same

sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: tests.learners.environment")

from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize  # noqa: E402

from es_service.environments.sb3 import SB3VecEnv  # noqa: E402

GUIDE = Path(__file__).parents[2] / "workers" / "other_suites.md"


@pytest.mark.parametrize("task", ["point_maze", POLE])
def test_its_own_check_passes_for_single_environments(task):
    check_env(gymnasium.make("es_service.gymnasium:es_service/Task-v0", task=task, max_episode_steps=50))


@pytest.mark.parametrize("task", ["point_maze", POLE])
def test_they_are_those_that_it_makes_of_single_ones_bit_for_bit(task):
    single = partial(
        gymnasium.make,
        "es_service.gymnasium:es_service/Task-v0",
        task=task,
        max_episode_steps=30,
        disable_env_checker=True,
    )
    theirs, ours = DummyVecEnv([single] * 4), SB3VecEnv(task, 4, max_episode_steps=30)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    for envs in (theirs, ours):
        envs.seed(5)
    same(ours.reset(), theirs.reset())
    rng, ends = np.random.default_rng(0), 0
    for _ in range(80):
        actions = rng.uniform(-1.5, 1.5, (4, ours.action_space.shape[0])).astype(np.float32)
        *found, infos = ours.step(actions)
        *expected, their_infos = theirs.step(actions)
        same(found, expected)
        ends += int(found[-1].sum())
        for mine, one in zip(infos, their_infos, strict=True):
            same(mine | {"success": mine["is_success"]}, one | {"is_success": one["success"]})
        same([one["descriptor"] for one in ours.reset_infos], [one["descriptor"] for one in theirs.reset_infos])
    assert ends >= 4


def test_its_wrappers_and_algorithms_take_them():
    envs = VecNormalize(VecMonitor(SB3VecEnv("point_maze", 8, render_mode="rgb_array")))
    model = sb3.PPO("MlpPolicy", envs, n_steps=32, batch_size=64, seed=1, device="cpu").learn(1_000)
    assert model.num_timesteps >= 1_000
    assert envs.obs_rms.count > 1_000
    assert envs.render().shape == (3 * 256, 3 * 256, 3)
    mean, _ = evaluate_policy(model, VecMonitor(SB3VecEnv("point_maze", 4)), n_eval_episodes=4)
    assert -2.4 * 200 < mean < 0
    off = sb3.TD3("MlpPolicy", SB3VecEnv("point_maze", 4), learning_starts=100, seed=1, device="cpu").learn(300)
    assert off.num_timesteps >= 300


def test_what_such_environments_have_not_is_an_error():
    with pytest.raises(ValueError, match="autoreset_mode cannot be chosen"):
        SB3VecEnv("point_maze", autoreset_mode="Disabled")
    envs: Any = SB3VecEnv("point_maze", 2)
    with pytest.raises(AttributeError, match=r"env_method\('render'\): the environments are no objects"):
        envs.env_method("render")
    with pytest.raises(ValueError, match=r"set_attr.*of some environments"):
        envs.set_attr("metadata", {}, indices=[0])
    with pytest.raises(ValueError, match="call step_async before step_wait"):
        envs.step_wait()
    envs.set_options({"start": "corner"})
    with pytest.raises(ValueError, match="a reset has no options"):
        envs.reset()


def test_the_lines_of_the_guide_train_sac_of_sbx_on_the_trap(tmp_path, monkeypatch):
    pytest.importorskip("sbx", reason="sbx-rl is not installed: tests.learners.environment")
    [lines] = re.findall(r"```text\n(from sbx import SAC\n.*?)```", GUIDE.read_text(), re.DOTALL)
    assert len(lines.strip().splitlines()) <= 12
    lines, changes = re.subn(r"learn\([\d_]+\)", "learn(1_000)", lines)
    fewer, starts = re.subn(r"learning_starts=[\d_]+", "learning_starts=500", lines)
    assert changes == starts == 1
    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {}
    exec(fewer, made)
    assert made["model"].num_timesteps >= 1_000
    assert made["model"]._n_updates > 0
    assert (tmp_path / "ant_trap_sac.zip").exists()
