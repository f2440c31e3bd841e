"""Log records: quiet by default, and each says which run and which generation it belongs to."""

from __future__ import annotations

import logging
import re

import pytest

from es_service import api
from tests.system.command_line import COMPILES, command
from tests.system.session import SMALL

SHORT = SMALL | {"budget": {"generations": 2}, "store": {"commit_interval_s": 0}}


def test_every_record_of_a_run_carries_its_id_and_its_generation(tmp_path, caplog):
    with caplog.at_level(logging.DEBUG, "es_service"):
        outcome = api.run(SHORT, tmp_path / "run")
    assert {record.run for record in caplog.records} == {outcome.run.run_id}
    session = [record for record in caplog.records if record.name == "es_service.runs.session"]
    generations = [record.generation for record in session if not f"note: {record.getMessage()}".startswith(COMPILES)]
    assert generations == [0, 0, 0, 1, 2, 3]  # twice at the beginning; generations 0 to 2; the end, before 3
    committed = [record for record in caplog.records if record.name == "es_service.store.writer"]
    assert [record.generation for record in committed] == [0, 1, 2]
    assert all(record.getMessage().startswith(f"stored generation {record.generation}:") for record in committed)
    up = next(record for record in caplog.records if "WorkerUp" in record.getMessage())
    assert (up.levelname, up.name) == ("INFO", "es_service.dispatch.engine")


def test_a_record_outside_a_run_belongs_to_none(caplog):
    from es_service.logs import logger

    logger("es_service.tests").warning("alone")
    (record,) = caplog.records
    assert (record.run, record.generation) == ("-", "-")


def others(printed: str) -> list[str]:
    """The lines that do not say that the run compiles, as it may on a busy machine."""
    return [line for line in printed.splitlines() if not line.startswith(COMPILES)]


def test_the_command_line_is_quiet_unless_it_is_told_otherwise(config, tmp_path):
    quiet = command("run", config, "--set", "budget.generations=1", "--out", tmp_path / "quiet")
    assert (quiet.returncode, others(quiet.stderr)) == (0, [])
    shown = command("resume", tmp_path / "quiet", "--set", "budget.generations=2", "--log-level", "info")
    assert shown.returncode == 0
    run_id = api.open_run(tmp_path / "quiet").run_id
    record = re.compile(rf"\S+ \S+ INFO es_service\.[\w.]+ run={run_id} generation=[23]: .+")
    assert all(record.fullmatch(line) for line in others(shown.stderr))
    assert "generation=2: working on" in shown.stderr
    assert "generation=2: centre fitness" in shown.stderr


@pytest.mark.parametrize("level", ["loud", ""])
def test_an_unknown_level_is_refused_with_the_levels(config, level):
    result = command("run", config, "--log-level", level, COLUMNS="200")
    assert result.returncode == 2
    assert "'debug', 'info', 'warning', 'error'" in result.stderr
