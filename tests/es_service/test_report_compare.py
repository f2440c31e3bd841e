"""Comparisons of runs, with numbers worked out by hand, and figures."""

import html
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from es_service import open_run, plots
from es_service.errors import ConfigError, NotInRunError
from es_service.protocol.options import choice
from es_service.report import compare, figures
from es_service.report import maps as several_maps
from es_service.report.compare_page import comparison_page
from es_service.report.data import RunData, read_run
from es_service.report.figures import draw_overview, empty_figure, write_figures
from es_service.report.floor import beside_walls
from es_service.report.markup import MOST_COLUMNS
from es_service.report.summary import number
from es_service.report.write import write_comparison, write_report
from es_service.runs.run_status import GROUPS, INSIDE, write_groups
from es_service.search.maps.behaviour_map import BehaviourMap, projected
from tests.database import execute
from tests.es_service.test_report_page import EVIL, Elements, task_with
from tests.run_examples import write_run


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Three seeds each of me_es and es; the third of me_es has more generations."""
    top = tmp_path_factory.mktemp("runs")
    return [
        write_run(
            top / f"{algorithm}_{seed}",
            {"search.algorithm": algorithm, "seed": seed},
            generations=30 if (algorithm, seed) == ("me_es", 2) else 20,
        )
        for algorithm in ("me_es", "es")
        for seed in range(3)
    ]


@pytest.fixture(scope="module")
def runs(folders):
    return [read_run(folder) for folder in folders]


def test_runs_are_grouped_by_what_differs_but_the_seed(runs, tmp_path):
    assert [(group.name, len(group.runs)) for group in compare.grouped(runs)] == [("me_es", 3), ("es", 3)]
    wide = read_run(write_run(tmp_path / "wide", {"search.sigma": 0.5}))
    names = [group.name for group in compare.grouped([runs[0], runs[1], wide])]
    assert names == ["sigma = 0.02", "sigma = 0.5"]
    assert [group.name for group in compare.grouped([runs[0], wide], ["seed"])] == ["seed = 0"]
    assert [group.name for group in compare.grouped(runs[:3])] == ["me_es"]
    # The algorithm alone does not explain these, since two groups have the same.
    assert len(compare.grouped([*runs, wide])) == 3


def test_runs_of_one_sweep_are_grouped_as_it_has_named_them(tmp_path):
    inside = tmp_path / "one" / INSIDE
    inside.mkdir(parents=True)
    folders = [
        write_run(tmp_path / top / name, {"search.sigma": sigma, "policy.hidden": hidden})
        for top, name, sigma, hidden in (("one", "a", 0.02, [8]), ("one", "b", 0.5, [16]), ("two", "c", 0.5, [16]))
    ]
    write_groups(inside, {"a": "small", "b": ""})
    write_groups(inside, {"b": "large"})
    named = [read_run(folder) for folder in folders]
    assert [run.group for run in named] == ["small", "large", ""]
    assert [group.name for group in compare.grouped(named[:2])] == ["small", "large"]
    assert [group.name for group in compare.grouped(named[:2], ["search.sigma"])] == ["sigma = 0.02", "sigma = 0.5"]
    other = replace(named[2], group="large")  # of another sweep, whose groups may have the same names
    names = ["hidden = [8], sigma = 0.02", "hidden = [16], sigma = 0.5"]
    assert [group.name for group in compare.grouped([*named[:2], other])] == names
    (inside / GROUPS).write_text('{"a": 3, "b": ["x"]}')
    assert [read_run(folder).group for folder in folders] == ["", "", ""]
    (inside / GROUPS).write_text("[" * 100_000)
    assert read_run(folders[0]).group == ""


def test_runs_of_different_tasks_are_refused(runs, tmp_path):
    other = read_run(write_run(tmp_path / "other", task=task_with(2)))
    with pytest.raises(ConfigError, match=r"task.environment differs: .*me_es_0 has point_maze; .*other has made:Up"):
        compare.grouped([runs[0], other])
    with pytest.raises(ConfigError, match=r"task.environment differs"):
        compare.grouped([runs[0], other], ["task.environment"])
    longer = read_run(write_run(tmp_path / "longer", {"task.episode_steps": 300, "map.qd_offset": 0.0}))
    with pytest.raises(ConfigError, match=r"task.episode_steps differs: .* or group by task.episode_steps"):
        compare.grouped([runs[0], longer])
    assert len(compare.grouped([runs[0], longer], ["task.episode_steps"])) == 2


def test_an_unknown_key_is_refused_with_the_nearest(runs):
    with pytest.raises(ConfigError, match=r"no run has this setting; did you mean search.algorithm\?"):
        compare.grouped(runs, ["search.algoritm"])


def test_values_on_a_common_axis_are_those_of_the_newest_generation_by_then():
    x_G, y_G = np.array([10.0, 20.0, 30.0]), np.array([1.0, 2.0, 3.0])
    found = compare.at(x_G, y_G, np.array([0.0, 10.0, 19.9, 20.0, 30.0, 30.1]))
    np.testing.assert_array_equal(found, [np.nan, 1.0, 1.0, 2.0, 3.0, np.nan])


def test_curves_are_medians_of_all_runs_of_a_group_and_end_with_the_first(runs):
    groups = compare.grouped(runs)
    charts, x_K = compare.charts(groups, "env_steps")
    assert x_K[-1] == 31_000
    line = charts[0].lines[0]
    k = int(np.searchsorted(x_K, 15_500))
    values = [run.history["best_fitness"][int(x_K[k] // 1000) - 1] for run in groups[0].runs]
    assert line.y_K[k] == np.median(values)
    assert (line.range_K[0][k], line.range_K[1][k]) == (min(values), max(values))  # as always with three seeds
    assert np.isnan(line.y_K[x_K > 21_000]).all()
    assert np.isfinite(line.y_K[(x_K >= 1000) & (x_K <= 21_000)]).all()


def cut(run, generations):
    """The same run, ended earlier."""
    return replace(run, history={name: values_G[:generations] for name, values_G in run.history.items()})


def test_the_ends_of_a_short_run_are_points_of_its_curve(runs, axes):
    """It breaks through in its last generation, at 2,700 steps. The grid of the long one, which has 39,800 steps, has
    200 steps between its points, and the short one ends between two of them."""

    def at_steps(run, steps_G):
        columns = {"env_steps": steps_G, "wall_clock_s": steps_G / 2}
        return replace(run, history={**run.history, **columns})

    short = at_steps(cut(runs[3], 3), np.array([700.0, 1700.0, 2700.0]))
    short = replace(short, history={**short.history, "best_fitness": np.array([1.0, 2.0, 9.0])})
    long = at_steps(runs[0], np.linspace(1000, 39_800, 21))
    groups = compare.grouped([long, short])
    for axis, scale in (("env_steps", 1.0), ("wall_clock_s", 0.5)):
        charts, x_K = compare.charts(groups, axis)
        y_K = charts[0].lines[1].y_K
        there_K = np.isfinite(y_K)
        np.testing.assert_array_equal(x_K[there_K][[0, 1, -1]], np.array([700.0, 800.0, 2700.0]) * scale)
        np.testing.assert_array_equal(y_K[there_K][[0, 1, -2, -1]], [1.0, 1.0, 2.0, 9.0])
        axes.clear()
        plots.curves([long, short], axes, against=axis)
        assert [9.0, 2700.0 * scale] == [np.nanmax(axes.lines[1].get_ydata()), axes.lines[1].get_xdata()[y_K == 9.0]]


def test_the_ends_of_a_group_are_where_all_of_its_runs_have_values(runs):
    runs_2 = [replace(cut(run, 2), history={**cut(run, 2).history, "env_steps": np.array(steps)})
              for run, steps in zip(runs[:2], ([10.0, 30.0], [20.0, 40.0]), strict=True)]  # fmt: skip
    x_K = compare.places(compare.grouped([*runs_2, runs[3]]), "env_steps")  # a grid of 21,000 / 199 steps
    np.testing.assert_array_equal(x_K[:4], [0.0, 20.0, 30.0, 21_000 / 199])


def test_a_curve_of_one_point_is_a_dot(runs, axes):
    alone = cut(runs[3], 1)
    page = Elements(comparison_page([runs[0], alone]))
    assert ("class", "fill s1") in page.attributes
    plots.curves([runs[0], alone], axes)
    assert [line.get_marker() for line in axes.lines] == ["None", "o"]
    [at] = axes.lines[1].get_markevery()
    assert axes.lines[1].get_xydata()[at].tolist() == [1000.0, alone.history["best_fitness"][0]]


def test_runs_that_begin_after_others_have_ended_are_compared_on_both_axes(runs):
    """Short runs on a busy machine: the first generation of one took longer than all of another."""
    late = replace(runs[1], history={**runs[1].history, "wall_clock_s": runs[1].history["wall_clock_s"] + 1e6})
    groups = compare.grouped([runs[0], late])
    on_seconds, on_steps = (compare.charts(groups, axis)[0] for axis in ("wall_clock_s", "env_steps"))
    assert [chart.title for chart in on_seconds] == [chart.title for chart in on_steps]
    assert not np.isfinite(on_seconds[0].lines[0].y_K).any()
    assert np.isfinite(on_steps[0].lines[0].y_K).any()
    assert "2 runs on point_maze" in comparison_page([runs[0], late])


def test_solved_runs_are_counted_with_their_steps(runs):
    groups = compare.grouped(runs)
    ends = sorted(run.history["best_fitness"][-1] for run in groups[0].runs)
    threshold = (ends[1] + ends[2]) / 2  # one of three reaches it
    one = compare.summaries(groups, threshold)[0]
    solved = next(run for run in groups[0].runs if run.history["best_fitness"][-1] > threshold)
    first = int(np.argmax(solved.history["best_fitness"] >= threshold))
    assert (one.solved, one.steps.median) == (1, solved.history["env_steps"][first])
    assert one.values["best_fitness"] == (ends[1], (ends[0] + ends[1]) / 2, (ends[1] + ends[2]) / 2)
    assert one.intervals["best_fitness"] == (ends[0], ends[2])
    assert compare.median_run(groups[0]).history["best_fitness"][-1] == ends[1]
    assert compare.summaries(groups, None)[0].solved == 0


def test_a_comparison_shows_groups_maps_and_runs(runs):
    page = comparison_page(runs, threshold=-80.0)
    found = Elements(page)
    assert found.open == []
    assert page.count('aria-label="Behaviour map;') == 2
    assert "reach -80.00" in page
    for run in runs:
        assert str(run.folder) in page
    texts = found.scripts["data-charts"][0]["texts"]
    assert re.match(r"\S+ environment steps: me_es -?\S+ \(\S+ to \S+\); es ", texts["env_steps"][100])


def words(page):
    """The text of a page, without its script and its style."""
    body = re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub("<.*?>", " ", body)).split())


def test_final_values_are_tables_that_a_page_of_paper_has_room_for(runs):
    final = (
        comparison_page(runs, ["search.algorithm"], threshold=-100.0)
        .split('<section id="final">')[1]
        .split("</section>")[0]
    )
    heads = [re.findall(r"<th[^>]*>(.*?)</th>", head) for head in re.findall(r"<thead>(.*?)</thead>", final)]
    assert [head[0] for head in heads] == ["group"] * len(heads)
    assert max(map(len, heads)) <= 1 + MOST_COLUMNS < sum(len(head) - 1 for head in heads)
    assert {"seeds", "best fitness", "seconds"} <= {name for head in heads for name in head}


def test_a_page_says_how_many_seeds_there_are_and_what_its_intervals_are_worth(runs):
    ends = sorted(run.last("best_fitness") for run in runs[3:])
    said = words(comparison_page(runs))
    assert "me_es has 3 seeds; es has 3 seeds." in said
    assert f"interval {number(ends[0])} to {number(ends[2])} quartiles " in said
    assert "percentile bootstrap of the median" in said
    assert "With 3 seeds, it reaches from the lowest to the highest value" in said
    assert "with a probability of 75 %, not 95 %" in said
    assert "no interval" not in said


def test_one_seed_has_no_interval_and_the_page_says_so(runs):
    said = words(comparison_page([runs[0], runs[3]]))
    assert "me_es has 1 seed; es has 1 seed." in said
    assert "A group with one seed has no interval: me_es, es." in said
    assert not re.search(r"interval -?\d", said)
    assert "bootstrap" not in said
    charts, _ = compare.charts(compare.grouped([runs[0], runs[3]]), "env_steps")
    assert all(line.range_K is None for chart in charts for line in chart.lines)
    said = words(comparison_page([*runs[:3], runs[3]]))
    assert "A group with one seed has no interval: es." in said
    assert len(re.findall(r"interval -?\d", said)) > 3


def test_runs_with_the_same_seed_are_not_taken_for_several_seeds(runs, tmp_path):
    wide = read_run(write_run(tmp_path / "wide", {"search.algorithm": "me_es", "search.sigma": 0.5, "seed": 0}))
    said = words(comparison_page([*runs[:3], wide], ["search.algorithm"]))
    assert "3 in 4 runs" in said
    assert "A group in which several runs have the same seed has no interval: me_es." in said
    assert not re.search(r"interval -?\d", said)


def test_a_common_target_is_the_threshold(tmp_path):
    runs = [
        read_run(write_run(tmp_path / str(seed), {"seed": seed, "budget.target_fitness": -90.0})) for seed in range(2)
    ]
    assert "2 of 2 runs reach -90.00" in comparison_page(runs)
    assert compare.common_threshold(runs) == -90.0
    assert compare.common_threshold(compare.normalised(runs, {"point_maze": (-130.0, -50.0)})) == 0.5


def test_a_run_without_generations_is_refused(runs, tmp_path):
    execute(write_run(tmp_path / "run"), "DELETE FROM history")
    with pytest.raises(NotInRunError, match="has no finished generation yet"):
        comparison_page([runs[0], read_run(tmp_path / "run")])
    with pytest.raises(NotInRunError, match="has no finished generation yet"):
        plots.curves(tmp_path / "run", empty_figure().subplots())
    assert write_report(tmp_path / "run", figures=tmp_path / "figures") == [tmp_path / "run" / "report.html"]


@pytest.mark.slow
def test_figures_are_written_as_svg_pdf_and_png(folders, runs, tmp_path, monkeypatch):
    one = write_figures(runs[:1], tmp_path / "one")
    names = {"best_fitness", "goal_distance", "coverage", "qd_score", "behaviour_map", "trajectory", "centres"}
    names |= {"archive_profile", "behaviour_map_over_time"}
    assert {file.name for file in one} == {f"{name}.{kind}" for name in names for kind in ("svg", "pdf", "png")}
    assert all(file.stat().st_size > 2000 for file in one)
    monkeypatch.setattr(figures, "KINDS", ("svg",))
    page, *several = write_comparison(folders, tmp_path / "all.html", figures=tmp_path / "several")
    assert page.name == "all.html"
    names = {"overview", "best_fitness", "behaviour_maps", "profile"}
    names |= {"behaviour_maps_median", "behaviour_maps_filled", "archive_profile"}
    assert {f"{name}.svg" for name in names} <= {file.name for file in several}


@pytest.mark.slow
def test_figures_of_chosen_metrics_have_names_that_are_no_paths(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "KINDS", ("svg",))
    name = "certified in ../../x:Ant"
    named = [replace(run, history={**run.history, name: run.history["best_fitness"]}) for run in runs]
    files = write_figures(named, tmp_path / "in" / "figures", metrics=[name, "coverage"])
    assert {file.parent for file in files} == {tmp_path / "in" / "figures"}
    names = {file.stem for file in files}
    assert {"certified_in_x_Ant", "coverage", "profile_certified_in_x_Ant", "profile_coverage"} <= names
    assert "best_fitness" not in names
    with pytest.raises(ConfigError, match=r"the measure coverge is unknown; must be .*; did you mean coverage"):
        write_figures(runs, tmp_path / "figures", metrics=["coverge"])
    with pytest.raises(ConfigError, match=r"the axis hours is unknown; must be .*wall_clock_s"):
        write_figures(runs, tmp_path / "figures", metrics=["coverage"], against="hours")


def map_of(run: RunData) -> BehaviourMap:
    assert run.map is not None
    return run.map


def test_maps_over_seeds_have_the_share_of_the_runs_and_the_median_fitness(runs, tmp_path):
    maps = [map_of(run) for run in runs[:3]]
    for over in ("share", "median"):
        found = map_of(several_maps.over_seeds(runs[:3], over))
        for cell, value, descriptor_B in zip(found.cell_N, found.fitness_N, found.descriptor_N_B, strict=True):
            rows = [(map_, map_.row_of(cell)) for map_ in maps]
            there = [map_.fitness_N[row] for map_, row in rows if row is not None]
            assert value == (len(there) / 3 if over == "share" else np.median(there))
            assert found.geometry.cells_of(descriptor_B[None])[0] == cell
        assert set(found.cell_N) == set(np.concatenate([map_.cell_N for map_ in maps]))
    dominated = read_run(write_run(tmp_path / "slots", {"map.kind": "dominated", "map.slots": 50}))
    both, shown = map_of(several_maps.over_seeds([runs[0], dominated], "share")), projected(map_of(dominated))
    assert both.geometry == shown.geometry == maps[0].geometry
    assert set(both.cell_N) == {*maps[0].cell_N, *shown.cell_N}
    assert set(both.fitness_N) == {0.5, 1.0}
    with pytest.raises(ValueError, match="do not have the same cells"):
        several_maps.over_seeds([runs[0], replace(runs[1], map=None)], "share")
    other = read_run(write_run(tmp_path / "other", {"map.cells": [40, 10]}))  # as many, and others
    assert map_of(other).geometry.size == maps[0].geometry.size
    assert not several_maps.have_same_cells([runs[0], other])
    written = write_figures([runs[0], other], tmp_path / "figures", keys=["search.algorithm"])
    assert "behaviour_maps" in {file.stem for file in written}
    assert not {"behaviour_maps_median", "behaviour_maps_filled"} & {file.stem for file in written}


def test_a_map_until_a_generation_has_the_fittest_of_each_cell(runs):
    centres = runs[0].centres
    columns = {"generation": [0, 1, 1, 2], "fitness_mean": [1.0, 3.0, 2.0, 9.0], "x": [0.11, 0.12, 0.51, 0.13]}
    made = {name: np.array(values, float) for name, values in columns.items()} | {"y": np.full(4, 0.5)}
    assert made.keys() <= centres.keys()
    found = map_of(several_maps.until(replace(runs[0], centres=made), 1))
    assert sorted(found.fitness_N) == [2.0, 3.0]
    assert sorted(map_of(several_maps.until(replace(runs[0], centres=made), 2)).fitness_N) == [2.0, 9.0]


def test_an_archive_profile_is_the_share_of_cells_at_least_as_fit(runs, axes):
    map_ = map_of(runs[0])
    fitness_K = np.array([-np.inf, *map_.fitness_N[:3], np.inf])
    expected = [(map_.fitness_N >= fitness).sum() / map_.geometry.size for fitness in fitness_K]
    np.testing.assert_array_equal(several_maps.profile(map_, fitness_K), expected)
    plots.archive_profile(runs, axes)
    assert [line.get_label() for line in axes.lines] == ["me_es", "es"]
    assert len(axes.collections) == 2  # the intervals


def test_figures_without_matplotlib_are_refused_before_anything_is_recorded(folders, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for write in (
        lambda: write_report(folders[0], tmp_path / "page.html", figures=tmp_path / "figures"),
        lambda: write_comparison(folders, tmp_path / "page.html", figures=tmp_path / "figures"),
    ):
        with pytest.raises(ConfigError, match="figures need matplotlib") as caught:
            write()
        assert caught.value.way_out.extra == "figures"
    assert not list(tmp_path.iterdir())


def named_runs(top, name, value):
    """Two runs whose dimensions and folders have a name, and which differ in the value of an option."""
    made = task_with(2, options={"way": choice("a", value)})
    task = replace(made, name=f"made:{name}", descriptor_names=(f"x{name}", f"y{name}"))
    folders = [top / f"{number}{name.replace('/', '')}" for number in range(2)]
    return [
        write_run(folder, {"task.options.way": way}, task=task)
        for folder, way in zip(folders, ("a", value), strict=True)
    ]


def test_all_text_of_a_user_is_escaped(tmp_path):
    """Also what is said of a damaged run; the page has no element but its own."""
    pages = []
    for name, value in ((EVIL, f"v{EVIL}"), ("", "b")):
        folders = named_runs(tmp_path / str(len(name)), name, value)
        execute(folders[0], "DELETE FROM history WHERE generation = 7")
        pages.append(comparison_page([read_run(folder) for folder in folders], ["task.options.way"]))
    page, plain = pages
    found = Elements(page)
    assert {*found.names} == {*Elements(plain).names}
    assert "onerror" not in {name for name, _ in found.attributes}
    assert not re.search(r"<(?!/?[a-z!])", page.split("</style>")[1].split("<script>")[0])
    assert "are damaged or missing" in page
    assert page.count("v&lt;/script&gt;") > 3  # the name of the group, in figures and tables


@pytest.mark.slow
def test_names_are_no_formulas_in_figures(tmp_path, monkeypatch):
    """matplotlib reads what is between two $ as a formula, and refuses one that is wrong."""
    monkeypatch.setattr(figures, "KINDS", ("svg",))
    runs = [read_run(folder) for folder in named_runs(tmp_path, r"$\frac$", r"v$\frac$")]
    assert write_figures(runs[:1], tmp_path / "one")
    assert write_figures(runs, tmp_path / "two", ["task.options.way"])


def test_a_run_that_is_given_twice_counts_once(folders, tmp_path):
    page, *_ = write_comparison([folders[0], folders[1], folders[0]], tmp_path / "page.html")
    assert "<h1>2 runs on point_maze</h1>" in page.read_text()


@pytest.fixture
def axes():
    return empty_figure().subplots()


def test_a_plot_of_a_map_has_its_values_where_they_are(folders, runs, axes):
    mesh = plots.behaviour_map(open_run(folders[0]), axes)
    filled = np.ma.filled(mesh.get_array().reshape(20, 20).astype(float), np.nan)  # rows are y
    map_, parts = runs[0].map, beside_walls(runs[0].map, runs[0].task)
    whole_N = np.array([cell not in parts for cell in map_.cell_N])
    for cell, fitness in zip(map_.cell_N[whole_N], map_.fitness_N[whole_N], strict=True):
        i, j = map_.geometry.index_of(int(cell))
        assert filled[j, i] == fitness
    assert np.isfinite(filled).sum() == whole_N.sum()
    assert np.array_equal(axes.collections[0].get_array(), map_.fitness_N[~whole_N])
    assert len(axes.lines) == 3  # two walls and the goal


def test_an_elite_of_a_cvt_map_is_plotted_on_its_side_of_a_wall(tmp_path, axes):
    """Where there are walls, at its descriptor; elsewhere at the centroid of its cell."""
    maze = read_run(write_run(tmp_path / "maze", {"map.kind": "cvt", "map.cells": [30]}))
    centroid_N_B = maze.map.geometry.centroid_C_B[maze.map.cell_N]
    descriptor_N_B = centroid_N_B + 0.01
    descriptor_N_B[0] = (0.25, 7.0)  # beyond the bounds, which are from -1 to 1
    maze = replace(maze, map=replace(maze.map, descriptor_N_B=descriptor_N_B))
    shown_N_B = np.concatenate([[(0.25, 1.0)], descriptor_N_B[1:]])
    np.testing.assert_array_equal(plots.behaviour_map(maze, axes).get_offsets(), shown_N_B)
    plain = replace(maze, task=replace(maze.task, walls=None))
    np.testing.assert_array_equal(plots.behaviour_map(plain, axes).get_offsets(), centroid_N_B)


def test_elites_of_a_dominated_map_are_plotted_at_their_descriptors(tmp_path, axes):
    settings = {"map.kind": "dominated", "map.slots": 30}
    plane, line = (read_run(write_run(tmp_path / str(n), settings, task=task_with(n))) for n in (2, 1))
    np.testing.assert_array_equal(plots.behaviour_map(plane, axes).get_offsets(), plane.map.descriptor_N_B)
    drawn = plots.behaviour_map(line, axes).get_offsets()
    np.testing.assert_array_equal(drawn, np.column_stack([line.map.descriptor_N_B, line.map.fitness_N]))
    fitness_K = np.array([-200.0, -100.0])
    expected = [(projected(plane.map).fitness_N >= fitness).sum() / 400 for fitness in fitness_K]
    np.testing.assert_array_equal(several_maps.profile(plane.map, fitness_K), expected)
    with pytest.raises(NotInRunError, match="a dominated map, whose earlier elites do not follow"):
        plots.snapshots(plane, axes.figure)


def test_of_two_runs_in_the_middle_the_page_says_that_the_map_is_of_the_lower(runs):
    lower = min(runs[:2], key=lambda run: run.last("best_fitness"))
    assert compare.median_run(compare.grouped(runs[:2])[0]) is lower
    said = "whose best fitness is the median (of an even number of runs, the lower of the two in the middle);"
    assert said in words(comparison_page(runs[:2]))
    assert "whose best fitness is the median;" in words(comparison_page(runs[:3]))


def test_an_overview_has_all_centres_of_each_group_in_the_same_colours(runs):
    figure = empty_figure()
    draw_overview(runs, figure, threshold=float(runs[0].history["best_fitness"][-1]))
    above, below = figure.subfigs
    panels = {axes.get_title().splitlines()[0]: axes for axes in above.axes if axes.get_title()}
    assert panels.keys() == {"me_es", "es"}
    for name, axes in panels.items():
        group = [run for run in runs if run.constants["search.algorithm"] == name]
        assert [len(points.get_offsets()) for points in axes.collections] == [len(run.centres["x"]) for run in group]
        solved = sum(run.last("best_fitness") >= runs[0].last("best_fitness") for run in group)
        assert axes.get_title().splitlines()[1].startswith(f"{solved} of {len(group)} reach ")
    assert len({points.get_clim() for axes in panels.values() for points in axes.collections}) == 1
    assert [axes.get_ylabel() for axes in below.axes] == ["best fitness", "coverage"]
    assert [text.get_text() for text in below.legends[0].get_texts()] == ["me_es", "es"]
    assert below.legends[0].get_title().get_text() == "median, 95 % interval"
    assert len(above.axes) == len(panels) + 1, "one bar of colours, and no empty panel"
    assert {axes.get_xlabel() for axes in below.axes} == {"environment steps"}
    draw_overview(runs, other := empty_figure(), against="wall_clock_s")
    assert {axes.get_xlabel() for axes in other.subfigs[1].axes} == {"seconds"}


def test_a_plot_of_a_path_is_the_stored_path(folders, axes):
    table = open_run(folders[0]).map
    fittest = table.loc[table.fitness.idxmax()]
    plots.trajectory(folders[0], axes)
    drawn = axes.lines[3].get_xydata()  # after two walls and the goal
    np.testing.assert_array_equal(
        drawn[~np.isnan(drawn[:, 0])], open_run(folders[0]).elite((fittest.cell_x, fittest.cell_y)).trace_T_B
    )


def test_curves_of_figures_and_of_pages_have_the_same_ranges(folders, runs, axes):
    """Three seeds: the interval of the median reaches from the lowest to the highest, and the quartiles do not."""
    plots.curves(folders, axes)
    charts, x_K = compare.charts(compare.grouped(runs), "env_steps")
    best = next(chart for chart in charts if chart.title == "Best fitness so far")
    for region, line in zip(axes.collections, best.lines, strict=True):
        low_K, high_K = line.range_K
        drawn = {tuple(point) for point in region.get_paths()[0].vertices.tolist()}
        middle = len(x_K) // 3
        assert low_K[middle] < high_K[middle]
        assert {(x_K[middle], low_K[middle]), (x_K[middle], high_K[middle])} <= drawn


def test_plots_of_centres_and_curves(folders, runs, axes):
    points = plots.centres(folders[0], axes)
    np.testing.assert_array_equal(points.get_array(), np.sort(runs[0].centres["fitness_mean"]))  # the fittest on top
    axes.clear()
    plots.curves(folders, axes, "coverage")
    assert [line.get_label() for line in axes.lines] == ["me_es", "es"]
    assert len(axes.collections) == 2
    axes.clear()
    plots.curves([folders[0], folders[0], folders[1]], axes)
    assert not axes.collections, "two runs of one seed do not vary independently"
    axes.clear()
    plots.curves(folders[0], axes, against="generation")
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), runs[0].history["best_fitness"])
    with pytest.raises(ConfigError, match="no_column is no history column"):
        plots.curves(folders[0], axes, "no_column")


@pytest.mark.slow
def test_maps_of_other_dimensions_are_plotted_or_refused(tmp_path, axes):
    assert plots.behaviour_map(write_run(tmp_path / "one", task=task_with(1)), axes) is not None
    line = write_run(tmp_path / "line", {"map.kind": "cvt", "map.cells": [30]}, task=task_with(1))
    assert plots.behaviour_map(line, axes).get_array().size == 15
    cvt = write_run(tmp_path / "cvt", {"map.kind": "cvt", "map.cells": [30]}, task=task_with(2))
    assert plots.behaviour_map(cvt, axes).get_array().size == 15
    with pytest.raises(NotInRunError, match="a map of 3 dimensions"):
        plots.behaviour_map(write_run(tmp_path / "three", task=task_with(3)), axes)
    with pytest.raises(NotInRunError, match="no behaviour map"):
        plots.behaviour_map(write_run(tmp_path / "none", {"map.enabled": False, "search.algorithm": "es"}), axes)
