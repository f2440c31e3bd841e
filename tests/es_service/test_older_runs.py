"""Runs of older versions go on, or are refused with one line that names the version that reads them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from es_service import api
from es_service.errors import StoreError
from es_service.loop.history import evaluated_columns
from es_service.report.write import write_report
from es_service.runs import checked_config
from tests.system.command_line import command

pytestmark = pytest.mark.usefixtures("workers_here")

FOLDER = Path(__file__).parent / "golden" / "run_0_5"
"""Five generations of ME-ES on PointMaze, made by version 0.5.0."""


def test_a_run_of_0_5_is_refused_and_left_alone(tmp_path):
    folder = shutil.copytree(FOLDER, tmp_path / "run")
    before = (folder / "run.db").read_bytes()
    for use in (api.open_run, api.resume, api.fork):
        with pytest.raises(StoreError, match=r"run\.db was written by an older version .*; use version 0\.5\.0 to"):
            use(folder)
    printed = command("status", folder)
    assert printed.returncode == 1
    assert printed.stderr.count("\n") == 1
    assert (folder / "run.db").read_bytes() == before


def test_a_run_without_the_columns_that_came_later_goes_on_and_its_page_says_what_is_missing(tmp_path, monkeypatch):
    """Version 0.11 did not store which episodes an evaluation consisted of."""
    given = {
        "task": {"environment": "point_maze", "episode_steps": 20},
        "policy": {"hidden": [8]},
        "search": {"algorithm": "map_elites", "batch": 8, "centres": 2},
        "map": {"cells": [8, 8]},
        "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
    }

    def older(*arguments):
        return tuple(column for column in evaluated_columns(*arguments) if column.deterministic)

    with monkeypatch.context() as then:
        then.setattr(checked_config, "evaluated_columns", older)
        api.run(given | {"budget": {"generations": 2}}, tmp_path / "older")
    resumed = api.resume(tmp_path / "older", ["budget.generations=3"]).run
    whole = api.run(given | {"budget": {"generations": 3}}, tmp_path / "newer").run
    assert resumed.digest() == whole.digest()
    missing = set(whole.evaluations.columns) - set(resumed.evaluations.columns)
    assert missing == {"fitness_first", "reset_seed", "reset_episode", "reset_ask", "reset_policy"}
    [page] = write_report(tmp_path / "older")
    assert "does not have the address of this policy&#x27;s evaluation episodes" in page.read_text()
    forked = api.fork(tmp_path / "older", ["budget.generations=4"], out=tmp_path / "fork").run
    assert forked.evaluations.query("generation < 4")["reset_seed"].isna().all()
    assert (forked.evaluations.query("generation == 4")["reset_seed"] == 0).all()
