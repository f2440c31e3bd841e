"""Runs of older versions are read, and resumed with a word about it."""

from __future__ import annotations

import shutil
from pathlib import Path

from es_service import api

FOLDER = Path(__file__).parent / "golden" / "run_0_5"
"""Five generations of ME-ES on PointMaze, made by version 0.5.0: 16 pairs, 20 steps, 4 hidden units, 4 x 4 cells."""
DIGEST = "020b2f136f7a4b9c02ec27ff608f70787f75ad2e561978360e22272601aaacb0"
"""What `digest` of 0.5.0 said of it."""


def test_a_run_of_0_5_is_read_and_resumed(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(FOLDER, folder)
    run = api.open_run(folder)
    assert (run.generation, run.digest()) == (5, DIGEST)
    assert len(run.history) == 6
    assert len(run.map) > 1
    assert run.policy("best")([0.0, 0.0]).shape == (2,)
    notices: list[str] = []
    resumed = api.resume(folder, {"budget.generations": 6}, on_notice=notices.append).run
    assert resumed.generation == 6
    (notice,) = notices
    assert "from generation 6 on this run has another platform" in notice
