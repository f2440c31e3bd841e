"""The tutorial: the notebook is its text, its cells run, and what it tells of them is true."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from es_service.cli.main import app
from tests.examples import tutorial

pytestmark = pytest.mark.usefixtures("noticed")  # on a busy machine, certifying says that it compiles


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Function that runs cells in a folder of their own, with a number of environment steps for a million, and returns
    what they have named."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def read(million: int, without: tuple[str, ...] = ()) -> dict:
        names: dict = {}
        for kind, source in tutorial.cells():
            if kind == "markdown" or any(word in source for word in without):
                continue
            if kind == "bash":
                result = CliRunner().invoke(app, shlex.split(source)[1:])
                assert result.exit_code == 0, result.output
            else:
                assert "MILLION = " not in source or "MILLION = 1_000_000" in source
                exec(source.replace("MILLION = 1_000_000", f"MILLION = {million}"), names)
        return names

    return read


def test_the_notebook_is_the_text():
    assert tutorial.NOTEBOOK.read_text() == tutorial.notebook(), "python -m tests.examples.tutorial"


@pytest.mark.slow
@pytest.mark.usefixtures("one_process")
def test_its_cells_run_but_for_the_sweep(read):
    names = read(40_000, without=("sweep",))
    assert len(names["returns"]) == 256
    assert Path("runs/first/report.html").exists()
    certified = names["polished"].certified.iloc[-1]
    assert names["returns"].mean() == pytest.approx(certified.return_mean, rel=0.1)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_what_it_tells_is_true(read):
    names = read(1_000_000)
    first, polished = (names[name].certified.iloc[-1] for name in ("first", "polished"))
    assert first.stored_fitness > first.return_high
    assert polished.return_mean > first.return_mean
    assert names["difference"]["p"] == pytest.approx(0.0079, abs=1e-4)
    assert polished.return_low - 1 < names["returns"].mean() < polished.return_high + 1
