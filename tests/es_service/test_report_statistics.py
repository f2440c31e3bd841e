"""Statistics between groups: equal to those of rliable and of scipy, to counts of all cases, and to cases by hand."""

from __future__ import annotations

import csv
import io
import itertools
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from es_service import plots
from es_service.cli.report import bounds_of
from es_service.errors import ConfigError
from es_service.report import between, compare, statistics
from es_service.report.compare_page import comparison_page
from es_service.report.data import read_run
from es_service.report.figures import empty_figure
from es_service.report.measures import with_derived
from es_service.report.statistics import median_interval
from es_service.report.summary import number
from es_service.report.write import write_comparison
from tests.es_service.test_report_compare import words
from tests.run_examples import write_run

FIRST = list(np.array([
    [0.625, 0.621, 0.861, 0.347, 0.135],
    [0.574, 0.493, 0.789, 0.475, 0.556],
    [0.728, 0.672, 0.459, 0.608, 0.351],
]))  # fmt: skip
SECOND = list(np.array([
    [0.28, 0.623, 0.91, 0.771, 0.223],
    [0.337, 0.813, 0.3, 0.528, 0.363],
    [0.405, 0.461, 0.605, 0.277, 0.566],
]))  # fmt: skip
"""Values of five runs of each of three tasks; the expected numbers are those of rliable 1.2.0 with 50,000 draws."""


def _pvalue(result: Any) -> float:
    return float(result.pvalue)


def test_averages_and_their_intervals_are_those_of_rliable():
    assert statistics.iqm(FIRST) == pytest.approx(0.56477778)
    assert statistics.iqm(SECOND) == pytest.approx(0.46533333)
    assert statistics.interval(statistics.iqm, FIRST) == pytest.approx((0.46877778, 0.65355556), abs=0.004)
    assert statistics.interval(statistics.iqm, SECOND) == pytest.approx((0.35466667, 0.608), abs=0.006)
    assert statistics.interval(statistics.iqm, FIRST[:1]) == pytest.approx((0.20566667, 0.78233333))  # all ways counted


def test_the_probability_of_improvement_is_that_of_rliable():
    found = statistics.difference(FIRST, SECOND)
    assert found.improvement == pytest.approx(0.62666667)
    assert found.interval == pytest.approx((0.4, 0.82666667), abs=0.0134)  # one pair of 75
    alone = statistics.difference(FIRST[:1], SECOND[:1])
    assert alone.improvement == pytest.approx(0.44)
    assert alone.interval == pytest.approx((0.08, 0.84))


def test_performance_profiles_are_those_of_rliable():
    tau_K = np.array([0.2, 0.4, 0.5, 0.6, 0.8])
    np.testing.assert_allclose(statistics.profile(FIRST, tau_K), [14 / 15, 0.8, 0.6, 7 / 15, 1 / 15])
    ends_2_K = statistics.profile_interval(FIRST, tau_K)
    assert ends_2_K is not None
    expected = [[0.8, 0.6, 1 / 3, 4 / 15, 0.0], [1.0, 1.0, 13 / 15, 2 / 3, 0.2]]
    np.testing.assert_allclose(ends_2_K, expected, atol=1 / 15 + 1e-9)  # one run


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_intervals_of_medians_are_those_of_curves(n):
    values = np.random.default_rng(n).normal(size=n)
    assert statistics.interval(statistics.median, [values]) == pytest.approx(
        tuple(median_interval(values[:, None])[:, 0])
    )


def test_an_interval_of_many_runs_is_that_of_the_counted_one_and_always_the_same():
    values = np.random.default_rng(0).normal(size=12)
    found = statistics.interval(statistics.median, [values])
    assert found == statistics.interval(statistics.median, [values])
    assert found == pytest.approx(tuple(median_interval(values[:, None])[:, 0]), abs=0.1)


@pytest.mark.parametrize(("n", "m"), [(2, 2), (3, 3), (5, 5), (4, 7), (40, 30)])
def test_p_is_that_of_mann_and_whitney(n, m):
    rng = np.random.default_rng(n)
    x, y = rng.normal(0.5, 1.0, n), rng.normal(0.0, 1.0, m)
    found = statistics.difference([x], [y])
    assert found.p == pytest.approx(stats.mannwhitneyu(x, y, method="exact" if n < 20 else "asymptotic").pvalue)
    apart = statistics.difference([x + 100.0], [y])
    assert (apart.improvement, apart.shift) == (1.0, pytest.approx(found.shift + 100.0))
    if n < 20:
        assert apart.p == pytest.approx(apart.smallest_p)
    assert statistics.difference([y], [x]).p == pytest.approx(found.p)


def test_the_smallest_p_of_three_and_of_five_runs():
    three, five = np.arange(3.0), np.arange(5.0)
    assert statistics.difference([three], [three + 10]).p == pytest.approx(0.1)
    assert statistics.difference([five], [five + 10]).p == pytest.approx(2 / 252)


def test_p_with_equal_values_counts_all_ways_to_share_them_out():
    x, y = np.array([1.0, 1.0, 2.0, 5.0]), np.array([1.0, 2.0, 2.0])
    pooled, chosen = np.concatenate([x, y]), list(itertools.combinations(range(7), 4))
    uneven = []
    for places in chosen:
        others = [k for k in range(7) if k not in places]
        wins = [(pooled[i] > pooled[j]) + (pooled[i] == pooled[j]) / 2 for i in places for j in others]
        uneven.append(abs(np.mean(wins) - 0.5))
    found = abs(statistics.improvement([x], [y]) - 0.5)
    assert statistics.difference([x], [y]).p == pytest.approx(np.mean(np.array(uneven) >= found - 1e-12))


def test_p_over_several_tasks_compares_within_each():
    """Both tasks have the first group ahead; their levels differ so much that pooled values would hide it."""
    x, y = [np.array([1.0, 2.0, 3.0]), np.array([101.0, 102.0, 103.0])], [np.array([0.1, 0.2, 0.3]), np.full(3, 100.0)]
    found = statistics.difference(x, y)
    assert (found.improvement, found.p) == (1.0, pytest.approx(2 / 400))


def test_no_p_is_zero_where_ways_are_drawn():
    """Of the 252 ** 3 ways of three tasks, none of those that are drawn is as uneven as what was found."""
    found = statistics.difference([np.arange(5.0) + 10] * 3, [np.arange(5.0)] * 3)
    assert found.p == pytest.approx(1 / (1 + statistics.DRAWS))
    assert found.smallest_p < found.p


def test_paired_runs_are_compared_with_those_of_the_same_seed():
    x, y = np.array([1.0, 5.0, 9.0, 20.0, 31.0, 40.0]), np.array([0.5, 4.0, 8.2, 18.0, 28.0, 40.1])
    found = statistics.difference([x], [y], paired=True)
    assert found.p == pytest.approx(_pvalue(stats.wilcoxon(x - y, method="exact")))
    assert found.improvement == pytest.approx(5 / 6)
    assert found.p < statistics.difference([x], [y]).p
    assert statistics.difference([x], [x], paired=True).p == 1.0
    with pytest.raises(ValueError, match="cannot be paired"):
        statistics.difference([x], [y[:5]], paired=True)


def test_runs_that_never_reach_a_target_are_worse_than_all_that_do():
    never = -np.inf
    x, y = np.array([-3.0, -5.0, never]), np.array([-9.0, never, never])
    found = statistics.difference([x], [y])
    assert found.improvement == pytest.approx((3 + 3 + 0.0 + 1.0) / 9)
    assert np.isnan(found.shift)
    assert statistics.median([y]) == never
    assert statistics.interval(statistics.median, [x]) == (never, -3.0)


def test_holms_correction():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.6, 0.9]) == [1.0, 1.0]


@pytest.mark.parametrize("paired", [False, True])
def test_equal_groups_are_rarely_found_different(paired):
    """A p below 0.05 has a probability of at most 0.05 if nothing differs."""
    rng = np.random.default_rng(1)
    found = [statistics.difference(*rng.exponential(size=(2, 1, 5)), paired=paired).p for _ in range(300)]
    assert np.mean(np.array(found) < 0.05) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 300)


@pytest.fixture
def axes():
    return empty_figure().subplots()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Four seeds of es that end at -60 to -63, four of me_es at -70 to -73, whose last never comes to -75."""
    top, found = tmp_path_factory.mktemp("runs"), []
    for algorithm, end in (("es", -60.0), ("me_es", -70.0)):
        for seed in range(4):
            run = read_run(write_run(top / f"{algorithm}_{seed}", {"search.algorithm": algorithm, "seed": seed}))
            fitness = run.history["best_fitness"] * 0 - 100.0
            fitness[-1] = end - seed - (4.0 if (algorithm, seed) == ("me_es", 3) else 0.0)
            found.append(replace(run, history={**run.history, "best_fitness": fitness}))
    return found


def test_measures_of_groups_are_compared(runs):
    groups = compare.grouped(runs)
    by_name = {measure.name: measure for measure in between.compared(groups, -75.0)}
    assert set(by_name) == {"best_fitness", "goal_distance", "coverage", "qd_score", between.COST}
    [pair] = by_name["best_fitness"].pairs
    assert (pair.first, pair.second, pair.difference.improvement) == ("es", "me_es", 1.0)
    assert pair.p_corrected == pytest.approx(2 / 70)
    assert [average.median for average in by_name["best_fitness"].averages] == [-61.5, -71.5]
    cost = by_name[between.COST]
    assert cost.averages[0].iqm is not None
    assert cost.averages[1].iqm is None  # a run never comes to the target
    assert [(average.reached, average.runs) for average in cost.averages] == [(4, 4), (3, 4)]
    assert cost.pairs[0].difference.improvement == pytest.approx((12 * 0.5 + 4) / 16)
    assert "certified" not in by_name


def test_a_page_says_what_so_few_runs_can_show(runs):
    said = words(comparison_page(runs, threshold=-75.0))
    assert "es over me_es" in said
    assert "; p of its difference from me_es is 0.029; 7 of 8 runs reach -75.00." in said
    share = 100 * runs[0].last("coverage")
    assert f"coverage (%) group runs median interquartile mean es 4 {number(share)}" in said
    assert "The smallest corrected p that so many runs allow is 0.029." in said
    assert "Runs count as independent" in said
    assert "Wilcoxon" in words(comparison_page(runs, paired=True))
    assert "Between groups" not in words(comparison_page(runs[:4]))
    alone = between.compared(compare.grouped(runs[:4]))
    assert all((one.pairs, one.smallest_p, len(one.averages)) == ((), 1.0, 1) for one in alone)


def certified(run, *values, fitness="sum"):
    """The same run with certifications: (environment steps, mean, successes of 256) of each."""
    rows = [
        {"env_steps": steps, "return_mean": mean, "successes": successes, "episodes": 256}
        for steps, mean, successes in values
    ]
    return replace(run, history=with_derived(run.history, rows, fitness))


def test_a_certified_value_holds_until_the_next_one(runs):
    steps_G = runs[0].history["env_steps"]
    history = certified(runs[0], (None, 9.0, None), (steps_G[4], 2.0, 64), (steps_G[2], 1.0, None)).history
    np.testing.assert_array_equal(history["certified"], [np.nan] * 2 + [1.0] * 2 + [2.0] * (len(steps_G) - 5) + [9.0])
    np.testing.assert_array_equal(history["certified_success"], [np.nan] * 4 + [0.25] * (len(steps_G) - 4))
    assert history["selection_gap"][-1] == history["best_fitness"][-1] - 9.0
    corrected = {**runs[0].history, "corrected_coverage": np.full(len(steps_G), np.nan)}
    corrected["corrected_coverage"][3] = 0.5
    assert with_derived(corrected, [], "sum")["corrected_coverage"][[2, 3, -1]].tolist()[1:] == [0.5, 0.5]


def test_groups_are_judged_by_certified_values_if_all_have_one(runs):
    """me_es has the higher certified values, es the higher selected ones."""
    end = int(runs[0].last("env_steps"))
    values = [(-90.0 if run.constants["search.algorithm"] == "es" else -80.0) - run.constants["seed"] for run in runs]
    all_certified = [certified(run, (end, value, None)) for run, value in zip(runs, values, strict=True)]
    groups = compare.grouped(all_certified)
    assert [group.name for group in groups] == ["me_es", "es"]
    assert compare.median_run(groups[0]).last("certified") == -82.0
    said = words(comparison_page(all_certified, threshold=-81.0))
    assert "Of 2 groups, me_es ends with the highest median of the certified value: -81.50 (4 runs" in said
    assert "; the median of its selected best fitness is -71.50; 2 of 8 runs have a certified value of at least" in said
    assert "best less certified" in said
    measures = between.compared(groups)
    assert [measure.name for measure in measures][:2] == ["certified", "best_fitness"]
    assert measures[0].pairs[0].difference.improvement == 1.0
    titles = [chart.title for chart in compare.charts(groups, "env_steps")[0]]
    assert titles[0] == "Best fitness so far"  # a curve of values at the ends alone would be empty
    earlier = [certified(run, (3000, -99.0, None), (end, -90.0, None)) for run in runs]
    assert compare.charts(compare.grouped(earlier), "env_steps")[0][0].title == "Certified value"
    one_left = [*all_certified[:-1], runs[-1]]
    assert [group.name for group in compare.grouped(one_left)] == ["es", "me_es"]
    assert "highest median of the best fitness" in words(comparison_page(one_left))


def on_task(run, task, shift):
    """The same run on another task, where its fitness is ten times as much and shifted."""
    history = {**run.history, "best_fitness": 10.0 * run.history["best_fitness"] + shift}
    constants = {**run.constants, "task.environment": task, "task.episode_steps": 7}
    return replace(run, history=history, meta=replace(run.meta, constants=constants))


def test_runs_of_several_tasks_are_compared_by_shares_of_the_way_between_bounds(runs):
    both = [*runs, *(on_task(run, "other", 5.0) for run in runs)]
    with pytest.raises(ConfigError, match=r"task.environment differs: .* or name for each of them the fitness that"):
        compare.grouped(both)
    bounds = {"point_maze": (-80.0, -60.0), "other": (-795.0, -595.0)}
    shares = compare.normalised(both, bounds)
    groups = compare.grouped(shares)
    assert [(group.name, [*group.tasks], len(group.runs)) for group in groups] == [
        ("es", ["other", "point_maze"], 8), ("me_es", ["other", "point_maze"], 8)
    ]  # fmt: skip
    by_name = {measure.name: measure for measure in between.compared(groups, paired=False)}
    assert set(by_name) == {"best_fitness", "coverage"}
    es, me_es = by_name["best_fitness"].averages
    assert (es.median, me_es.median) == (pytest.approx(0.925), pytest.approx(0.425))
    [pair] = by_name["best_fitness"].pairs
    assert pair.difference.p == pytest.approx(2 / 70**2)  # shared out within each task
    assert (pair.difference.improvement, pair.difference.shift) == (1.0, pytest.approx(0.5))
    summary = compare.summaries(groups, None)[0]
    assert summary.intervals["best_fitness"] == es.median_interval
    said = words(comparison_page(shares, threshold=0.9))
    assert "16 runs on other, point_maze" in said
    assert "other (-795.0, -595.0), point_maze (-80.0, -60.0)" in said
    with pytest.raises(ConfigError, match="me_es has no run of other"):
        compare.grouped(shares[:12])
    with pytest.raises(ConfigError, match="bounds: other has none"):
        compare.normalised(both, {"point_maze": (0.0, 1.0)})
    with pytest.raises(ConfigError, match="write TASK=LOW,HIGH"):
        bounds_of(["point_maze=1"])
    for word in ("point_maze=1,nan", "point_maze=inf,2", "=1,2"):
        with pytest.raises(ConfigError, match="write TASK=LOW,HIGH"):
            bounds_of([word])
    assert bounds_of(["brax:ant=-1,2e3"]) == {"brax:ant": (-1.0, 2000.0)}


def test_groups_are_shown_under_other_names(runs):
    named = compare.labelled(runs, (), {"es": "evolution strategy"})
    assert [group.name for group in compare.grouped(named, compare.GROUP)] == ["evolution strategy", "me_es"]
    with pytest.raises(ConfigError, match=r"the group ess is unknown; must be .*; did you mean es"):
        compare.labelled(runs, (), {"ess": "x"})


def test_files_of_statistics(runs, tmp_path):
    files = {kind: tmp_path / f"s{kind}" for kind in between.FORMATS}
    for file in files.values():
        assert write_comparison(runs, tmp_path / "c.html", threshold=-75.0, statistics=file)[1] == file
    by_name = {measure["name"]: measure for measure in json.loads(files[".json"].read_text())}
    assert by_name["best_fitness"]["pairs"][0]["difference"]["improvement"] == 1.0
    rows = list(csv.DictReader(io.StringIO(files[".csv"].read_text())))
    [pair] = [row for row in rows if row["measure"] == "best_fitness" and row["second"]]
    assert (pair["first"], pair["second"], float(pair["improvement"])) == ("es", "me_es", 1.0)
    latex = files[".tex"].read_text()
    assert r"me\_es & 4 & $-71.50$ [$-77.00$, $-70.00$] &" in latex
    assert r" & coverage (\%) & " in latex
    assert r"never]" in latex  # a run of four never reaches the target
    with pytest.raises(ConfigError, match=r"must end with one of .json, .csv, .tex"):
        write_comparison(runs, tmp_path / "c.html", statistics=tmp_path / "s.xlsx")


def test_a_profile_is_drawn_from_all_runs_above_each_value(runs, axes):
    plots.profile(runs, axes)
    first, second = axes.lines
    assert first.get_xdata().tolist() == [-77.0, -72.0, -71.0, -70.0, -63.0, -62.0, -61.0, -60.0]
    assert first.get_ydata().tolist() == [1.0, 1.0, 1.0, 1.0, 1.0, 0.75, 0.5, 0.25]
    assert second.get_ydata().tolist() == [1.0, 0.75, 0.5, 0.25, 0.0, 0.0, 0.0, 0.0]
    assert len(axes.collections) == 2
    with pytest.raises(ConfigError, match="the measure certified is unknown; must be "):
        plots.profile(runs, axes, "certified")


def test_runs_without_partners_cannot_be_paired(runs):
    with pytest.raises(ConfigError, match=r"es has the seeds \[0, 1, 2, 3\], me_es has \[0, 1, 2\]"):
        between.compared(compare.grouped(runs[:7]), paired=True)


def test_names_of_groups_are_text_in_tables_of_latex():
    average = between.Average("a_1 \\ {50 %} ~^", 2, 1.0, None, None, None)
    text = between.text_of([between.Compared("best", "best", False, (average,), ())], ".tex")
    assert r"a\_1 \textbackslash{} \{50 \%\} \textasciitilde{}\textasciicircum{} & 2" in text


def test_small_numbers_have_a_power_of_ten_in_tables_of_latex():
    average = between.Average("a", 2, -1.3e-5, (-2.0e-5, 0.5), None, None)
    text = between.text_of([between.Compared("best", "best", False, (average,), ())], ".tex")
    assert r"a & 2 & $-1.30 \times 10^{-5}$ [$-2.00 \times 10^{-5}$, 0.500]" in text
