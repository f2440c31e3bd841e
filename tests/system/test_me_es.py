"""ME-ES from the outside: fork with another task, what can be asked of a finished map, and what cannot."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest

from es_service import api
from es_service.errors import ConfigError, NotInRunError
from es_service.runs.export import arrays, ribs_archive
from es_service.search.maps.geometry import Grid
from es_service.store.digest import digest_parts
from tests.system.command_line import command
from tests.system.me_es_runs import CONFIG, run

pytestmark = pytest.mark.usefixtures("workers_here")


def test_a_map_has_filled_and_blocks_began_in_several_cells(mapped):
    history = mapped.history
    assert history["map_cells"].iloc[-1] == len(mapped.map) >= 10
    assert history["start_cell"].notna().sum() == 10
    assert history["start_cell"].nunique() >= 4
    assert pd.api.types.is_integer_dtype(history["start_cell"].dtype), "though most have none"
    numbers = mapped.map.set_index("cell")[["cell_x", "cell_y"]]
    entered = int(history["cell"].dropna().iloc[-1])
    assert mapped.cell(tuple(numbers.loc[entered])) == entered
    assert entered == numbers.loc[entered, "cell_x"] * 16 + numbers.loc[entered, "cell_y"]
    assert set(history["fitness_weight"].iloc[1:]) == {0.0, 1.0}
    assert history["coverage"].iloc[-1] == history["coverage_reachable"].iloc[-1] == len(mapped.map) / 256
    assert (history["qd_score"].diff().iloc[1:] >= 0).all()


def test_a_fork_with_another_task_begins_with_an_empty_map(tmp_path, mapped, noticed):
    changes = ["task.options.start=default", "budget.generations=41"]
    forked = api.fork(mapped.folder, changes, out=tmp_path / "fork").run
    assert len(forked.map) <= 1
    changes = ["task.episode_steps=30", "budget.generations=40"]  # which are spent already
    forked = api.fork(mapped.folder, changes, out=tmp_path / "empty").run
    assert noticed[-1].startswith("note: no generation was run")
    assert forked.constants["map.qd_offset"] == pytest.approx(-2.3431 * 30)
    assert len(forked.map) == 0
    assert arrays(forked)["parameters"].shape == (0, forked.policy_spec.parameters)
    assert command("export", forked.folder, "--to", "csv").returncode == 0
    for wrong in (("evaluate", forked.folder, "--all"), ("export", forked.folder, "--to", "ribs")):
        result = command(*wrong)
        assert result.returncode == 2
        assert "is empty" in result.stderr
    with pytest.raises(ConfigError, match=r"map\.cells"):
        api.fork(mapped.folder, ["map.cells=[4, 4]"], out=tmp_path / "other")


def test_every_algorithm_fills_the_same_map(tmp_path):
    one = run(tmp_path / "ns", config=CONFIG | {"search": {"algorithm": "ns_es", "pairs": 16, "centres": 3}})
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
        named = tuple(map(int, re.findall(r"(\d+),(\d+)(?: \(the first|$)", str(error.value))[0]))
        assert named in filled
        if place == empty:
            assert (named[0] - empty[0]) ** 2 + (named[1] - empty[1]) ** 2 == distance


def test_a_run_that_starts_from_another_s_centre_starts_with_the_statistics_that_centre_runs_with(tmp_path):
    origin = run(tmp_path / "origin", "search.parent_statistics=elite", "budget.generations=9")
    centre = origin.policy("centre")
    assert centre.observation_std_O.tolist() == [1.0, 1.0]  # those of the first centre, whatever has been seen since
    begun = run(tmp_path / "begun", f"search.init_from={origin.folder}", "budget.generations=1")
    map_, elites = begun.elites()
    (first,) = (elites[int(cell)] for cell, at in zip(map_.cell_N, map_.generation_N, strict=True) if at == 0)
    np.testing.assert_array_equal(first.parameters_D, centre.parameters_D)
    np.testing.assert_array_equal(first.observation_mean_O, centre.observation_mean_O)
    np.testing.assert_array_equal(first.observation_std_O, centre.observation_std_O)


def test_policies_have_the_statistics_of_their_evaluation(tmp_path):
    found = run(tmp_path / "run", "search.parent_statistics=global")
    newest, others = found.policy("centre"), 0
    map_, elites = found.elites()
    for cell, elite in elites.items():
        policy = found.policy(map_.geometry.index_of(cell))
        np.testing.assert_array_equal(policy.observation_mean_O, elite.observation_mean_O)
        np.testing.assert_array_equal(policy.observation_std_O, elite.observation_std_O)
        others += not np.array_equal(policy.observation_mean_O, newest.observation_mean_O)
    assert others
    snapshot = found.at(named=lambda snapshot: [snapshot.best.policy.tobytes()])
    best, [content] = found.policy("best"), snapshot.contents.values()
    np.testing.assert_array_equal(best.observation_mean_O, content["observation_mean_O"])
    np.testing.assert_array_equal(best.observation_std_O, content["observation_std_O"])
