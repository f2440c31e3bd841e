"""A map of slots from the outside: a run keeps its promises, and what reads a map reads this one or says why not.

`laws/test_disturbed_runs.py` has kills at its commits, and workers that come and go.
"""

from __future__ import annotations

import signal

import numpy as np
import pytest

from es_service import api
from es_service.config.model import RunConfig
from es_service.errors import ConfigError, NotInRunError
from es_service.report.data import read_run
from es_service.report.write import write_comparison
from es_service.search.maps.behaviour_map import projected
from es_service.search.maps.geometry import Dominated, Grid
from es_service.store.digest import digest_parts
from tests.system.command_line import command, es
from tests.system.me_es_runs import CONFIG
from tests.system.session import finish

SLOTS, GENERATIONS = 12, 30
MAP = {
    "kind": "dominated",
    "slots": SLOTS,
    "neighbours": 2,
    "cells": [8, 8],
    "correct_every": 10,
    "correct_episodes": 3,
}
SEARCH = {
    "me_es": CONFIG["search"],
    "memes": {name: of for name, of in CONFIG["search"].items() if name != "block_generations"}
    | {"algorithm": "memes", "emitters": 3, "stagnation_generations": 2},
    "map_elites": {"algorithm": "map_elites", "batch": 40, "centres": 4, "iso_sigma": 0.2, "evaluation_episodes": 2},
}


def config_of(method: str, *overrides: str) -> RunConfig:
    of_pairs = {} if method == "map_elites" else {"chunk_pairs": 4, "gradient_block_pairs": 8}
    compute = {"engine": "inline", "workers": 1, **of_pairs}
    changes = {"search": SEARCH[method], "map": MAP, "budget": {"generations": GENERATIONS}, "compute": compute}
    return api.load_config(CONFIG | changes, overrides)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A finished run of MEMES on one worker, for reading only."""
    return api.run(config_of("memes"), tmp_path_factory.mktemp("dominated") / "run").run


@pytest.mark.parametrize("method", SEARCH)
def test_two_workers_and_two_sessions_give_the_same_bits(method, undisturbed, tmp_path):
    once = undisturbed.folder
    if method != "memes":
        once = api.run(config_of(method), tmp_path / "once").run.folder
    first = config_of(method, "budget.generations=13", "compute.workers=2")
    again = api.run(first, tmp_path / "again").run.folder
    assert digest_parts(again) != digest_parts(once)
    api.resume(again, [f"budget.generations={GENERATIONS}"])
    assert digest_parts(again) == digest_parts(once)


def test_killed_and_resumed_it_ends_with_the_same_bits(undisturbed, tmp_path):
    config = config_of("memes").model_dump(mode="json")
    for at in ("after_commit", "mid_transaction", "before_commit"):
        kill = {"at": at}
        assert (
            finish(tmp_path / "run", config=None if (tmp_path / "run").exists() else config, kill=kill)
            == -signal.SIGKILL
        )
    assert finish(tmp_path / "run") == 0
    assert digest_parts(tmp_path / "run") == digest_parts(undisturbed.folder)


def test_the_history_counts_cells_of_the_grid_and_slots_change_their_elites(undisturbed):
    map_, history = undisturbed.behaviour_map, undisturbed.history
    assert map_.geometry == Dominated(((-1.0, 1.0), (-1.0, 1.0)), (8, 8), SLOTS, 2)
    shown = projected(map_)
    last = history.iloc[-1]
    assert (map_.size, last["map_cells"], last["coverage"]) == (SLOTS, shown.size, shown.size / 64)
    assert last["map_fitness_max"] == map_.fitness_N.max() == history["best_fitness"].max()
    assert (history["map_fitness_max"].diff().iloc[1:] >= 0).all()
    entered = undisturbed.evaluations.dropna(subset="cell")
    assert len(entered) > SLOTS
    assert set(entered["cell"]) == set(range(SLOTS))
    started = undisturbed.evaluations["start_cell"].dropna()
    assert len(started)
    assert set(started) <= set(range(SLOTS))
    # From one corner and without noise, new episodes are the old ones.
    of_corrected = history.loc[[10, 20, 30], ["corrected_coverage", "corrected_qd_score", "corrected_fitness_max"]]
    as_stored = history.loc[[10, 20, 30], ["coverage", "qd_score", "map_fitness_max"]]
    np.testing.assert_allclose(of_corrected, as_stored, rtol=1e-6)


def test_its_elites_are_evaluated_certified_and_exported(undisturbed, tmp_path):
    assert es("verify", undisturbed.folder)[0] == 0
    result = command("evaluate", undisturbed.folder, "--all", "--episodes", 3)
    assert result.returncode == 0, result.stderr
    cells = int(undisturbed.history["map_cells"].iloc[-1])
    assert f"{SLOTS} elites: the mean descriptor of {SLOTS} still lies in their cell" in result.stdout
    assert f"has {cells} filled cells" in result.stdout
    stored = f"{undisturbed.history['qd_score'].iloc[-1]:,.0f}"
    assert f"{stored} stored, {stored} fresh" in result.stdout
    slot = int(undisturbed.map["cell"].iloc[-1])
    assert "cell_x" not in undisturbed.map
    assert undisturbed.policy(slot).parameters_D.tolist() == undisturbed.elite((slot,)).parameters_D.tolist()
    with pytest.raises(NotInRunError, match=f"cells are numbered 0 to {SLOTS - 1}"):
        undisturbed.cell(SLOTS)
    copy = api.fork(undisturbed.folder, [f"budget.generations={GENERATIONS + 1}"], out=tmp_path / "fork").run
    result = command("evaluate", copy.folder, "--certify", "--top", 2, "--episodes", 16)
    assert result.returncode == 0, result.stderr
    assert command("export", copy.folder, "--to", "npz", "--out", tmp_path).returncode == 0
    with np.load(tmp_path / "policies.npz") as arrays:
        assert arrays["cell"].ravel().tolist() == copy.map["cell"].tolist()
    code, printed = es("export", copy.folder, "--to", "ribs", "--out", tmp_path)
    assert code == 2
    assert "is of kind dominated, but a GridArchive needs a grid; export to npz instead" in " ".join(printed.split())


def test_its_pages_show_it_and_a_comparison_with_a_grid_counts_the_same_cells(undisturbed, tmp_path):
    code, printed = es("report", undisturbed.folder, "--out", tmp_path / "page.html", "--figures", tmp_path / "figures")
    assert code == 0, printed
    page = (tmp_path / "page.html").read_text()
    assert page.count("<circle") >= SLOTS
    assert "of 64 cells of the grid of the behaviour map are filled" in page
    names = {file.stem for file in (tmp_path / "figures").iterdir()}
    assert "behaviour_map" in names
    assert "behaviour_map_over_time" not in names
    grid = api.run(config_of("memes", "map.kind=grid", "map.slots=1024", "map.neighbours=3"), tmp_path / "grid").run
    assert isinstance(grid.behaviour_map.geometry, Grid)
    written = write_comparison([read_run(undisturbed.folder), read_run(grid.folder)], tmp_path / "both.html")
    assert written


def test_a_fork_cannot_have_other_slots_and_an_empty_map_fills_again(undisturbed, tmp_path):
    for change in ("map.slots=20", "map.neighbours=5", "map.kind=grid"):
        with pytest.raises(ConfigError, match=change.partition("=")[0]):
            api.fork(undisturbed.folder, [change, "budget.generations=40"], out=tmp_path / "no")
    more = f"budget.generations={GENERATIONS + 3}"
    forked = api.fork(undisturbed.folder, ["task.episode_steps=50", more], out=tmp_path / "fork").run
    assert 1 <= len(forked.map) <= 9
    assert forked.map["generation"].min() > GENERATIONS
    slot = int(undisturbed.map["cell"].iloc[0])
    begun = [f"search.init_from={undisturbed.folder}:{slot}", "budget.generations=1", "policy.observation_clip=null"]
    other = api.run(config_of("memes", *begun), tmp_path / "other").run
    assert other.generation == 1
