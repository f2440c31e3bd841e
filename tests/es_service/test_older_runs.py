"""Runs of older versions are refused with one line that names the version that reads them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from es_service import api
from es_service.errors import StoreError
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
