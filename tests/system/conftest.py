"""Runs that several tests begin with."""

from __future__ import annotations

import os

import pytest
import yaml

from tests.system.command_line import es
from tests.system.me_es_runs import run
from tests.system.session import SMALL


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A finished run of thirty generations, for reading only: `resume` writes its config.yaml anew."""
    folder = tmp_path_factory.mktemp("finished")
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    # As in `make run`: es-service is not in PATH.
    code, printed = es("run", path, "--out", folder / "run", PATH=os.defpath)
    assert code == 0, printed
    return folder / "run", printed


@pytest.fixture(scope="session")
def mapped(tmp_path_factory):
    """A finished run of ME-ES, for reading only."""
    from tests.helpers import workers_in_this_process  # imports JAX

    with workers_in_this_process():
        return run(tmp_path_factory.mktemp("me_es") / "run")
