"""The runs of sbx's learners: they go on from their checkpoints as if nothing had happened."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sbx", reason="sbx-rl is not installed: tests.learners.environment")

from tests.benchmarks.baselines.programs import SYSTEMS
from tests.benchmarks.baselines.rows import COLUMNS, read
from tests.benchmarks.baselines.run import SIZES
from tests.benchmarks.baselines.sbx_run import SbxRun
from tests.benchmarks.baselines.sbx_systems import SYSTEMS as OF_SBX


def actions(run: SbxRun) -> np.ndarray:
    observations = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    return run.learner.predict(observations, deterministic=True)[0]


def test_the_runner_knows_the_tasks_and_the_systems():
    assert [name for name, one in SYSTEMS.items() if one.environment == "learners"] == [*OF_SBX]
    assert all(one.updates / one.environments == 1 / 16 for one in SIZES.values())


@pytest.mark.parametrize("system", OF_SBX)
def test_a_run_that_was_stopped_learns_the_same(tmp_path, system):
    def begun(name: str) -> SbxRun:
        run = SbxRun("point_maze", system, 3, tmp_path / name, buffer=10_000)
        run.chunk = 1_600
        return run

    whole = begun("whole")
    whole.work(3_200, 1e9)
    stopped = begun("stopped")
    stopped.work(1_600, 1e9)
    stopped.keep()
    again = begun("stopped")
    assert (again.steps, again.cpu_seconds > stopped.cpu_seconds * 0.5) == (1_600, True)
    assert actions(again).tobytes() == actions(stopped).tobytes()
    again.work(3_200, 1e9)
    assert actions(whole).tobytes() != actions(stopped).tobytes()
    assert actions(again).tobytes() == actions(whole).tobytes()
    again.keep()
    assert len([*(tmp_path / "stopped").glob("at-*")]) == 1


def test_the_runner_writes_a_row_and_goes_on(tmp_path):
    def ran(steps: int) -> dict:
        words = ["--tasks", "point_maze", "--systems", "td3", "--steps", str(steps), "--folder", str(tmp_path / "runs")]
        command = [sys.executable, "-m", "tests.benchmarks.baselines", *words, "--results", str(tmp_path / "table.csv")]
        environment = ["--environments", str(Path(sys.prefix).parent)]
        subprocess.run([*command, *environment], check=True)
        [row] = read(tmp_path / "table.csv")
        return row

    first = ran(1_024)
    assert tuple(first) == COLUMNS
    assert (first["steps"], first["is_finished"], first["episodes"]) == (1_024, True, 256)
    second = ran(2_048)
    assert second["steps"] == 2_048
    assert second["cpu_seconds"] > first["cpu_seconds"]
    assert json.dumps(first["network"]) == '"64x64"'
