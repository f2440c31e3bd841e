"""A policy for each goal of a task: which runs polish them, from which policies, and what they reach."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from es_service import load_config, run
from es_service.cli.main import app
from es_service.config.search import CandidatesConfig
from es_service.config.tasks import task_of
from es_service.errors import ConfigError
from es_service.runs.goals import goal_configs, goals_reached
from tests.helpers import workers_in_this_process
from workers.environments.declared import wrong_values

TASK = f"python:{__name__}:Line"


class Line:
    """A point drifts along a line, by a hundredth of what its policy says."""

    observation_size, action_size, episode_steps = 1, 1, 20
    descriptor_names, descriptor_bounds = ("x",), ((-0.2, 0.2),)
    options = {"goal": ("none", "left", "right")}  # noqa: RUF012
    goal_places, goal_radius = {"left": (-0.15,), "right": (0.15,)}, 0.05

    def __init__(self, goal="none"):
        self._goal = self.goal_places.get(goal, (0.0,))[0]

    def reset(self, seed):
        """Begin at the left or the right of the middle."""
        self.x = 0.01 * np.random.default_rng(seed).uniform(-1.0, 1.0)
        return np.ones(1)

    def step(self, action):
        """Move by at most 0.01."""
        self.x += 0.01 * float(action[0])
        return np.ones(1), float(self.success()), False

    def descriptor(self):
        """Where it is."""
        return np.array([self.x])

    def success(self):
        """it is near the goal at the end"""
        return abs(self.x - self._goal) <= self.goal_radius


PARENT = {
    "task": {"environment": TASK, "options": {"goal": "none"}},
    "policy": {"hidden": []},
    "search": {"algorithm": "memes", "mode": "explore", "emitters": 2, "pairs": 8, "sigma": 0.1,
               "evaluation_episodes": 2},
    "budget": {"generations": 8},
    "compute": {"engine": "inline", "workers": 1},
}  # fmt: skip


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    with workers_in_this_process():
        return run(load_config(PARENT), tmp_path_factory.mktemp("goals") / "parent").run


def test_each_goal_has_a_config_that_ranks_by_it(parent):
    configs = goal_configs(parent.folder)
    assert [config.label for config in configs] == ["left", "right"]
    steps = int(parent.history["env_steps"].iloc[-1])
    for label, source in configs:
        config = load_config(source)
        place, search = Line.goal_places[label], config.search
        assert isinstance(search, CandidatesConfig)
        assert config.task.options == {"goal": label}
        assert (search.algorithm, search.candidate_choice) == ("polish", "place")
        assert search.objective.model_dump() == {
            "kind": "target", "descriptor": place, "radius": 0.05, "ties": "share",
        }  # fmt: skip
        assert config.budget.env_steps == -(-steps // 2)
        assert task_of(config).goal is None, "the descriptor is no place in the plane"
    assert "env_steps" not in goal_configs(parent.folder, ["left"], {"budget.generations": 3})[0].source["budget"]  # type: ignore[index]


def test_unknown_goals_and_tasks_without_goals_are_refused(parent, tmp_path, one_process):
    with pytest.raises(ConfigError, match="the goal rihgt is unknown; must be left or right; did you mean right"):
        goal_configs(parent.folder, ["rihgt"])
    maze = load_config({"task": {"environment": "point_maze"}, "search": {"algorithm": "es", "pairs": 16},
                        "budget": {"generations": 1}, "compute": {"workers": 1, "engine": "inline"}})  # fmt: skip
    with pytest.raises(ConfigError, match=r"point_maze declares no goals; .* search\.objective\.kind = target"):
        goal_configs(run(maze, tmp_path / "maze").run.folder)


def test_policies_of_all_goals_reach_them_and_the_command_goes_on(parent, tmp_path):
    out = tmp_path / "out"
    words = ["polish", parent.folder, "--goals", "all", "--seeds", "3:4", "--out", out, "--workers", 1]
    for setting in ("pairs=8", "screened=4", "candidates=1", "sigma=0.2", "step.learning_rate=0.2"):
        words += ["--set", f"search.{setting}"]
    words += ["--set", "budget.generations=15"]
    first = CliRunner().invoke(app, [*map(str, words)])
    assert first.exit_code == 0, (first.output, first.exception)
    table = pd.read_csv(out / "goals.csv")
    assert table[["goal", "seed"]].to_numpy().tolist() == [["left", 3], ["right", 3]]
    assert (table.success >= 0.9).all(), first.output
    assert (table.success_low < table.success).all()
    assert "2 of 2 policies succeed in at least half of their episodes" in first.output
    again = CliRunner().invoke(app, [*map(str, words)])
    assert again.exit_code == 0, again.output
    pd.testing.assert_frame_equal(goals_reached(table.run), table, check_dtype=False)  # finished runs are not repeated


def test_a_goal_that_is_not_certified_is_said_to_be_so(parent, tmp_path):
    words = ["polish", parent.folder, "--goals", "all", "--out", tmp_path / "out", "--workers", 1]
    for setting in ("search.pairs=4", "search.screened=2", "search.candidates=1", "budget.wall_clock_s=0.001"):
        words += ["--set", setting]
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, (result.output, result.exception)
    assert "goal left, seed 0: not certified" in result.output
    assert "is not finished" in result.output
    assert pd.read_csv(tmp_path / "out/goals.csv").success.isna().all()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--goals", "all"], "--goals all needs --out FOLDER"),
        (["--goals", "all", "--out", "x", "--show-output"], "does not show output"),
        (["--seeds", "0:2", "--out", "x"], "--seeds 0:2 needs --goals"),
        (["--parallel", "2", "--out", "x"], "--parallel 2 needs --goals"),
    ],
)
def test_options_that_need_goals_or_do_not_fit_them_are_refused(parent, words, sentence):
    result = CliRunner().invoke(app, ["polish", str(parent.folder), *words])
    assert isinstance(result.exception, ConfigError)
    assert sentence in str(result.exception)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"goal_places": {"left": (0.1, 0.2)}}, "tuples of finite numbers, 1 in each"),
        ({"goal_places": ["left"]}, "is not a mapping"),
        ({"goal_places": {"up": (0.1,)}}, "goal_places has up, which the option goal cannot be"),
        ({"options": {}}, "goal_places has left, right, which the option goal cannot be"),
        ({"goal_radius": 0.0}, "goal_places needs goal_radius"),
        ({"goal_radius": float("nan")}, "goal_radius = nan is not a finite number"),
    ],
)
def test_goals_that_a_class_declares_wrongly_are_refused(changes, sentence):
    task = type("Wrong", (Line,), changes)
    assert any(sentence in problem for problem in wrong_values(task, task.descriptor_names, task.descriptor_bounds, ()))
    assert not wrong_values(Line, Line.descriptor_names, Line.descriptor_bounds, ())


def test_a_maze_s_goal_is_drawn_where_the_option_says():
    config = {"task": {"environment": "ant_u_maze", "options": {"goal": "3-1"}}, "search": {"algorithm": "es"},
              "budget": {"generations": 1}}  # fmt: skip
    assert task_of(load_config(config)).goal == (12.0, 4.0)
    assert task_of(load_config(config, ["task.options.goal=drawn"])).goal is None
