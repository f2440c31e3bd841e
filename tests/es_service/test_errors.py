"""What an error knows is there as data; the command line makes commands of it, `str` Python calls."""

from __future__ import annotations

import numpy as np
import pytest

from es_service import api
from es_service.cli.common import error_message, way_command
from es_service.config.given import parse_overrides
from es_service.errors import ConfigError, EvaluationError, StoreError, WayOut
from tests.system.session import SMALL

pytestmark = pytest.mark.usefixtures("workers_here")

WAYS = (
    (WayOut("resume", "x", "a b"), "resume('a b')", "resume 'a b'"),
    (
        WayOut("fork", "x", "runs/a", {"search.sigma": 0.5, "budget.generations": None}),
        "fork('runs/a', {'search.sigma': 0.5, 'budget.generations': None})",
        "fork runs/a --set search.sigma=0.5 --set budget.generations=null",
    ),
    (WayOut("run", "x", out="runs/b"), "run(config, 'runs/b')", "run CONFIG --out runs/b"),
    (
        WayOut("run", "x", settings={"search.init_from": "runs/a"}),
        "run(load_config(config, {'search.init_from': 'runs/a'}))",
        "run CONFIG --set search.init_from=runs/a",
    ),
    (
        WayOut("run", "x", settings={"seed": 1}, config="a b.yaml", out="runs/b"),
        "run(load_config('a b.yaml', {'seed': 1}), 'runs/b')",
        "run 'a b.yaml' --out runs/b --set seed=1",
    ),
    (
        WayOut("fork", "x", "runs/a", {"seed": 1}, generation=0, out="runs/b"),
        "fork('runs/a', {'seed': 1}, generation=0, out='runs/b')",
        "fork runs/a --generation 0 --out runs/b --set seed=1",
    ),
    (WayOut("watch", "x", "runs/a"), "open_run('runs/a')", "status runs/a --follow"),
    (
        WayOut("resume", "x", "runs/a", {"compute.engine": "inline", "compute.address": None, "compute.workers": 2}),
        "resume('runs/a', {'compute.engine': 'inline', 'compute.address': None, 'compute.workers': 2})",
        "resume runs/a --engine inline --set compute.workers=2",
    ),
)


@pytest.mark.parametrize(("way", "call", "command"), WAYS)
def test_a_way_out_is_a_call_and_a_command(way, call, command):
    error = StoreError("runs/a is no run", ways_out=[way])
    assert (error.way_out, error.sentence) == (way, "runs/a is no run")
    assert str(error) == f"runs/a is no run\n  to x: {call}"
    assert error_message(error) == f"runs/a is no run\n  to x: es-service {command}"


def test_a_long_value_is_whole_in_a_command():
    widths = list(range(100, 140))
    assert way_command(WayOut("resume", "x", "r", {"policy.hidden": widths})).endswith(f"'policy.hidden={widths}'")


def test_overrides_by_key_are_those_in_text():
    values = {"search.sigma": 1e-7, "policy.hidden": [64, 64], "budget.env_steps": None, "task.options.start": "off",
              "search.init_from": "two  spaces/a: b\u2028"}  # fmt: skip
    assert parse_overrides(values) == (values, [])
    found, (problem,) = parse_overrides(["search.sigma"])
    assert (found, problem.sentence) == ({}, "override search.sigma: write KEY=VALUE, such as search.sigma=0.05")


def test_every_problem_of_a_config_is_there_as_data():
    wrong = {"search.pairs": 0, "task.fitness": "finl", "search.sgma": 1}
    with pytest.raises(ConfigError) as caught:
        api.load_config(SMALL, wrong)
    found = {problem.field: problem for problem in caught.value.problems}
    assert found.keys() == wrong.keys()
    assert (found["search.pairs"].value, found["search.pairs"].allowed) == (0, "a whole number from 1 to 16,777,216")
    assert (found["task.fitness"].allowed, found["task.fitness"].suggestion) == ("sum or final", "final")
    assert found["search.sgma"].suggestion == "search.sigma"
    first = caught.value.problems[0]
    assert (caught.value.field, caught.value.suggestion) == (first.field, first.suggestion)
    assert all(problem.sentence in str(caught.value) for problem in caught.value.problems)


def test_an_error_of_the_rollouts_names_its_run_and_can_be_acted_on(tmp_path):
    config = SMALL | {"budget": {"generations": 3}}
    with np.errstate(all="ignore"), pytest.raises(EvaluationError, match="centre is not finite") as caught:
        api.run(api.load_config(config, {"search.step.learning_rate": 1e38, "search.step.l2": 1e38}), tmp_path / "run")
    error = caught.value
    fork, resume = error.ways_out
    assert (error.field, error.run) == ("search.step.learning_rate", str(tmp_path / "run"))
    assert (fork.action, fork.run, resume.action, resume.run) == ("fork", error.run, "resume", error.run)
    assert fork.settings == {"search.step.learning_rate": pytest.approx(1e37)}
    forked = api.fork(
        fork.run, {**fork.settings, "search.step.learning_rate": 0.01, "search.step.l2": 0.0}, out=tmp_path / "fork"
    )
    assert forked.run.generation == 3


def test_a_missing_cell_suggests_the_nearest(tmp_path):
    config = SMALL | {"budget": {"generations": 1}, "map": {"cells": [3, 3]}}
    run = api.run(config, tmp_path / "run").run
    [cell] = {tuple(place) for place in run.map[[name for name in run.map if name.startswith("cell_")]].to_numpy()[:1]}
    empty = next((i, j) for i in range(3) for j in range(3) if run.behaviour_map.row_of(3 * i + j) is None)
    with pytest.raises(LookupError, match="is empty; the nearest filled cell is") as caught:
        run.elite(empty)
    assert (caught.value.field, caught.value.value) == ("cell", empty)
    assert run.elite(caught.value.suggestion).parameters_D.shape == run.elite(cell).parameters_D.shape
