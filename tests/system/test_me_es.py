"""ME-ES from the outside: placement, resume, fork, what can be asked of a finished map, and what cannot."""

from __future__ import annotations

import csv
import os
import pickle
import re
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from es_service import api
from es_service.digest import digest_parts
from es_service.errors import ConfigError, NotInRunError, StoreError
from es_service.export import arrays, ribs_archive
from es_service.maps.geometry import Grid
from es_service.report.evaluations import csv_file
from es_service.run_view import map_places
from tests.system.command_line import command
from tests.system.processes import children

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 60, "options": {"start": "corner"}},
    "policy": {"hidden": [8]},
    "search": {
        "algorithm": "me_es",
        "pairs": 16,
        "sigma": 0.2,
        "learning_rate": 0.3,
        "l2": 0.0,
        "evaluation_episodes": 4,
        "block_generations": 4,
    },
    "map": {"cells": [16, 16]},
    "budget": {"generations": 40},
    "compute": {"engine": "inline", "workers": 1, "chunk_pairs": 4, "gradient_block_pairs": 8},
}


def run(folder: Path, *overrides: str, config=CONFIG, **callbacks):
    return api.run(api.load_config(config, overrides), folder, **callbacks).run


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    return run(tmp_path_factory.mktemp("me_es") / "run")


def test_a_map_has_filled_and_blocks_began_in_several_cells(mapped):
    history = mapped.history
    assert history["map_cells"].iloc[-1] == len(mapped.map) >= 10
    assert history["start_cell"].notna().sum() == 10
    assert history["start_cell"].nunique() >= 4
    assert set(history["fitness_weight"].iloc[1:]) == {0.0, 1.0}
    assert history["coverage"].iloc[-1] == history["coverage_reachable"].iloc[-1] == len(mapped.map) / 256
    assert (history["qd_score"].diff().iloc[1:] >= 0).all()


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed(tmp_path, mapped):
    notices = []

    def strike(row):
        if row["generation"] == 6:
            threading.Timer(0.002, os.kill, (children()[-1], signal.SIGKILL)).start()

    other = run(tmp_path / "two", "compute.workers=2", on_generation=strike, on_notice=notices.append)
    assert other.history["lost_workers"].sum() == 1
    assert digest_parts(tmp_path / "two") == digest_parts(mapped.folder)


def test_resumed_inside_a_block_and_forked(tmp_path, mapped):
    folder = tmp_path / "stopped"
    run(folder, "budget.generations=13")
    api.resume(folder, ["budget.generations=18"])
    api.fork(folder, ["budget.generations=40"], out=tmp_path / "fork")
    assert digest_parts(tmp_path / "fork") == digest_parts(mapped.folder)
    api.resume(folder, ["budget.generations=40"])
    assert digest_parts(folder) == digest_parts(mapped.folder)


def test_a_fork_with_another_task_begins_with_an_empty_map(tmp_path, mapped):
    changes = ["task.options.start=default", "budget.generations=41"]
    forked = api.fork(mapped.folder, changes, out=tmp_path / "fork").run
    assert len(forked.map) <= 1
    changes = ["task.episode_steps=30", "budget.generations=40"]  # which are spent already
    forked = api.fork(mapped.folder, changes, out=tmp_path / "empty").run
    assert forked.constants["map.qd_offset"] == pytest.approx(-2.3431 * 30)
    assert len(forked.map) == 0
    assert arrays(forked)["parameters"].shape == (0, forked.policy_shape.parameters)
    assert command("export", forked.folder, "--to", "csv").returncode == 0
    for wrong in (("evaluate", forked.folder, "--all"), ("export", forked.folder, "--to", "ribs")):
        result = command(*wrong)
        assert result.returncode == 2
        assert "is empty" in result.stderr
    with pytest.raises(ConfigError, match=r"map\.cells"):
        api.fork(mapped.folder, ["map.cells=[4, 4]"], out=tmp_path / "other")


def test_every_algorithm_fills_the_same_map(tmp_path):
    one = run(tmp_path / "ns", config=CONFIG | {"search": {"algorithm": "ns_es", "pairs": 16, "members": 3}})
    assert len(one.map) > 1
    assert one.history["start_cell"].isna().all()
    without = run(tmp_path / "none", "map.enabled=false", config=CONFIG | {"search": {"algorithm": "es", "pairs": 16}})
    assert "map_cells" not in without.history
    with pytest.raises(NotInRunError, match=r"map\.enabled = false"):
        _ = without.map
    assert command("evaluate", without.folder, "--all").returncode == 2
    assert command("export", without.folder, "--to", "ribs").returncode == 2


def test_cvt_maps_run_resume_and_refuse_ribs(tmp_path):
    whole = run(tmp_path / "whole", "map.kind=cvt", "map.cells=[50]")
    part = run(tmp_path / "part", "map.kind=cvt", "map.cells=[50]", "budget.generations=7")
    api.resume(part.folder, ["budget.generations=40"])
    assert digest_parts(part.folder) == digest_parts(whole.folder)
    first = int(whole.map["cell"].iloc[0])
    assert whole.policy(first)(np.zeros(2)).shape == (2,)
    with pytest.raises(NotInRunError, match="cvt"):
        ribs_archive(whole)


def test_policies_of_cells_and_their_traces(mapped):
    map_ = mapped.map
    place = tuple(map_[["cell_x", "cell_y"]].iloc[-1])
    elite = mapped.elite(place)
    assert mapped.cell([float(number) for number in place]) == mapped.cell(place)  # as a row of the table has it
    assert elite.trace_T_B.shape == (61, 2)  # of 60 steps, the start and every one
    np.testing.assert_allclose(elite.trace_T_B[0], (0.9, -0.9), atol=1e-6)
    np.testing.assert_allclose(elite.trace_T_B[-1], map_[["x", "y"]].iloc[-1], atol=1e-5)
    geometry = mapped.behaviour_map.geometry
    assert isinstance(geometry, Grid)
    assert geometry.index_of(int(geometry.cells_of(elite.trace_T_B[-1:])[0])) == place
    # The trace is what the policy does: stepping PointMaze with it goes the same way.
    moved = elite.trace_T_B[1] - elite.trace_T_B[0]
    np.testing.assert_allclose(moved, mapped.policy(place)(elite.trace_T_B[0]) / 10, atol=1e-5)


def test_a_cell_that_is_empty_or_not_there_names_the_nearest_filled_one(mapped):
    filled = {tuple(row) for row in mapped.map[["cell_x", "cell_y"]].to_numpy().tolist()}
    empty = next((i, j) for i in range(16) for j in range(16) if (i, j) not in filled)
    near = min(filled, key=lambda cell: (cell[0] - empty[0]) ** 2 + (cell[1] - empty[1]) ** 2)
    distance = (near[0] - empty[0]) ** 2 + (near[1] - empty[1]) ** 2
    for place, what in ((empty, "is empty"), ((16, 0), "is not in the map"), ((1, 2, 3), "is not in the map")):
        with pytest.raises(NotInRunError, match=what) as error:
            mapped.policy(place)
        named = tuple(map(int, re.findall(r"(\d+),(\d+)(?:, the first|$)", str(error.value))[0]))
        assert named in filled
        if place == empty:
            assert (named[0] - empty[0]) ** 2 + (named[1] - empty[1]) ** 2 == distance


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
    assert f"{len(mapped.map)} elites: {len(mapped.map)} still end in their cell" in result.stdout
    one = ",".join(map(str, mapped.map[["cell_x", "cell_y"]].iloc[0]))
    assert command("evaluate", mapped.folder, "--cell", one).returncode == 0
    for wrong, message in (
        ("99,0", "is not in the map"),
        ("a", "whole numbers"),
        ("3", "has 2 numbers there, such as"),
    ):
        result = command("evaluate", mapped.folder, "--cell", wrong)
        assert result.returncode == 2
        assert message in result.stderr


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
    assert notes == [f"what was evaluated until then is in {file}.new"]
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


def test_elites_at_the_edges_of_cells_keep_their_cells_in_pyribs(monkeypatch, mapped):
    map_, elites = mapped.elites()
    geometry = map_.geometry
    assert isinstance(geometry, Grid)
    low_N_2 = np.stack([edges[place] for edges, place in zip(geometry.edges, map_places(map_).T, strict=True)], axis=1)
    for shifted in (low_N_2, np.nextafter(low_N_2 + 1 / 8, -9)):
        moved = replace(map_, descriptor_N_B=shifted)
        np.testing.assert_array_equal(geometry.cells_of(shifted), map_.cell_N)
        monkeypatch.setattr(type(mapped), "elites", lambda self, moved=moved: (moved, elites))
        archive = ribs_archive(mapped)
        assert archive.stats.num_elites == map_.size


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


def test_exports_hold_what_the_run_holds(tmp_path, mapped):
    for to in ("csv", "parquet", "npz", "ribs"):
        result = command("export", mapped.folder, "--to", to, "--out", tmp_path)
        assert result.returncode == 0, result.stderr
    for read, ending in ((pd.read_csv, "csv"), (pd.read_parquet, "parquet")):
        pd.testing.assert_frame_equal(read(tmp_path / f"map.{ending}"), mapped.map)
        history = read(tmp_path / f"history.{ending}").set_index("generation")
        pd.testing.assert_frame_equal(history, mapped.history, check_dtype=False)
    with np.load(tmp_path / "policies.npz") as arrays:
        assert arrays["widths"].tolist() == [2, 8, 2]
        assert arrays["cell"].tolist() == mapped.map[["cell_x", "cell_y"]].to_numpy().tolist()
        np.testing.assert_array_equal(arrays["fitness"], mapped.map["fitness"])
        np.testing.assert_array_equal(arrays["best_parameters"], mapped.policy("best").parameters_D)
        elite = mapped.elite(arrays["cell"][3])
        np.testing.assert_array_equal(arrays["parameters"][3], elite.centre_D)
        np.testing.assert_array_equal(arrays["trace"][3], elite.trace_T_B)
    result = command("export", mapped.folder, "--to", "pdf")
    assert result.returncode == 2
    assert "must be csv, parquet, npz or ribs" in result.stderr


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_ribs_archive_opens_and_plots(tmp_path, mapped):
    import matplotlib
    from ribs import visualize

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    assert command("export", mapped.folder, "--to", "ribs", "--out", tmp_path).returncode == 0
    with (tmp_path / "archive.pickle").open("rb") as file:
        archive = pickle.load(file)
    assert archive.stats.num_elites == len(mapped.map)
    assert archive.stats.obj_max == pytest.approx(mapped.map["fitness"].max())
    assert archive.stats.qd_score == pytest.approx(mapped.history["qd_score"].iloc[-1])
    visualize.grid_archive_heatmap(archive)
    plt.savefig(tmp_path / "heatmap.png")
    plt.close()
    assert (tmp_path / "heatmap.png").stat().st_size > 1000


def test_a_run_that_starts_from_another_s_centre_starts_with_the_statistics_that_centre_runs_with(tmp_path):
    origin = run(tmp_path / "origin", "search.parent_statistics=elite", "budget.generations=9")
    centre = origin.policy("centre")
    assert centre.observation_std_O.tolist() == [1.0, 1.0]  # those of the first centre, whatever has been seen since
    begun = run(tmp_path / "begun", f"search.init_from={origin.folder}", "budget.generations=1")
    map_, elites = begun.elites()
    (first,) = (elites[int(cell)] for cell, at in zip(map_.cell_N, map_.generation_N, strict=True) if at == 0)
    np.testing.assert_array_equal(first.centre_D, centre.parameters_D)
    np.testing.assert_array_equal(first.observation_mean_O, centre.observation_mean_O)
    np.testing.assert_array_equal(first.observation_std_O, centre.observation_std_O)
