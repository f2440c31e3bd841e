"""A whole method in one file: a key, an array and a map of its own, with which a run does all that runs do."""

from __future__ import annotations

import sys

import pytest

from es_service import api, write_comparison, write_report
from es_service.cli.common import text_console
from es_service.cli.status import print_status, print_summary
from es_service.errors import ConfigError
from es_service.runs.export import export
from es_service.runs.verification import verify

pytestmark = pytest.mark.usefixtures("workers_here")

METHOD = '''\
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from es_service.config.search import PopulationConfig
from es_service.search.algorithms.base import from_elite
from es_service.search.algorithms.common import novelty_search
from es_service.search.algorithms.method import method
from es_service.search.algorithms.settings import settings_of


class RestlessSettings(PopulationConfig):
    patience: int = Field(3, ge=1, description="Generations after which the centre begins again.")
    only_centres: ClassVar = 1
    needs_map: ClassVar = "whose centre begins again from the fittest elite"


@method(RestlessSettings)
def restless(config):
    """ES whose centre begins again from the fittest elite."""
    shared, patience = novelty_search(config, fitness_weight=1.0), settings_of(config, RestlessSettings).patience

    def start_cells(state, generation):
        return {} if generation % patience else {0: int(state.map.cell_N[state.map.fitness_N.argmax()])}

    def restart(state, index, cell, elite):
        return replace(from_elite(state, index, cell, elite), extra={"restarts": state.extra["restarts"] + 1})

    return replace(shared, start_cells=start_cells, restart=restart, extra={"restarts": np.zeros(1, np.int64)},
                   metrics={"restarts": lambda state: float(state.extra["restarts"][0])})
'''
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "restless_method:restless", "pairs": 16, "sigma": 0.2, "evaluation_episodes": 2},
    "budget": {"generations": 8},
    "compute": {"engine": "inline", "workers": 1},
}


@pytest.fixture(autouse=True)
def written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "restless_method.py").write_text(METHOD)


def restarts(run) -> int:
    return int(run.at().nodes["extra"]["restarts"][0])


def test_its_declarations_are_those_of_the_service(tmp_path):
    assert api.load_config(CONFIG).search.model_dump().items() >= {"patience": 3, "centres": 1}.items()
    with pytest.raises(ConfigError) as caught:
        api.load_config(CONFIG, ["search.patience=0", "search.centres=2", "map.enabled=false", "search.batch=9"])
    assert [problem.sentence for problem in caught.value.problems] == [
        "search.batch: 9 has no effect with restless_method:restless; leave it out (a key of map_elites)",
        "search.patience: 0 is not allowed; must be a whole number, at least 1",
        "search.centres: 2 is not allowed for restless_method:restless, which has one centre; must be 1 or auto",
        "map.enabled: false is not allowed for restless_method:restless, whose centre begins again from the fittest "
        "elite; must be true",
    ]


def test_a_metric_has_the_name_of_a_column(tmp_path):
    (tmp_path / "restless_method.py").write_text(METHOD.replace('{"restarts": lambda', '{"Re starts": lambda'))
    with pytest.raises(ConfigError, match="has a metric 'Re starts'; its name must be"):
        api.run(api.load_config(CONFIG), tmp_path / "run")


@pytest.mark.parametrize("reads", ["'last_action',", "'last_reward', 'height'"])
def test_an_output_of_episodes_that_there_is_not_is_refused_before_a_run_begins(tmp_path, reads):
    declared = f"only_centres: ClassVar = 1\n    outputs = lambda self: ({reads})\n"
    (tmp_path / "restless_method.py").write_text(METHOD.replace("only_centres: ClassVar = 1\n", declared))
    what = r"restless_method:restless reads the output '(last_action|height)', which no episode of point_maze has"
    choices = "choose first_observation, last_observation, last_reward or success"
    with pytest.raises(ConfigError, match=rf"search\.algorithm: {what}; {choices}"):
        api.load_config(CONFIG)


def test_its_runs_are_resumed_forked_verified_reported_and_exported(tmp_path, capsys):
    whole = api.run(api.load_config(CONFIG), tmp_path / "whole").run
    assert (restarts(whole), whole.constants["search.patience"]) == (2, 3)
    assert whole.history.metric_restarts.tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0]
    part = api.run(api.load_config(CONFIG, ["budget.generations=4"]), tmp_path / "part").run
    fork = api.fork(part.folder, ["search.patience=2", "budget.generations=8"], out=tmp_path / "fork").run
    resumed = api.resume(part.folder, ["budget.generations=8"]).run
    assert (restarts(fork), restarts(resumed)) == (3, 2)
    assert fork.digest() != resumed.digest() == whole.digest()
    assert not any(checked.differences for checked in verify(whole))
    write_report(whole.folder, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "search.patience" in page
    assert "Metric of the search, of the task" in page
    write_comparison([whole.folder, fork.folder], tmp_path / "both.html", statistics=tmp_path / "both.json")
    assert "metric_restarts" in (tmp_path / "both.json").read_text()
    assert {file.name for file in export(whole, "npz", tmp_path / "export")} >= {"policies.npz"}
    print_status(text_console(), whole)
    print_summary(text_console(), whole, "the budget is spent")
    shown = capsys.readouterr().out
    assert "restless_method:restless, 16 pairs, seed 0" in shown
    assert "search.sigma=0.4" in shown
