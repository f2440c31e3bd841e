"""MAP-Elites from the outside: a fork of another task, and what the command line says of it."""

from __future__ import annotations

import pytest

from es_service import api
from tests.system.command_line import command
from tests.system.session import SMALL

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
