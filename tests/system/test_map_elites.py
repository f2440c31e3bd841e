"""MAP-Elites from the outside: placement, kills, a fork of another task, and what the command line says of it."""

from __future__ import annotations

import signal

import pytest

from es_service import api
from es_service.store.digest import digest_parts
from tests.system.command_line import command
from tests.system.processes import committed
from tests.system.session import SMALL, finish

SEARCH = {"algorithm": "map_elites", "batch": 40, "centres": 4, "iso_sigma": 0.2, "evaluation_episodes": 2}
GENERATIONS = 14


def config_of(**compute):
    budget = {"generations": GENERATIONS}
    return SMALL | {"search": SEARCH, "budget": budget, "compute": {"engine": "inline", "workers": 1} | compute}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A finished run on one worker, for reading only."""
    folder = tmp_path_factory.mktemp("map_elites") / "run"
    return api.run(api.load_config(config_of()), folder).run


@pytest.mark.parametrize("compute", [{"workers": 2}, {"workers": 3}], ids=str)
def test_number_and_kind_of_workers(tmp_path, undisturbed, compute):
    other = api.run(api.load_config(config_of(**compute)), tmp_path / "run", on_notice=pytest.fail).run
    assert digest_parts(other.folder) == digest_parts(undisturbed.folder)
    assert set(other.history["workers"]) == {compute["workers"]}


def test_killed_at_three_points_in_three_generations(tmp_path, undisturbed):
    folder = tmp_path / "run"
    for at, nth, newest in (("mid_transaction", 3, 1), ("before_commit", 4, 4), ("after_commit", 4, 8)):
        kill, config = {"at": at, "nth": nth}, None if folder.exists() else config_of()
        assert finish(folder, config=config, kill=kill) == -signal.SIGKILL
        assert committed(folder) == newest
    assert finish(folder) == 0
    assert digest_parts(folder) == digest_parts(undisturbed.folder)


def test_a_fork_whose_map_is_empty_begins_with_children_of_the_centres(tmp_path, undisturbed):
    changes = ["task.options.start=corner", f"budget.generations={GENERATIONS + 2}"]
    forked = api.fork(undisturbed.folder, changes, out=tmp_path / "fork").run
    assert 1 <= len(forked.map) < len(undisturbed.map)
    assert forked.map["generation"].min() > GENERATIONS


def test_the_map_fills_with_policies_that_can_be_evaluated(undisturbed):
    history, table = undisturbed.history, undisturbed.evaluations
    assert history["map_cells"].iloc[-1] == len(undisturbed.map) >= 20
    assert table.groupby("generation").size().tolist() == [4] + [40] * GENERATIONS
    assert (history["qd_score"].diff().iloc[1:] >= 0).all()
    assert set(history["archive_size"]) == {4}
    result = command("evaluate", undisturbed.folder, "--all", "--episodes", 4)
    assert result.returncode == 0, result.stderr


def test_the_command_line_speaks_of_policies_and_of_their_noise(undisturbed):
    assert "map_elites, 40 policies, seed 0" in command("status", undisturbed.folder).stdout
