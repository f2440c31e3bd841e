"""Generations of several populations from the outside: kills, the table of evaluated centres, evaluate."""

from __future__ import annotations

import csv
import random
import time

import numpy as np
import pandas as pd
import pytest

from es_service import api
from es_service.store.digest import digest_parts
from tests.system.command_line import command
from tests.system.processes import committed, wait_until
from tests.system.session import SMALL, finish, start

pytestmark = pytest.mark.usefixtures("workers_here")
SEARCHES = {
    "me_es": {"algorithm": "me_es", "emitters": 3, "pairs": 16, "evaluation_episodes": 4, "block_generations": 4},
    "memes": {"algorithm": "memes", "emitters": 3, "pairs": 16, "evaluation_episodes": 4, "stagnation_generations": 1},
    "nsra_es": SMALL["search"] | {"update": "all"},
}
GENERATIONS = 14


def config_of(name, **compute):
    budget = {"generations": GENERATIONS}
    return SMALL | {"search": SEARCHES[name], "budget": budget, "compute": SMALL["compute"] | compute}


@pytest.fixture(scope="module", params=SEARCHES)
def undisturbed(request, tmp_path_factory, workers_here):
    """A search's name, and its finished run on one worker, for reading only."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    api.run(api.load_config(config_of(request.param)), folder)
    return request.param, folder


@pytest.fixture(scope="module")
def emitters(tmp_path_factory, workers_here):
    """A finished run of ME-ES, for reading only; many elites, and resets that differ."""
    folder = tmp_path_factory.mktemp("emitters") / "run"
    search = {**SEARCHES["me_es"], "sigma": 0.2, "step": {"learning_rate": 0.3}}
    return api.run(api.load_config(config_of("me_es") | {"search": search}), folder).run


@pytest.mark.long
@pytest.mark.parametrize("name", ["me_es", "ns_es", "nsr_es", "nsra_es"])
def test_killed_twenty_times_at_random(tmp_path, name):
    """At random instants of one run, most of them while it computes."""
    search = SEARCHES["me_es"] if name == "me_es" else SMALL["search"] | {"algorithm": name, "update": "all"}
    if name != "nsra_es":
        search = {key: value for key, value in search.items() if key != "fitness_weight_patience"}
    config = SMALL | {"search": search, "budget": {"generations": 600}}
    undisturbed, folder, rng = tmp_path / "undisturbed", tmp_path / "run", random.Random(name)
    assert finish(undisturbed, config=config) == 0
    reached = []
    for _ in range(20):
        before = committed(folder)
        with start(folder, config=config if before is None and not (folder / "run.db").exists() else None) as process:
            wait_until(process, lambda before=before: committed(folder) != before)
            time.sleep(rng.uniform(0.0, 0.05))
            assert process.poll() is None, "the run ended before its kill; give it more generations"
        reached.append(committed(folder))
    assert len(set(reached)) == 20
    print(f"{name}: killed at generations {reached} of 600")
    assert finish(folder) == 0
    assert digest_parts(folder) == digest_parts(undisturbed)


# The table of evaluated centres


def test_the_table_has_its_columns_and_a_row_for_each_centre(undisturbed):
    run = api.open_run(undisturbed[1])
    table, centres = run.evaluations, run.constants["search.centres"]
    assert ",".join(table) == (
        "generation,centre,fitness_weight,start_cell,cell,fitness_mean,fitness_std,fitness_max,"
        "return_mean,x,y,goal_distance,goal_distance_way,goal_distance_min,novelty,"
        "update_norm,env_steps,fitness_first,reset_seed,reset_episode,reset_ask,reset_policy"
    )
    assert table["reset_policy"].isna().all()  # none of these searches asks for policies
    assert table["generation"].tolist() == np.repeat(np.arange(GENERATIONS + 1), centres).tolist()
    assert table["centre"].tolist() == list(range(centres)) * (GENERATIONS + 1)
    first = table["generation"] == 0
    for name in ("novelty", "update_norm"):
        assert table[name].isna().tolist() == first.tolist()
    begins = (table["generation"] % 4 == 1) & (run.constants["search.algorithm"] == "me_es")  # blocks of four
    if run.constants["search.algorithm"] == "memes":  # after each generation in which it entered no cell
        begins = (table["generation"] > 0) & table.groupby("centre")["cell"].shift(1).isna()
        assert begins.sum() >= 5
    assert table["start_cell"].notna().tolist() == begins.tolist()
    history = run.history
    np.testing.assert_array_equal(table.groupby("generation")["env_steps"].sum().cumsum(), history["env_steps"])
    best = table.loc[table.groupby("generation")["fitness_mean"].idxmax()].set_index("generation")
    np.testing.assert_array_equal(best["fitness_mean"], history["centre_fitness_mean"])
    np.testing.assert_array_equal(best["centre"], history["centre"])
    np.testing.assert_array_equal(
        table["fitness_mean"].cummax().to_numpy()[centres - 1 :: centres], history["best_fitness"]
    )
    assert len(run.evaluations_until(3)) == 4 * centres
    np.testing.assert_allclose(run.novelty[["x", "y"]], table[["x", "y"]], rtol=1e-12)


def test_the_cell_of_a_row_is_the_one_it_entered_and_kept(emitters):
    """The newest row of a cell is its elite in the map."""
    entered = emitters.evaluations.dropna(subset="cell").groupby("cell").last()
    map_ = emitters.map.set_index("cell").sort_index()
    assert entered.index.tolist() == map_.index.tolist()
    assert entered["generation"].tolist() == map_["generation"].tolist()
    assert entered["centre"].tolist() == map_["centre"].tolist()
    assert entered["fitness_mean"].tolist() == map_["fitness"].tolist()
    assert set(map_["centre"]) == {0, 1, 2}


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_an_export_has_the_table(tmp_path, undisturbed, to):
    folder = undisturbed[1]
    result = command("export", folder, "--to", to, "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    read = pd.read_csv if to == "csv" else pd.read_parquet
    exported = read(tmp_path / f"evaluations.{to}")
    pd.testing.assert_frame_equal(exported, api.open_run(folder).evaluations, check_dtype=False)


# Fresh episodes


def test_evaluating_all_cells_together_equals_one_by_one(tmp_path, emitters):
    """Every policy gets the same episodes, however many are evaluated side by side."""

    def rows(*arguments):
        out = tmp_path / "rows.csv"
        result = command("evaluate", emitters.folder, *arguments, "--episodes", 20, "--workers", 2, "--out", out)
        assert result.returncode == 0, result.stderr
        return {row["policy"]: row for row in csv.DictReader(out.read_text().splitlines())}

    together = rows("--all", "--best")
    assert len(together) == len(emitters.map) + 1 >= 12, "more than are evaluated side by side"
    assert len({row["fresh_fitness"] for row in together.values()}) >= 10
    names = list(together)
    for name in (names[1], names[7], names[-1]):
        assert rows("--cell", name) == {name: together[name]}
    assert rows("--best") == {"best": together["best"]}
