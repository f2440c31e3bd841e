"""Runs as the trials of Ray Tune, which ends them by `sys.exit` inside of `on_generation`."""

from __future__ import annotations

import os
import signal
import sys

import pytest

from es_service import open_run
from es_service.runs.run_status import read_status
from tests.system.processes import running, wait_until

STUDY = """
import sys
from pathlib import Path

import ray
from ray import tune

from es_service import run
from tests.system.session import SMALL


TRIALS = Path(sys.argv[1])


def trial(settings):
    def told(row):
        tune.report({"fitness": row["centre_fitness_mean"]})

    given = SMALL | {"seed": settings["seed"], "budget": {"generations": 100000}}
    run(given, TRIALS / str(settings["seed"]), on_generation=told)


ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
tune.Tuner(
    trial,
    param_space={"seed": tune.grid_search(list(range(9)))},
    tune_config=tune.TuneConfig(max_concurrent_trials=1),
    run_config=tune.RunConfig(stop={"training_iteration": 4}, storage_path=sys.argv[2]),
).fit()
"""


@pytest.mark.long
def test_ctrl_c_ends_a_study_and_a_trial_that_it_has_ended_says_so(tmp_path):
    trials, study = tmp_path / "trials", tmp_path / "study.py"
    study.write_text(STUDY)
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "RAY_USAGE_STATS_ENABLED": "0"}
    with running(sys.executable, study, trials, tmp_path / "results", env=environment) as process:
        wait_until(process, (trials / "1" / "run.db").exists)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    assert "has been interrupted" in errors
    assert {folder.name for folder in trials.iterdir()} <= {"0", "1", "2"}
    ended = read_status(open_run(trials / "0")).end
    assert ended == "the program that ran it has ended it with sys.exit(0), as tuners end their trials"
