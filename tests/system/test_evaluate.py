"""`evaluate`: fresh values beside those stored in a run."""

from __future__ import annotations

import csv
import json
import signal
import time
from pathlib import Path

import pandas as pd
import pytest

from es_service.cli.evaluate import csv_file
from es_service.errors import ConfigError, StoreError
from tests.benchmarks import paper
from tests.system.command_line import PROGRAM, command
from tests.system.me_es_runs import run
from tests.system.processes import running, wait_until


def test_evaluate_puts_fresh_values_beside_stored_ones(tmp_path, mapped):
    file = tmp_path / "rows.csv"
    result = command("evaluate", mapped.folder, "--best", "--centre", "--all", "--episodes", 5, "--out", file)
    assert result.returncode == 0, result.stderr
    rows = list(csv.DictReader(file.read_text().splitlines()))
    assert len(rows) == 2 + len(mapped.map)
    assert [row["policy"] for row in rows[:2]] == ["best", "centre"]
    # From one corner and without noise, fresh episodes are the old ones.
    for row, fitness in zip(rows[2:], mapped.map["fitness"], strict=True):
        assert float(row["stored_fitness"]) == fitness
        assert float(row["fresh_fitness"]) == pytest.approx(fitness, abs=1e-3)
        assert float(row["fresh_standard_error"]) == pytest.approx(0.0, abs=1e-4)
        assert row["successes"] == "0"
    assert (
        f"{len(mapped.map)} elites: the mean descriptor of {len(mapped.map)} still lies in their cell" in result.stdout
    )
    one = ",".join(map(str, mapped.map[["cell_x", "cell_y"]].iloc[0]))
    result = command("evaluate", mapped.folder, "--cell", one, "--episodes", 5, "--json")
    assert result.returncode == 0, result.stderr
    [found] = json.loads(result.stdout)
    assert {name: str(value) for name, value in found.items()} == rows[2]
    for wrong, message in (
        ("99,0", "is not in the map"),
        ("a", "whole numbers"),
        ("3", "its cells are named by 2 numbers, such as"),
    ):
        result = command("evaluate", mapped.folder, "--cell", wrong)
        assert result.returncode == 2
        assert message in result.stderr


def test_the_fresh_fitness_of_the_paper_s_tables_is_that_of_evaluate(mapped):
    result = command("evaluate", mapped.folder, "--best", "--episodes", paper.FRESH_EPISODES, "--json")
    assert paper.fresh_fitness(mapped) == round(json.loads(result.stdout)[0]["fresh_fitness"], 2)


def test_evaluate_overwrites_nothing_but_csv_files(tmp_path, mapped):
    for out, code in ((mapped.folder / "run.db", 2), (tmp_path / "no" / "rows.csv", 1)):
        result = command("evaluate", mapped.folder, "--out", out)
        assert result.returncode == code
        assert str(out) in result.stderr
    assert command("evaluate", mapped.folder, "--all", "--cell", "1,1").returncode == 2


def test_evaluate_replaces_a_file_when_it_has_all_rows(tmp_path, mapped):
    file, notes = tmp_path / "rows.csv", []
    file.write_text("of last week\n")

    def interrupted() -> None:
        with csv_file(file, notes.append) as write:
            write({"policy": "best", "fitness": 1.5})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert file.read_text() == "of last week\n"
    assert (tmp_path / "rows.csv.new").read_text() == "policy,fitness\nbest,1.5\n"
    assert notes == [f"the results so far are in {file}.new"]
    assert command("evaluate", mapped.folder, "--cell", "99,9", "--out", file).returncode == 2
    assert file.read_text() == "of last week\n"
    assert command("evaluate", mapped.folder, "--episodes", 2, "--out", file).returncode == 0
    assert file.read_text().startswith("policy,generation,episodes")
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]
    (tmp_path / "full.csv.new").symlink_to("/dev/full")
    with pytest.raises(StoreError, match="No space left"), csv_file(tmp_path / "full.csv", notes.append) as write:
        write({"policy": "best"})
    with (
        pytest.raises(ConfigError, match="is a folder"),
        csv_file(tmp_path.rename(tmp_path.with_suffix(".csv")), print),
    ):
        pass


@pytest.mark.alone
def test_an_evaluation_that_would_take_days_begins_at_once_and_ends_promptly(mapped):
    """tests/es_service/test_evaluation.py counts what is in memory."""
    endless = ("evaluate", mapped.folder, "--episodes", 10**9, "--workers", 1)
    with running(PROGRAM, *endless) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        wait_until(process, lambda: children.read_text())  # the worker
        time.sleep(1.0)
        sent = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert time.monotonic() - sent < 2.0
    assert process.returncode == 130
    assert "Traceback" not in errors


def test_fresh_episodes_differ_from_those_that_chose(tmp_path):
    luck = run(tmp_path / "luck", "task.options.start=default")
    rows = tmp_path / "rows.csv"
    assert command("evaluate", luck.folder, "--all", "--episodes", 32, "--out", rows).returncode == 0
    table = pd.read_csv(rows)
    assert (table["fresh_fitness"] != table["stored_fitness"]).all()
    far = (table["fresh_fitness"] - table["stored_fitness"]).abs() / table["fresh_standard_error"]
    assert far.median() < 5, "and are of the same policies"
    again = tmp_path / "again.csv"
    command("evaluate", luck.folder, "--all", "--episodes", 32, "--out", again, "--workers", 1)
    assert again.read_text() == rows.read_text()
    other = tmp_path / "other.csv"
    command("evaluate", luck.folder, "--all", "--episodes", 32, "--out", other, "--seed", 2**63 - 1)
    fitness = pd.read_csv(other)["fresh_fitness"]
    assert (fitness != table["fresh_fitness"]).all()
    assert ((fitness - table["fresh_fitness"]).abs() / table["fresh_standard_error"]).median() < 5
