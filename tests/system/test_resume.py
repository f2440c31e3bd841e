"""`resume` from the command line: in pieces, with a longer budget, after damage, on a full disk."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import pytest

from es_service import open_run
from es_service.store.reader import read_generation
from tests.es_service.store_examples import flip_bit
from tests.system.command_line import PROGRAM, digest, es
from tests.system.processes import running, wait_until


def test_resume_in_pieces_equals_one_run_and_another_seed_does_not(config, finished, tmp_path):
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=7")[0] == 0
    assert digest(folder) != digest(finished[0])
    assert es("resume", folder, "--set", "budget.generations=8")[0] == 0
    assert es("resume", folder, "--set", "budget.generations=30", "--workers", 2)[0] == 0
    assert digest(folder) == digest(finished[0])
    assert es("run", config, "--out", tmp_path / "other", "--seed", 1)[0] == 0
    assert digest(tmp_path / "other") != digest(finished[0])


def test_a_longer_budget_stays_with_the_run(config, tmp_path):
    """`resume` with a budget, killed: a plain `resume` then goes on to that budget, not to the first one."""
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=3")[0] == 0
    with running(PROGRAM, "resume", folder, "--set", "budget.generations=200") as process:
        wait_until(process, lambda: (read_generation(folder) or 0) >= 4)
    assert (read_generation(folder) or 0) < 200
    assert es("resume", folder)[0] == 0
    assert read_generation(folder) == 200


def test_resume_of_a_finished_run_does_nothing(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    code, printed = es("resume", tmp_path / "run")
    assert code == 0
    assert "the budget of 30 generations is spent" in printed
    assert digest(tmp_path / "run") == digest(finished[0])


def test_columns_explained_in_other_words_are_the_same_columns(finished, tmp_path, monkeypatch):
    """So a version may explain them better and go on with the runs of those before it."""
    from es_service import api
    from es_service.loop.history import history_columns
    from es_service.runs import checked_config

    shutil.copytree(finished[0], tmp_path / "run")
    monkeypatch.setattr(
        checked_config,
        "history_columns",
        lambda *about: tuple(replace(at, meaning="new") for at in history_columns(*about)),
    )
    assert "is spent" in api.resume(tmp_path / "run").reason


@pytest.mark.parametrize("budget", ["generations=30", "env_steps=100", "wall_clock_s=1e-3", "target_fitness=-1e9"])
def test_a_spent_budget_starts_no_engine(finished, tmp_path, monkeypatch, budget):
    from es_service import api
    from es_service.runs import session

    shutil.copytree(finished[0], tmp_path / "run")
    monkeypatch.delattr(session, "make_engine")
    monkeypatch.setattr(session, "platform_info", lambda: {"jax": "99.0"})  # on which nothing is computed
    notices: list[str] = []
    overrides = ["budget.generations=1000", f"budget.{budget}"]
    outcome = api.resume(tmp_path / "run", overrides, on_notice=notices.append)
    assert (outcome.run.generation, notices) == (30, [])
    assert any(word in outcome.reason for word in ("is spent", "is reached"))


def test_a_state_is_read_once(finished, tmp_path, monkeypatch):
    """Its hash, and the tree of a long archive, take seconds."""
    from es_service import api
    from es_service.loop import driver

    shutil.copytree(finished[0], tmp_path / "run")
    read, inner = [], driver.state_of
    monkeypatch.setattr(driver, "state_of", lambda *given: read.append(given[1]) or inner(*given))
    assert api.resume(tmp_path / "run", ["budget.generations=31"]).run.generation == 31
    assert read == [30]


def test_a_disk_that_fills_up_stops_the_run_and_resume_goes_on(config, small_disk, tmp_path):
    folder, wide = small_disk / "run", ["--set", "policy.hidden=[64]", "--set", "budget.generations=400"]
    code, printed = es("run", config, "--out", folder, *wide)
    assert code == 1
    assert re.search(rf"disk full while storing generations? {read_generation(folder) + 1}\b", printed)
    assert "Everything stored before is safe; free space." in printed
    assert f": es-service resume {folder}" in printed
    subprocess.run(["mount", "-o", "remount,size=50m", str(small_disk)], check=True)
    assert es("resume", folder)[0] == 0
    assert es("run", config, "--out", tmp_path / "whole", *wide)[0] == 0
    assert digest(folder) == digest(tmp_path / "whole")


def test_damage_gives_the_same_digest_or_a_named_error(config, finished, tmp_path):
    """A flipped bit in the newest state, in the file header, a truncated file."""
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=20")[0] == 0
    sound = (folder / "run.db").read_bytes()
    newest = open_run(folder).policy("centre").parameters_D.tobytes()
    last = ["--set", "budget.generations=30"]

    flip_bit(folder / "run.db", sound.rindex(newest) + 8)
    code, printed = es("resume", folder, *last)
    assert code == 0
    assert re.search(r"generation 20.*19", printed.replace("\n", " "))
    assert digest(folder) == digest(finished[0])

    schema_counter = 40  # of SQLite's own, which only says that a table has changed
    for position, length, expected in (
        (3, None, 1),
        (schema_counter, None, 0),
        (None, 5000, 1),
        (None, len(sound) // 2, 1),
    ):
        (folder / "run.db").write_bytes(sound[:length])
        if position is not None:
            flip_bit(folder / "run.db", position, bit=4)
        code, printed = es("resume", folder, *last)
        assert code == expected, printed
        if code == 0:
            assert digest(folder) == digest(finished[0])
        else:
            assert f"{folder}/run.db cannot be used" in printed.replace("\n", "")


def test_other_versions_on_resume_are_told_and_make_the_digest_mixed(config, tmp_path, monkeypatch):
    from es_service import api
    from es_service.runs import session

    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=3")[0] == 0
    assert "mixed" not in digest(folder)
    monkeypatch.setattr(session, "platform_info", lambda: {"jax": "99.0"})
    notices: list[str] = []
    api.resume(folder, ["budget.generations=4"], on_notice=notices.append)
    assert any("from generation 4 on" in notice for notice in notices)
    assert digest(folder).endswith("mixed")


def test_resume_with_an_edited_config_lists_every_changed_constant(config, tmp_path):
    folder = tmp_path / "run"
    assert es("run", config, "--out", folder, "--set", "budget.generations=2")[0] == 0
    recorded = folder / "config.yaml"
    recorded.write_text(recorded.read_text().replace("sigma: 0.02", "sigma: 0.5").replace("seed: 0", "seed: 9"))
    code, printed = es("resume", folder)
    assert code == 2
    for change in ("search.sigma: 0.02 -> 0.5", "seed: 0 -> 9", "es-service fork"):
        assert change in printed
