"""The trunk's promises on physics: any number of workers and a lost one give the same bits on both ant tasks."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from es_service import api
from es_service.store.digest import digest_parts
from tests.benchmarks import ants
from tests.helpers import workers_in_this_process
from tests.system.processes import children


def run(folder: Path, environment: str, workers: int, on_generation=lambda row: None, on_notice=pytest.fail):
    config = {
        "task": {"environment": environment, "episode_steps": 200},
        "policy": {"hidden": [64, 64]},
        "search": {"algorithm": "nsra_es", "pairs": 32, "evaluation_episodes": 4, "centres": 2},
        "budget": {"generations": 4},
        "compute": {
            "engine": "inline",
            "workers": workers,
            "chunk_pairs": 2,
            "gradient_block_pairs": 4,
            "chunk_timeout_s": 60,
        },
    }
    return api.run(api.load_config(config), folder, on_generation=on_generation, on_notice=on_notice)


@pytest.mark.long
@pytest.mark.parametrize("environment", ["ant_maze", "ant_trap"])
def test_one_worker_and_two_of_which_one_is_killed(tmp_path, environment):
    with workers_in_this_process():
        run(tmp_path / "one", environment, 1)
    notices = []

    def strike(row):
        if row["generation"] == 2:
            os.kill(children()[-1], signal.SIGKILL)

    outcome = run(tmp_path / "two", environment, 2, strike, notices.append)
    assert len(notices) == 1
    history = outcome.run.history
    assert history["lost_workers"].sum() == 1
    assert history["centre_return_mean"].notna().all()
    assert ("goal_distance" in history) == (environment == "ant_maze")
    assert digest_parts(tmp_path / "two") == digest_parts(tmp_path / "one")
    ants.main([str(tmp_path / "one"), str(tmp_path / "two"), "--to", str(tmp_path / "tables")])
    assert {file.name for file in (tmp_path / "tables").iterdir()} == {"ants.csv", "ants_curves.csv", "ants.png"}


def test_runs_of_a_reader_do_not_take_the_place_of_the_measured_ones(capsys):
    with pytest.raises(SystemExit, match="2"):
        ants.main(["RUN"])
    assert "the following arguments are required: --to" in capsys.readouterr().err
