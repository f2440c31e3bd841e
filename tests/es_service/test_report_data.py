"""What a report says about a run, compared with a run whose every value is known, with damaged ones, and with none."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service.cli.main import app
from es_service.errors import StoreError
from es_service.loop.state import Generation
from es_service.protocol.machine import CODE, code_text
from es_service.report import series, summary
from es_service.report.data import read_run
from es_service.runs.view import open_run
from es_service.store.sound import read_sound
from es_service.store.writer import RunStore
from tests.database import database
from tests.es_service.forgeries import rehash
from tests.run_examples import write_run
from workers.environments import SHIPPED

POINT = SHIPPED["point_maze"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "known", {"search.sigma": 0.3, "search.pairs": 64})


def test_a_report_reads_what_other_readers_read(folder):
    data, run = read_run(folder), open_run(folder)
    assert data.digest == run.digest()
    np.testing.assert_array_equal(data.history["best_fitness"], run.history["best_fitness"])
    np.testing.assert_array_equal(data.centres["novelty"], run.evaluations["novelty"])
    np.testing.assert_array_equal(data.map.fitness_N, run.map["fitness"])
    assert data.paths.keys() == set(run.map["cell"])
    place = run.map.iloc[3][["cell_x", "cell_y"]]
    np.testing.assert_array_equal(data.paths[int(run.map["cell"][3])], run.elite(place).trace_T_B)
    assert data.cell_name(int(run.map["cell"][3])) == f"{place.iloc[0]:.0f},{place.iloc[1]:.0f}"
    assert data.problems == ()


def test_settings_are_shown_if_they_differ_and_not_if_they_follow(folder):
    """search.pairs changes the chunks, too; task, algorithm, seed and budget are shown elsewhere."""
    found = summary.changed_settings(open_run(folder).config, POINT)
    assert [tuple(one) for one in found] == [("search.pairs", "64", "512"), ("search.sigma", "0.3", "0.02")]


def test_a_chosen_option_and_another_preset_are_settings(tmp_path):
    wanted = {"task.options.start": "corner", "search.preset": "uber", "map.enabled": False, "search.algorithm": "es"}
    config = open_run(write_run(tmp_path / "run", wanted)).config
    found = {one.key: (one.value, one.default) for one in summary.changed_settings(config, POINT)}
    assert found == {
        "task.options.start": ("corner", "default"),
        "search.preset": ("uber", "literature"),
        "map.enabled": ("false", "true"),
    }


def test_a_key_of_another_kind_of_part_has_its_own_default(tmp_path):
    wanted = {"search.shaping.kind": "top_pairs", "search.shaping.count": 2, "search.algorithm": "es"}
    config = open_run(write_run(tmp_path / "run", wanted)).config
    found = {one.key: (one.value, one.default) for one in summary.changed_settings(config, POINT)}
    assert found == {"search.shaping.kind": ("top_pairs", "ranks"), "search.shaping.count": ("2", "null")}


def test_all_settings_are_shown_if_the_defaults_are_unknown(folder):
    config = open_run(folder).config
    found = summary.changed_settings(config | {"search": config["search"] | {"forgotten": 3}}, POINT)
    assert {"search.forgotten", "search.step.l2"} <= {one.key for one in found}
    assert {one.default for one in found} == {""}


def test_the_verdict_says_what_was_found(folder):
    data = read_run(folder)
    sentence = summary.verdict(data)
    generation, fitness = data.best
    assert f"found in generation {generation}, has a mean fitness of {fitness:.2f} over 30 evaluation" in sentence
    assert "came to the goal is 0.024" in sentence  # 0.5 / 21
    assert "200 of 400 cells of the behaviour map are filled (50.0 %)" in sentence


def test_the_verdict_names_the_target(tmp_path):
    missed = read_run(write_run(tmp_path / "missed", {"budget.target_fitness": 0.0}))
    reached = read_run(write_run(tmp_path / "reached", {"budget.target_fitness": -90.0}))
    assert "does not reach the target of 0.000" in summary.verdict(missed)
    assert "which reaches the target of -90.00" in summary.verdict(reached)


def test_faults_are_counted(folder):
    found = summary.faults(read_run(folder))
    assert [tuple(one) for one in found] == [(5, 1, 2)]
    assert summary.fault_sentence(found).startswith("1 worker was lost and replaced, and 2 chunks were sent again")
    assert summary.fault_sentence([]) == "No worker was lost and no chunk had to be sent again."


def test_phases_add_up(folder):
    seconds = series.phase_seconds(read_run(folder).history)
    assert seconds == pytest.approx(
        {"episodes of the population": 1.26, "gradient": 0.21, "evaluation": 0.42, "driver": 0.105, "store": 0.105}
    )


def test_generation_0_alone_is_shown(tmp_path):
    data = read_run(write_run(tmp_path / "begun", generations=0, filled=0.01))
    assert "Only the initial centres were evaluated" in summary.verdict(data)
    assert "before any update" in summary.verdict(data)
    assert series.charts(data.history, data.centres, 0.0)[0].title == "Fitness"


@pytest.mark.parametrize(
    ("column", "value"), [("wall_clock_s", "NULL"), ("wall_clock_s", "1e999"), ("env_steps", "NULL")]
)
def test_a_forged_run_without_a_place_on_an_axis_is_refused(tmp_path, column, value):
    folder = write_run(tmp_path / "forged", generations=2, filled=0.01)
    with database(folder / "run.db") as connection:
        connection.execute(f"UPDATE history SET {column} = {value} WHERE generation = 1")
        rehash(connection)
    with pytest.raises(StoreError, match=f"is not what es-service writes: a generation has no {column}"):
        read_run(folder, digest=False)


def test_curves_of_long_runs_are_groups_of_generations():
    values_G = np.arange(8001.0)
    ends_K = series.groups(8001)
    assert ends_K.size == 297  # groups of 27, the last smaller
    assert ends_K[-1] == 8001
    assert set(np.diff(ends_K, prepend=0)) == {27, 9}
    np.testing.assert_array_equal(series.groups(3), [1, 2, 3])
    assert series.groups(0).size == 0
    np.testing.assert_array_equal(series.thinned(values_G, ends_K, "last"), ends_K - 1)
    np.testing.assert_allclose(
        series.thinned(values_G, ends_K, "mean"), (ends_K - 1 + np.concatenate([[0], ends_K[:-1]])) / 2
    )


def test_values_that_are_missing_leave_gaps_and_count_for_nothing():
    values_G, ends_K = np.array([np.nan, 1.0, np.nan, np.nan, 4.0, np.nan]), np.array([2, 4, 6])
    np.testing.assert_array_equal(series.thinned(values_G, ends_K, "mean"), [1.0, np.nan, 4.0])
    np.testing.assert_array_equal(series.thinned(values_G, ends_K, "last"), [1.0, np.nan, 4.0])
    np.testing.assert_array_equal(series.thinned(values_G, ends_K, "held"), [1.0, 1.0, 4.0])
    np.testing.assert_array_equal(series.thinned(values_G[2:], np.array([1, 4]), "held"), [np.nan, 4.0])
    assert series.thinned(np.zeros(0), np.zeros(0, int), "last").size == 0


EXPLORING, WEIGHT = "Exploring and exploiting centres", "Weight of fitness (w)"


@pytest.mark.parametrize(
    ("weights", "title", "lines"),
    [
        # Four emitters by turns, and by the toss of a coin. The history has the weight of the fittest, mostly 1.
        ([[0, 1, 0, 1], [1, 0, 1, 0]], EXPLORING, {"exploring": [0.5, 0.5], "exploiting": [0.5, 0.5]}),
        ([[0, 1, 1, 1], [0, 0, 0, 0]], EXPLORING, {"exploring": [0.25, 1.0], "exploiting": [0.75, 0.0]}),
        # One emitter.
        (
            [[0], [0], [1], [1]],
            EXPLORING,
            {"exploring so far": [1, 1, 2 / 3, 0.5], "exploiting so far": [0, 0, 1 / 3, 0.5]},
        ),
        # Mixtures: the same for all centres, or another for each.
        ([[1.0, 1.0], [0.75, 0.75]], WEIGHT, {"w": [1.0, 0.75]}),
        ([[0.0, 0.5], [0.5, 1.0]], WEIGHT, {"w": [0.25, 0.75]}),
        # Methods whose weight is constant.
        ([[1.0], [1.0]], None, {}),
        ([[0.5, 0.5], [0.5, 0.5]], None, {}),
        # Policies, which no population has moved.
        ([[], []], None, {}),
    ],
)
def test_what_all_centres_climb_is_drawn_if_it_differs(weights, title, lines):
    """The weights that are stored of generation 0 and of policies are not counted: nothing was climbed with them."""
    rows = [
        (0, 0.0, np.nan),
        *((g, w, 1.0) for g, ws in enumerate(weights, 1) for w in ws),
        (len(weights), 0.0, np.nan),
    ]
    columns = dict(zip(("generation", "fitness_weight", "update_norm"), np.array(rows).T, strict=True))
    history = {"generation": np.arange(len(weights) + 1.0), "fitness_weight": np.ones(len(weights) + 1)}
    history["update_norm"] = np.ones(len(weights) + 1)
    charts = series.charts(history, columns, 0.0)
    assert [chart.title for chart in charts] == ([] if title is None else [title])
    found = {line.label: line.y_K for chart in charts for line in chart.lines}
    assert found.keys() == lines.keys()
    for label, expected in lines.items():
        np.testing.assert_allclose(found[label], [np.nan, *expected])


def test_a_score_that_falls_as_the_map_fills_is_told_and_one_that_counts_from_the_least_fitness_is_drawn():
    """A cell of fitness -9, then one of -4, which a task without a lowest reward counts from 0. The least evaluated is
    -10, of a centre that entered no cell: the map is worth 1, then 1 + 6, then 1 + 8 after -2 has replaced -4."""
    centres = {name: np.zeros(0) for name in ("generation", "fitness_weight", "update_norm")}
    centres["fitness_mean"] = np.array([-9.0, -10.0, np.nan, -4.0, -2.0])
    history = {"generation": np.arange(3.0), "qd_score": np.array([-9.0, -13.0, -11.0])}
    history |= {"map_cells": np.array([1.0, 2.0, 2.0]), "update_norm": np.ones(3)}
    [chart] = series.charts(history, centres, 0.0)
    assert {line.label: line.y_K.tolist() for line in chart.lines} == {
        "QD-score": [-9.0, -13.0, -11.0],
        "above the least fitness": [1.0, 7.0, 9.0],
    }
    assert (
        "map.qd_offset = 0, so an elite below that lowers it; the other curve counts from -10, the least" in chart.note
    )
    [chart] = series.charts(history | {"qd_score": np.array([1.0, 7.0, 9.0])}, centres, -10.0)
    assert [line.label for line in chart.lines] == ["QD-score"]
    assert "lowers" not in chart.note


def test_status_says_that_elites_below_the_offset_lower_the_score(tmp_path):
    said = {
        offset: CliRunner().invoke(app, ["status", str(write_run(tmp_path / name, {"map.qd_offset": offset}))]).stdout
        for name, offset in (("zero", 0.0), ("least", -1e6))
    }
    assert "which elites below map.qd_offset = 0 lower" in said[0.0]
    assert "which elites" not in said[-1e6]


def test_the_share_of_exploring_centres_is_told_where_each_explores_or_exploits(folder):
    """Of generations 1 to 20, those from 10 to 19 exploited."""
    data = read_run(folder)
    assert dict(summary.what_was_run(data))["centres"] == "50.0 % of 20 explored, 50.0 % exploited"
    mixed = replace(data, centres={**data.centres, "fitness_weight": 0.5 * data.centres["fitness_weight"]})
    assert "centres" not in dict(summary.what_was_run(mixed))


def test_a_run_without_a_map_has_none(tmp_path):
    data = read_run(write_run(tmp_path / "run", {"map.enabled": False, "search.algorithm": "es"}))
    assert data.map is None
    assert data.problems == ()
    assert "map" not in summary.verdict(data)


def damaged(folder, statement, *values):
    with database(folder / "run.db") as connection:
        assert connection.execute(statement, values).rowcount == 1
    return read_run(folder)


def test_a_damaged_history_row_is_left_out_and_named(tmp_path):
    data = damaged(write_run(tmp_path / "run"), "UPDATE history SET best_fitness = 5 WHERE generation = 7")
    assert 7 not in data.history["generation"]
    assert data.history["generation"].size == data.centres["generation"].size == 20
    assert data.problems == ("the history rows of generations 7 are damaged or missing",)
    assert data.digest == ""


def test_a_damaged_elite_loses_its_path_only(tmp_path):
    folder = write_run(tmp_path / "run")
    map_ = read_run(folder).map
    cell = int(map_.cell_N[0])
    data = damaged(folder, "UPDATE content SET payload = 'x' WHERE name = ?", map_.trace_N[0].tobytes())
    assert cell not in data.paths
    assert len(data.paths) == data.map.size - 1
    assert data.problems == ("1 of the policies and paths that its state names are damaged or missing",)


def test_without_the_newest_state_rows_the_run_is_shown_and_said_to_be_incomplete(tmp_path):
    folder = write_run(tmp_path / "run")
    data = damaged(folder, "DELETE FROM state WHERE part LIKE 'map/geometry%'")
    assert data.map is None
    assert data.history["generation"].size == 21
    assert data.problems[0] == "the state of generation 20 is incomplete"
    assert "its geometry is damaged" in data.problems[1]


def test_a_database_that_cannot_be_opened_is_replaced_by_its_copy(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "run.db.copy").write_bytes((folder / "run.db").read_bytes())
    (folder / "run.db").write_bytes(b"no database" * 100)
    data = read_run(folder)
    assert data.history["generation"].size == 21
    assert "shown is its copy run.db.copy" in data.problems[0]


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(StoreError, match="is not a run folder"):
        read_run(tmp_path)


def test_the_goal_of_a_task_is_stored(tmp_path):
    elsewhere = replace(POINT, goal=(0.25, 0.5))
    assert read_run(write_run(tmp_path / "run", task=elsewhere)).task.goal == (0.25, 0.5)


def test_a_run_that_is_being_written_is_read_as_of_one_generation(tmp_path):
    """A driver commits another generation while the parts are read; nothing of it is in what is returned."""
    folder = write_run(tmp_path / "run")
    with RunStore.open(folder) as store:
        parts, row = store.load(), store.last_history()
        committed = []

        def kept(meta, part, arrays):
            if not committed:
                following = {**row, "generation": 21, "best_fitness": 0.0}
                store.commit([Generation(21, {"best": {**parts["best"], "fitness": np.asarray(0.0)}}, following)])
                committed.append(part)
            return arrays

        found = read_sound(folder, kept)
        assert committed
        assert (found.generation, found.newest["generation"], found.history["generation"].size) == (20, 20, 21)
        assert found.parts["best"]["fitness"] < 0.0
        assert found.problems == ()
        data = read_run(folder)
    assert data.last("generation") == 21
    assert data.best == (data.best[0], 0.0)
    assert data.digest == ""
    assert dict(summary.what_was_run(data))["state"].startswith("running on")
    assert dict(summary.provenance(data))["digest"] == "not computed while a driver is writing"
    assert read_run(folder).digest == open_run(folder).digest()


def test_code_is_told_in_a_line_and_a_change_of_it_by_its_files(tmp_path):
    """Not by the hash of each of a hundred files."""
    data = read_run(write_run(tmp_path / "run"))
    libraries = {"gymnax": "1.0.1"}
    before, after = ({"loop/a.py": "1" * 32, "loop/b.py": digit * 32} | libraries for digit in "23")
    platforms = [(0, {"cpu": "x", "jax": "1.0", CODE: before}), (9, {"cpu": "x", "jax": "1.0", CODE: after})]
    fields = dict(summary.provenance(replace(data, platforms=platforms)))
    assert fields["versions since generation 0"] == "jax 1.0, gymnax 1.0.1"
    first, second = (fields[f"code since generation {at}"] for at in (0, 9))
    assert first == code_text(before)
    assert second == f"{code_text(after)}; loop/b.py changed"
    assert code_text(before) == code_text(dict(reversed(before.items()))) != code_text(after)


def test_an_interrupted_run_is_shown_as_one(tmp_path):
    data = read_run(write_run(tmp_path / "run", {"budget.generations": 1000}))
    fields = dict(summary.what_was_run(data))
    assert fields["state"] == "stopped before its budget was spent"
    assert fields["generations"] == "20 of 1,000"
    assert data.digest
