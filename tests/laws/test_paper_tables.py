"""The paper's measures: how they are read from a run, by hand, and that the guide has the tables of the csv."""

from __future__ import annotations

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

from tests.benchmarks import certified, certified_gymnasium, paper, paper_tables
from tests.benchmarks.paper_readings import AT, CURVE_AT, READINGS, column, curve, measured, readings


def run_of(steps: list[int], centres: list[list[tuple[float, float]]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """(evaluations, history) of a run whose generations evaluated these (mean, single) values, of fitness and, with
    the sign changed, of distances."""
    rows = [(generation, *values) for generation, found in enumerate(centres) for values in found]
    table = pd.DataFrame(rows, columns=["generation", "fitness_mean", "fitness_max"])
    table["goal_distance_way"], table["goal_distance_min"] = -table["fitness_mean"], -table["fitness_max"]
    return table, pd.DataFrame({"env_steps": steps}).rename_axis("generation")


def test_both_readings_are_the_best_over_all_centres_so_far():
    evaluations, history = run_of([10, 20, 30], [[(1.0, 5.0), (2.0, 3.0)], [(np.nan, np.inf)], [(4.0, 4.5)]])
    found = measured("ant_trap", evaluations, history)
    assert found["centre"].tolist() == [2.0, 2.0, 4.0]
    assert found["single"].tolist() == [5.0, 5.0, 5.0]


def test_a_reading_is_that_of_the_last_generation_by_then_and_none_if_the_run_is_shorter():
    steps = [500_000, 999_000, 1_001_000, 9_850_000]
    found = readings(
        "point_maze", *run_of(steps, [[(-100.0, -90.0)], [(-50.0, -40.0)], [(-30.0, -25.0)], [(-24.0, -20.0)]])
    )
    assert (found["centre_1e6"], found["single_1e6"]) == (-50.0, -40.0)
    assert (found["centre_1e7"], found["single_1e7"]) == (-24.0, -20.0)
    assert found["centre_1e8"] is None
    assert "steps_to_goal_centre" not in found


def test_a_curve_has_the_same_values_as_the_readings_at_the_points_that_the_run_has_reached():
    run = run_of([90_000, 900_000, 5_000_000, 10_000_001], [[(value, value + 1.0)] for value in (1.0, 2.0, 3.0, 4.0)])
    found = curve("ant_trap", *run).set_index("env_steps")
    assert found.index.tolist() == [at for at in CURVE_AT if at <= 10_000_000]
    assert (found["centre"][100_000], found["centre"][1_000_000], found["single"][10_000_000]) == (1.0, 2.0, 4.0)
    assert found["centre"][10_000_000] == readings("ant_trap", *run)["centre_1e7"]
    assert curve("ant_trap", *run_of([200_000, 400_000], [[(1.0, 1.0)], [(2.0, 2.0)]]))["env_steps"].min() > 200_000


def test_a_run_takes_the_place_of_its_old_rows_only():
    runs = [("ant_trap", "me_es", 1), ("ant_trap", "me_es", 0), ("ant_maze", "me_es", 1), ("point_maze", "ars", 1)]
    table = pd.DataFrame([(*run, 10, 1.0) for run in runs], columns=[*paper_tables.RUN, "env_steps", "centre"])
    run = {"task": "ant_trap", "method": "me_es", "seed": 1}
    found = paper_tables.with_run(table, run, pd.DataFrame([{**run, "env_steps": 20, "centre": 2.0}]))
    assert found["centre"].sum() == 5.0
    ordered = paper_tables.in_order(found)
    assert ordered[list(paper_tables.RUN)].agg(tuple, axis=1).tolist() == [runs[3], runs[2], runs[1], runs[0]]


def test_the_goal_is_reached_by_the_first_episode_that_comes_within_a_metre():
    values = [[(-60.0, -50.0)], [(-9.0, -1.01), (-8.0, -0.99)], [(-1.0, -0.5)]]
    found = readings("ant_maze", *run_of([10, 20, 30], values))
    assert (found["steps_to_goal_single"], found["steps_to_goal_centre"]) == (20, 30)
    assert readings("ant_maze", *run_of([10], [[(-60.0, -50.0)]]))["steps_to_goal_single"] is None


def test_the_guide_has_the_tables_of_the_runs():
    text = paper_tables.GUIDE.read_text()
    between = text.split(paper_tables.BEGIN)[1].split(paper_tables.END)[0]
    assert between.strip() == paper_tables.text(paper_tables.read()).strip()


def test_every_run_of_the_tables_has_a_curve_with_the_values_of_its_row():
    key, table, curves = list(paper_tables.RUN), paper_tables.read(), paper_tables.read_curves()
    assert set(curves[key].agg(tuple, axis=1)) == set(table[key].agg(tuple, axis=1))
    assert not curves.duplicated([*key, "env_steps"]).any()
    for row in table.to_dict("records"):
        of_run = curves[(curves[key] == [row[name] for name in key]).all(axis=1)].set_index("env_steps")
        assert of_run.index.max() <= row["env_steps"] / 0.98
        for at in AT:
            for name in READINGS:
                value = row[column(name, at)]
                assert (at in of_run.index) == (not np.isnan(value)), (row["task"], row["method"], row["seed"], at)
                assert np.isnan(value) or of_run[name][at] == value


def test_a_table_has_a_row_for_each_method_with_median_and_quartiles_and_names_what_is_not_finished():
    runs = pd.DataFrame(
        {
            "task": "ant_trap",
            "method": ["memes"] * 3 + ["ars"],
            "seed": [0, 1, 2, 0],
            "env_steps": [100_000_000, 100_000_000, 40_000_000, 100_000_000],
            "finished": [True, True, False, True],
            **{
                f"{name}_{at}": [1000.0, 1200.0, np.nan, 900.0]
                for name in ("centre", "single")
                for at in ("1e6", "1e8")
            },
            **{f"{name}_{at}": np.nan for name in ("centre", "single") for at in ("1e7", "1e9")},
            "fresh": [np.nan, 800.0, 600.0, np.nan],
        }
    )
    text = paper_tables.text(runs)
    assert "| MEMES | 0, 1, 2 | **1,100** (1,050 to 1,150, 2 runs) | **1,100**" in text
    assert "| ARS | 0 | **900** | **900**" in text
    assert "| **700** (650 to 750, 2 runs) |" in text
    assert "Not finished: MEMES seed 2 (40 M)." in text
    assert "In the paper, with other physics of the ant, after 1e8 unless said:\n\n| QD-PG | SAC |" in text
    assert "| 1540 ± 46 | 1075 ± 7 |" in text
    assert "1e7" not in text


def test_a_run_is_missing_without_a_curve_or_without_as_many_steps():
    rows = [("ant_trap", "me_es", 0, 100), ("ant_trap", "me_es", 1, 99), ("ant_trap", "me_es", 2, 100)]
    table = pd.DataFrame(rows, columns=[*paper_tables.RUN, "env_steps"])
    wanted = [paper.Wanted(Path("ant_trap_me_es.yaml"), seed, 100) for seed in range(4)]
    left = paper.missing(wanted, table, table[table.seed != 2])
    assert [one.seed for one in left] == [1, 2, 3]


def test_each_wanted_run_is_made_once_and_only_the_folder_of_a_finished_one_goes(monkeypatch, tmp_path):
    """With threads in the place of processes, and runs that only make their folder; odd seeds do not finish."""

    def run_one(one):
        (tmp_path / one.name).mkdir()
        return one.seed

    def keep(seed):
        seeds.append(seed)
        return seed % 2 == 0

    monkeypatch.setattr(paper, "worker_environment", dict)
    monkeypatch.setattr(paper, "ProcessPoolExecutor", lambda workers, **_: ThreadPoolExecutor(workers))
    wanted, before = [paper.Wanted(Path("c.yaml"), seed, 1) for seed in range(5)], signal.getsignal(signal.SIGINT)
    seeds: list[int] = []
    try:
        paper.compute(wanted, run_one, keep, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(seeds) == list(range(5))
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["c_1", "c_3"]


def test_certified_rows_replace_those_of_the_same_run_and_the_median_is_over_seeds_at_their_first_row_from_a_mark(
    tmp_path,
):
    path = tmp_path / "certified.csv"

    def rows(seed, *at):
        of_run = {"task": "ant_trap", "method": "es", "settings": "ant_trap_es", "seed": seed, "seconds": 1}
        marks = [{**of_run, "env_steps": steps, "return_mean": value, "successes": 0} for steps, value in at]
        return pd.DataFrame(marks)

    for seed, value in ((0, 10.0), (1, 30.0), (2, 20.0)):
        certified.keep(path, rows(seed, (10**7 + 1, value), (10**8 + 1, 2000.0)))
    certified.keep(path, rows(1, (10**7 + 5, 50.0)))
    table = certified.read(path)
    assert list(table.seed) == [0, 0, 1, 2, 2]
    assert "**20** (10 to 50, 3 seeds) | **2,000** (2,000 to 2,000, 2 seeds) |" in certified.in_words(table)
    wanted = [certified.Wanted(Path("ant_trap_es.yaml"), seed, (10**7, 10**8)) for seed in range(4)]
    assert [one.seed for one in certified.missing(wanted, table)] == [1, 3]
    only_later = rows(0, (10**8, 7.0)).assign(method="me_es")
    assert "| me_es |  |  |  |  |  |  | **7** (1 seed) |" in certified.in_words(only_later)
    polished = [one._replace(polished=True) for one in wanted]
    assert certified.missing(polished, table) == polished, "rows of a search are not those of what polishes its elites"


def test_rows_of_a_run_without_settings_are_kept_and_known_again(tmp_path, monkeypatch):
    monkeypatch.setattr(certified_gymnasium, "RESULTS", tmp_path / "table.csv")
    run = {"task": "Hopper-v5", "policy": "linear", "settings": "", "seed": 0, "cpu_s": 1.0, "return_mean": 5.0}
    rows = pd.DataFrame([{**run, "env_steps": steps, "elsewhere_return_mean": 5.0} for steps in (10, 20)])
    rows.to_csv(tmp_path / "of_run.csv", index=False)
    for _ in range(2):
        certified_gymnasium.keep(certified_gymnasium.read(tmp_path / "of_run.csv"))
    table = certified_gymnasium.read(tmp_path / "table.csv")
    assert list(table.settings) == ["", ""]
    assert list(table.env_steps) == [10, 20]
