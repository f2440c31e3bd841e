"""Metrics of one's own: numbers that a task, a config or the program that runs a session records."""

from __future__ import annotations

import json
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from es_service import Stop, api, ask_tell, write_comparison, write_report
from es_service.errors import ConfigError, StoreError
from es_service.protocol.messages import HostChoices
from es_service.report.data import read_run
from es_service.report.series import charts
from es_service.runs.export import export
from es_service.runs.tracking import TensorBoard, tracked
from es_service.store.folder import DATABASE
from es_service.store.reader import read_history
from es_service.store.writer import RunStore
from workers.environments import TaskError, describe_environment, make_function_task, make_host_task
from workers.environments.host_task import HostEnvironment

pytestmark = pytest.mark.usefixtures("workers_here")

TASKS = '''\
import jax.numpy as jnp


class Walk:
    """a point walks"""

    observation_size, action_size, episode_steps = 2, 2, 6
    descriptor_names, descriptor_bounds = ("x", "y"), ((-1.0, 1.0), (-1.0, 1.0))
    metric_names = ("twice_x", "steps", "nothing")

    def reset(self, key):
        return jnp.zeros(3)

    def observe(self, state):
        return state[:2]

    def step(self, state, action):
        after = state + jnp.concatenate([0.1 * action, jnp.ones(1)])
        return after, -jnp.sum(after[:2] ** 2), after[2] > 4.0

    def descriptor(self, state):
        return state[:2]

    def metrics(self, state):
        return jnp.stack([2.0 * state[0], state[2], jnp.nan])


class Crooked(Walk):
    def metrics(self, state):
        return state[:2]


class Nameless(Walk):
    metric_names = ("twice x",)


class Python:
    """a point walks in Python, whose info counts"""

    observation_size, action_size, episode_steps = 1, 1, 4
    metric_names = ("seen",)

    def reset(self, seed):
        self.steps = 0
        return [0.5]

    def step(self, action):
        self.steps += 1
        return [0.5], 1.0, False, False, {"number": [3.0, -1.0, 7.0, 2.0][self.steps - 1], "late": 1.0}

    def metrics(self):
        return [10.0 * self.steps]


def bowl(parameters):
    return -float(parameters @ parameters), [float(parameters[0]), 5.0]


bowl.parameters = 3
bowl.metric_names = ("first", "five")
'''
CONFIG = {
    "task": {"environment": "metric_tasks:Walk"},
    "policy": {"hidden": []},
    "search": {"algorithm": "me_es", "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
}


@pytest.fixture(autouse=True)
def written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "metric_tasks.py").write_text(TASKS)


def changed(**task):
    return CONFIG | {"task": task}


@pytest.mark.parametrize(
    "rollout", [pytest.param("simd", marks=pytest.mark.slow), pytest.param("xla", marks=pytest.mark.long)]
)
def test_a_task_in_jax_records_numbers_of_its_episodes(tmp_path, rollout):
    run = api.run(api.load_config(CONFIG, [f"compute.rollout={rollout}"]), tmp_path / "run").run
    history, evaluated = run.history, run.evaluations
    assert history.metric_twice_x.tolist() == (2.0 * history.centre_x).tolist() != [0.0] * 4
    assert history.metric_steps.tolist() == [5.0] * 4  # it is done there, and later steps do not count
    assert history.metric_nothing.isna().all()
    assert evaluated.metric_twice_x.tolist() == (2.0 * evaluated.x).tolist()


@pytest.mark.slow
def test_a_task_of_python_objects_records_its_own_and_those_of_its_info(tmp_path):
    config = api.load_config(changed(environment="python:metric_tasks:Python", metrics=["number:sum", "absent"]))
    notices: list[str] = []
    row = api.run(config, tmp_path / "run", on_notice=notices.append).run.history_rows()[-1]
    assert (row["metric_number"], row["metric_seen"]) == (11.0, 40.0)
    assert np.isnan(row["metric_absent"])
    assert "without absent, this metric has no value" in notices[0]


@pytest.mark.parametrize(
    ("taken", "value"), [("", 2.0), (":last", 2.0), (":sum", 11.0), (":mean", 2.75), (":min", -1.0), (":max", 7.0)]
)
def test_a_metric_of_info_is_made_of_the_values_of_one_episode(taken, value):
    chosen = HostChoices(metrics=(f"number{taken}",))
    environment = HostEnvironment(make_host_task("python:metric_tasks:Python", {}, chosen))
    for _ in range(2):
        environment.reset(0)
        for _ in range(4):
            environment.step([0.0])
        assert environment.metrics().tolist() == [40.0, value]


def test_a_function_returns_its_metrics_at_the_end():
    task = make_function_task("function:metric_tasks:bowl", {})
    fitness, descriptor_B, metrics_M = task(np.array([1.0, 2.0, 0.0], np.float32), 0)
    assert (fitness, descriptor_B.tolist(), metrics_M.tolist()) == (-5.0, [1.0, 2.0], [1.0, 5.0])
    with pytest.raises(TaskError, match=r"returned -0.0; it must return \(fitness, metrics\)"):
        replace(task, call=lambda point: -0.0)(np.zeros(3, np.float32), 0)


@pytest.mark.long
def test_a_function_records_what_it_returns_at_the_end(tmp_path):
    more = ["search.evaluation_episodes=1", "search.algorithm=es", "map.enabled=false"]
    config = api.load_config(changed(environment="function:metric_tasks:bowl"), more)
    history = api.run(config, tmp_path / "run").run.history
    assert history.metric_first.tolist() == history.centre_x0.tolist()
    assert history.metric_five.tolist() == [5.0] * 4


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("metric_tasks:Crooked", r"metrics has the shape \(2,\), not \(3,\)"),
        ("metric_tasks:Nameless", "metric_names has 'twice x'; each name must be different and of up to 40 letters"),
        ("python:metric_tasks:Python", "task.metrics = .*metrics of .* would be named 'seen'"),
    ],
)
def test_a_wrong_metric_of_a_task_is_refused_by_name(task, message):
    with pytest.raises(TaskError, match=message):
        describe_environment(task, {"metrics": ["seen"]})


def test_a_config_that_chooses_metrics_of_info_has_objects_and_says_how():
    with pytest.raises(ConfigError, match=r"task.metrics: \[x\] is not allowed for point_maze.*; must be \[\]"):
        api.load_config(changed(environment="point_maze", metrics=["x"]))
    with pytest.raises(ConfigError, match=r"task.metrics: .*must be a list of keys of info, such as"):
        api.load_config(changed(environment="point_maze", metrics=["number:median"]))


SMALL = {**CONFIG, "task": {"environment": "point_maze", "episode_steps": 10}}


def noting(row):
    """Numbers of every second generation."""
    generation = row["generation"]
    return {"loss": 0.5 * generation, "Best": np.float32(2.0), "none": None} if generation % 2 == 0 else None


def test_a_program_records_numbers_of_each_generation(tmp_path):
    plain = api.run(SMALL, tmp_path / "plain").run
    first = api.run(api.load_config(SMALL, ["budget.generations=1"]), tmp_path / "run", on_generation=noting).run
    assert first.history.metric_loss.fillna(-1.0).tolist() == [0.0, -1.0]
    run = api.resume(first.folder, ["budget.generations=3"], on_generation=noting).run
    assert run.history.metric_loss.fillna(-1.0).tolist() == [0.0, -1.0, 1.0, -1.0]
    assert run.history.metric_Best.fillna(-1.0).tolist() == [2.0, -1.0, 2.0, -1.0]
    assert "metric_none" not in run.history
    assert run.digest() == plain.digest(), "what a program records is no part of it"
    assert [row.get("metric_loss") for row in read_history(run.folder, 1, 2)] == [None, 1.0]
    export(run, "csv", tmp_path / "export")
    assert "metric_loss" in (tmp_path / "export" / "history.csv").read_text()
    fork = api.fork(run.folder, ["budget.generations=4"], generation=2, out=tmp_path / "fork").run
    assert fork.history.metric_loss.fillna(-1.0).tolist() == [0.0, -1.0, 1.0, -1.0, -1.0]


@pytest.mark.slow
def test_a_fork_may_have_a_column_with_the_name_of_a_recorded_metric(tmp_path):
    """The column has no value before the fork; what was recorded under another name stays."""
    config = api.load_config(changed(environment="python:metric_tasks:Python"), ["budget.generations=1"])
    record = lambda row: {"number": 1.0, "loss": 2.0} if row["generation"] else {"number": 3.0}  # noqa: E731
    run = api.run(config, tmp_path / "run", on_generation=record).run
    assert run.history.metric_number.tolist() == [3.0, 1.0]
    fork = api.fork(run.folder, ["task.metrics=[number:sum]", "budget.generations=2"], out=tmp_path / "fork").run
    assert fork.history.metric_number.fillna(-1.0).tolist() == [-1.0, -1.0, 11.0]
    assert fork.history.metric_loss.fillna(-1.0).tolist() == [-1.0, 2.0, -1.0]
    assert fork.map.generation.min() <= 1, "what is recorded changes no fitness, so elites stay"


def test_what_a_program_records_is_a_curve_and_a_measure_of_groups(tmp_path):
    folders = []
    for group, sigma in enumerate((0.1, 0.2)):
        for seed in range(2):
            config = api.load_config(SMALL, [f"search.sigma={sigma}", f"seed={seed}"])
            record = lambda row, value=10.0 * group + seed: {"loss": value} if row["generation"] == 2 else {}  # noqa: E731
            folders.append(api.run(config, tmp_path / f"{sigma}_{seed}", on_generation=record).run.folder)
    write_report(folders[0], tmp_path / "report.html")
    assert "of the program that ran the session" in (tmp_path / "report.html").read_text()
    alone = read_run(folders[0])
    [curve] = [chart for chart in charts(alone.history, alone.centres, 0.0) if chart.title == "loss"]
    np.testing.assert_array_equal(curve.lines[0].y_K, [np.nan, np.nan, 0.0, np.nan])  # no value is no point
    write_comparison(folders, tmp_path / "both.html", statistics=tmp_path / "both.json")
    [loss] = [one for one in json.loads((tmp_path / "both.json").read_text()) if one["name"] == "metric_loss"]
    assert [average["median"] for average in loss["averages"]] == [0.5, 10.5], "a value holds until the next one"
    assert loss["pairs"][0]["difference"]["improvement"] == 0.0


def test_a_tracker_gets_each_row_with_the_metrics_of_its_generation(tmp_path):
    folder = tmp_path / "run"
    with tracked(folder, ["tensorboard"], pytest.fail) as send:
        run = api.run(SMALL, folder, on_generation=lambda row: send(row) or noting(row)).run
    [file] = TensorBoard(run).files()
    text = file.read_bytes()
    assert text.count(b"metric_loss") == text.count(b"metric_Best") == 2
    assert text.count(b"best_fitness") == 4


def test_a_request_to_stop_may_have_metrics(tmp_path):
    run = api.run(SMALL, tmp_path / "run", on_generation=lambda row: Stop("enough", {"loss": 3.0})).run
    assert run.history.metric_loss.tolist() == [3.0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"a b": 1.0}, "on_generation: a metric is named 'a b'; its name must be of up to 40 letters"),
        ({"steps": 1.0}, "a metric is named 'steps'; .* no metric of the search or of the task may have it"),
        ({"loss": "low"}, "on_generation: the metric loss is 'low'; it must be a number"),
    ],
)
def test_a_wrong_metric_of_a_program_ends_the_session_and_names_it(tmp_path, given, message):
    with pytest.raises(ConfigError, match=message):
        api.run(CONFIG, tmp_path / "run", on_generation=lambda row: given)
    assert api.open_run(tmp_path / "run").generation == 0


def asks_and_tells(folder):
    """The run of a caller who records the number of each generation."""
    config = changed(environment="caller", options={"parameters": 3}) | {"map": {"enabled": False}}
    config |= {"search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 1}}
    with ask_tell(config, folder) as search:
        while (asked := search.ask()) is not None:
            generation = float(asked.token.generation)
            search.tell(asked, -np.square(asked.parameters).sum(axis=1), metrics={"loss": generation})
        return search.run


def test_who_asks_and_tells_records_numbers_of_the_generation(tmp_path):
    history = asks_and_tells(tmp_path / "run").history
    assert history.metric_loss.tolist() == history.index.tolist() == [0, 1, 2, 3]


KILLED_AFTER_A_COMMIT = """
import os, signal, sys
from pathlib import Path
from es_service.store.writer import RunStore
from tests.es_service.test_metrics import asks_and_tells

commit = RunStore.commit

def and_die(store, generations):
    commit(store, generations)
    if [one.number for one in generations] == [2]:
        os.kill(os.getpid(), signal.SIGKILL)

RunStore.commit = and_die
asks_and_tells(Path(sys.argv[1]))
"""


@pytest.mark.slow
def test_what_a_caller_tells_is_in_the_transaction_of_its_generation(tmp_path):
    ended = subprocess.run([sys.executable, "-c", KILLED_AFTER_A_COMMIT, tmp_path / "run"], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert [row["metric_loss"] for row in read_history(tmp_path / "run")] == [0.0, 1.0, 2.0]
    run = asks_and_tells(tmp_path / "run")
    assert run.history.metric_loss.tolist() == [0, 1, 2, 3]
    assert run.digest() == asks_and_tells(tmp_path / "whole").digest()


@pytest.mark.parametrize("damage", ["'{\"loss\": 9.0}'", "CAST(X'FF' AS TEXT)"])
def test_damaged_metrics_are_refused_and_deleted_when_the_run_goes_on(tmp_path, damage):
    folder = api.run(SMALL, tmp_path / "run", on_generation=noting).run.folder
    with closing(sqlite3.connect(folder / DATABASE)) as connection, connection:
        connection.execute(f"UPDATE metric SET named = {damage} WHERE generation = 2")
    with pytest.raises(StoreError, match="the metrics recorded at generation 2 are damaged"):
        read_history(folder)
    write_report(folder, tmp_path / "report.html")
    assert "the metrics recorded at generations 2 are damaged" in (tmp_path / "report.html").read_text()
    with RunStore.open(folder) as store:
        assert "the metrics recorded at generation 2 are damaged" in store.notices[0]
    assert [row.get("metric_loss") for row in read_history(folder)] == [0.0, None, None, None]


def test_an_older_version_is_told_to_upgrade(tmp_path):
    folder = api.run(SMALL, tmp_path / "run", on_generation=noting).run.folder
    with closing(sqlite3.connect(folder / DATABASE)) as connection:
        assert connection.execute("SELECT value FROM meta WHERE key = 'schema_version'").fetchone() == ("9",)
