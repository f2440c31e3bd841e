"""What `status`, and a session at its end, say of a run."""

from __future__ import annotations

import pytest
from rich.console import Console

from es_service import api
from es_service.report.status import follow_status, print_status, print_summary
from es_service.store import reader
from tests.system.session import SMALL


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Five generations of five."""
    return api.run(SMALL | {"budget": {"generations": 5}}, tmp_path_factory.mktemp("status") / "run").run


@pytest.fixture
def console():
    return Console(width=40)


def test_of_a_long_history_only_the_newest_row_is_read(run, console, monkeypatch, capsys):
    def no_more_than_one(connection, meta, first, limit=None):
        assert first >= 5
        return sound_rows(connection, meta, first, limit)

    sound_rows = reader._sound_rows
    monkeypatch.setattr(reader, "_sound_rows", no_more_than_one)
    print_status(console, run)
    follow_status(console, run)
    print_summary(console, run, "")
    assert "\ngeneration 5 " in capsys.readouterr().out
