"""A run's policies in another task: who is selected, by which episodes, what is stored, refused and shown."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

import es_service
from es_service import api
from es_service.cli.main import app
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.errors import ConfigError, StoreError
from es_service.loop.contents import policy_work
from es_service.protocol.episodes import gathered
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.noise import Domain, seed_for
from es_service.report.summary import elsewhere_text, number
from es_service.runs import certification, verification
from es_service.runs.certification import certify_run
from es_service.runs.certified import (
    Certified,
    Elsewhere,
    all_certifications,
    certified_by_task,
    certified_elsewhere,
    certified_policies,
)
from es_service.runs.evaluation import evaluation_config
from es_service.runs.onnx import model_card
from es_service.runs.other_task import other_task
from es_service.runs.replay import record
from es_service.runs.selection import StoredEpisodes, gap_interval, mean_interval, share_gap_interval
from es_service.runs.verification import recomputed_certifications
from es_service.runs.view import open_run
from es_service.watch.pages import draw_list, metrics
from es_service.watch.runs import Runs
from tests.database import database
from tests.helpers import DirectEvaluator, policy_with

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 40},
    "policy": {"hidden": [6]},
    "search": {"algorithm": "map_elites", "batch": 16, "centres": 8},
    "map": {"cells": [6, 6]},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
    "seed": 4,
}
TASKS = "python:tests.es_service.other_tasks:"
CORNER = {"task": "point_maze", "overrides": ["task.options.start=corner"]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory, workers_here):
    return api.run(api.load_config(CONFIG), tmp_path_factory.mktemp("other") / "run", progress=False).run


@pytest.fixture(scope="module")
def of_python(tmp_path_factory, workers_here):
    config = CONFIG | {"task": {"environment": f"{TASKS}Drift", "options": {"wind": 0.002}}, "map": {"enabled": False}}
    config |= {"search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 2}}
    return api.run(api.load_config(config), tmp_path_factory.mktemp("python") / "run", progress=False).run


@pytest.fixture
def copied(finished, tmp_path):
    return open_run(shutil.copytree(finished.folder, tmp_path / "run"))


def returns_of(config, policy, episodes, number, seed) -> np.ndarray:
    """Returns of episodes of one policy, computed apart from any engine."""
    task, statistics = task_of(config), (policy.observation_mean_O[None], policy.observation_std_O[None])
    direct = DirectEvaluator(worker_spec(config, task))
    address = {"seed": seed, "generation": number, "domain": Domain.OTHER_TASK_RESET}
    asked = policy_work(policy.parameters_D[None], statistics, episodes, **address)
    answers = [one for one in direct.evaluate(asked.work) if isinstance(one, EpisodesResult)]
    return gathered([asked.shape], answers)[0].returns[0]


def test_selection_is_that_without_another_task_whose_episodes_only_report(finished, copied, tmp_path):
    plain = certify_run(shutil.copytree(finished.folder, tmp_path / "plain"), top=5, episodes=20, keep=2)
    found = certify_run(copied.folder, top=5, episodes=20, keep=2, **CORNER)
    selected = ("number", "rank", "name", "selection_mean", "selection_episodes", "selection_steps", "candidates")
    for name in selected:
        assert [getattr(one, name) for one in found] == [getattr(one, name) for one in plain]
    assert not np.array_equal(found[0].episodes.return_E, plain[0].episodes.return_E), "they have resets of their own"
    config = evaluation_config(copied, 1)
    corner = other_task(config, "point_maze", CORNER["overrides"])
    seed = seed_for(CONFIG["seed"], "point_maze")
    for one in found:
        assert one.elsewhere is not None
        pairs = ((config, one.episodes), (corner.config, one.elsewhere.episodes))
        for task, episodes in pairs:
            np.testing.assert_array_equal(episodes.return_E, returns_of(task, one.policy, 20, 0, seed))


def test_pairs_with_the_same_starts_have_the_interval_of_their_differences(copied, of_python):
    [same] = certify_run(copied.folder, top=0, episodes=32, task="point_maze")
    assert same.elsewhere is not None
    assert same.elsewhere.paired
    row = same.row()
    assert (row["gap_return_mean"], row["gap_return_low"], row["gap_return_high"]) == (0.0, 0.0, 0.0)
    [other] = certify_run(copied.folder, top=0, episodes=32, **CORNER)
    assert other.elsewhere is not None
    assert not other.elsewhere.paired
    here, there = other.episodes.return_E, other.elsewhere.episodes.return_E
    assert other.row()["gap_return_mean"] == pytest.approx(there.mean() - here.mean())
    assert other.row()["elsewhere"] == "point_maze (start = corner)"
    said: list[str] = []
    [windy] = certify_run(of_python.folder, episodes=32, task=f"{TASKS}Slippery", on_notice=said.append)
    assert f"task.options.push is 0.1 in {TASKS}Drift, and 0.2 in {TASKS}Slippery" in said
    assert windy.elsewhere is not None
    assert [*of_python.certified_by_task.index] == [f"{TASKS}Drift (wind = 0.002)", f"{TASKS}Slippery (wind = 0.002)"]
    assert windy.elsewhere.paired, "both draw the same place from a seed"
    differences = windy.elsewhere.episodes.return_E - windy.episodes.return_E
    shown = [windy.row()[f"gap_return_{end}"] for end in ("mean", "low", "high")]
    assert shown == pytest.approx(mean_interval(differences))


def test_options_of_the_run_are_those_of_the_other_task_unless_set(of_python):
    config = evaluation_config(of_python, 1)
    assert other_task(config, f"{TASKS}Slippery").options == {"wind": 0.002}, "changed in the run"
    set_ = other_task(config, f"{TASKS}Slippery", ["task.options.wind=0.5"])
    assert set_.config.task.options["wind"] == 0.5
    assert not any("wind" in difference for difference in set_.differences), "it was asked for"


@pytest.mark.parametrize(
    ("task", "overrides", "message"),
    [
        ("Blind", [], "the size of an observation: 2 in python:.*Drift, but 1 in python:.*Blind"),
        ("Strong", [], r"the bounds of the actions: \[\[-1.0, 1.0\]\] in .*, but \[\[-2.0, 2.0\]\] in"),
        ("Drift", ["task.options.observation_scale=2"], "observation_scale: 1.0 in python:.*Drift, but 2.0 in"),
        ("Drift", ["task.options.wnd=2"], "unknown option; .* did you mean wind"),
        ("Drift", ["search.sigma=2"], "search.sigma: cannot be set for another task"),
        ("Drift", ["task.episode_steps=2"], "task.episode_steps: cannot be set for another task"),
        ("Drfit", [], "has no class Drfit|no .*Drfit"),
    ],
)
def test_what_does_not_fit_the_policies_is_refused_before_workers_start(
    of_python, monkeypatch, task, overrides, message
):
    monkeypatch.delattr(certification, "engine_here")
    with pytest.raises(ConfigError, match=message):
        certify_run(of_python.folder, task=f"{TASKS}{task}", overrides=overrides)


CONTACT = "task.options.include_cfrc_ext_in_observation: true in gymnasium:Ant-v5, but false in gymnasium:Ant-v5"
RANGE = r"task.options.contact_force_range: null in gymnasium:Ant-v5, but \[-2, 2\] in gymnasium:Ant-v5"
FORCES = "task.options.contact_forces: zero in ant_trap, but computed in gymnasium:es_service/AntTrapMujoco-v0"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("here", "there", "overrides", "sentence"),
    [
        ("gymnasium:Ant-v5", "gymnasium:Ant-v5", ["include_cfrc_ext_in_observation=false"], CONTACT),
        ("gymnasium:Ant-v5", "gymnasium:Ant-v5", ["contact_force_range=[-2, 2]"], RANGE),
        ("ant_trap", "gymnasium:es_service/AntTrapMujoco-v0", ["contact_forces=computed"], FORCES),
        ("gymnasium:Ant-v5", "gymnasium:Ant-v5", ["frame_skip=2"], None),
        ("ant_trap", "gymnasium:es_service/AntTrapMujoco-v0", [], None),
    ],
)
def test_options_of_observations_are_refused_in_one_sentence(here, there, overrides, sentence):
    """Also where they change the size of an observation. Another frame skip is another task, which may be asked for."""
    given = {"task": {"environment": here}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
    of_trap = ["task.options.physics=mujoco", "task.options.contact_forces=zero"] if here == "ant_trap" else []
    config = api.load_config({**given, "map": {"enabled": False}}, of_trap)
    options = [f"task.options.{option}" for option in overrides]
    if sentence is None:
        found = other_task(config, there, options).config.task.options
        assert found["frame_skip" if overrides else "contact_forces"] == (2 if overrides else "zero")
        return
    with pytest.raises(ConfigError) as caught:
        other_task(config, there, options)
    [problem] = caught.value.problems
    assert re.fullmatch(sentence, problem.sentence)


def test_other_sizes_name_both_tasks(finished):
    with pytest.raises(ConfigError, match="the size of an action: 2 in point_maze, but 8 in ant_maze"):
        certify_run(finished.folder, task="ant_maze")
    with pytest.raises(ConfigError, match="swimmer is not a known task"):
        certify_run(finished.folder, task="swimmer")


def test_every_reader_shows_the_other_tasks(copied, tmp_path):
    digest = copied.digest()
    certify_run(copied.folder, top=2, episodes=20, task="point_maze")
    certify_run(copied.folder, top=2, episodes=20, **CORNER)
    asked = ["evaluate", str(copied.folder), "--certify", "--top", "2", "--episodes", "16", "--json"]
    runner = CliRunner()
    [plain] = json.loads(runner.invoke(app, asked, catch_exceptions=False).stdout)
    assert "elsewhere" not in plain
    [row] = json.loads(runner.invoke(app, [*asked, "--task", "point_maze"], catch_exceptions=False).stdout)
    assert (row["certification"], row["elsewhere"], row["elsewhere_episodes"]) == (3, "point_maze", 16)
    elsewhere = certified_elsewhere(copied.folder)
    assert {task: one.number for task, one in elsewhere.items()} == {"point_maze": 3, "point_maze (start = corner)": 1}
    corner = elsewhere["point_maze (start = corner)"].row()
    by_task = copied.certified_by_task
    assert by_task.index.tolist() == ["point_maze", "point_maze (start = corner)"], "its own task is the first"
    assert by_task["certification"].tolist() == [3, 1]
    own, there = by_task["return_mean"]
    assert own == certified_by_task(copied.folder)["point_maze"].episodes.return_E.mean()
    assert there == corner["elsewhere_return_mean"]
    values = copied.policy("certified").certified
    assert {task: one["return_mean"] for task, one in values.items()} == by_task["return_mean"].to_dict()
    assert copied.policy("best").certified == {}
    gap = "gap {} [{}, {}]".format(*(number(corner[f"gap_return_{end}"]) for end in ("mean", "low", "high")))
    assert corner["gap_return_high"] < 0.0, "so none has a sign before it"
    status = runner.invoke(app, ["status", str(copied.folder)], catch_exceptions=False).stdout
    assert gap in status.split("in point_maze (start = corner)")[1]
    assert "with starts of their own in each task" in status
    verified = runner.invoke(app, ["verify", str(copied.folder), "--json"], catch_exceptions=False)
    assert [(one["differences"], one["not_judged"]) for one in json.loads(verified.stdout)["certified"]] == [
        ([], "")
    ] * 4
    said = runner.invoke(app, ["verify", str(copied.folder)], catch_exceptions=False).stdout
    assert "certification 1, " in said
    assert ", also in point_maze (start = corner): equal" in said
    es_service.write_report(copied.folder, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "In point_maze (start = corner), the certified policy" in page
    assert "to the run&#x27;s task" in page or "to the run's task" in page or "to the run&#39;s task" in page
    runner.invoke(app, ["export", str(copied.folder), "--to", "csv", "--out", str(tmp_path / "out")])
    [heads, *rows] = (tmp_path / "out" / "certified.csv").read_text().splitlines()
    assert {"elsewhere", "elsewhere_return_mean", "gap_return_low"} <= {*heads.split(",")}
    assert len(rows) == 4
    card = model_card(copied, ["certified.onnx"], elsewhere["point_maze (start = corner)"])
    assert f"In `point_maze (start = corner)`, it has {corner['elsewhere_return_mean']:.6g} (95 % interval" in card
    assert f"a gap of {corner['gap_return_mean']:.6g} (95 % interval" in card
    runs = Runs([copied.folder])
    [line] = [line for line in metrics(runs.summaries()).splitlines() if "gap{" in line and "corner" in line]
    assert float(line.split()[-1]) == corner["gap_return_mean"]
    assert "point_maze (start = corner): " in str(draw_list(runs)().sections["runs"])
    assert copied.digest() == digest
    [replay] = record(copied, best=False, cells=[], certified=True)[0]
    assert replay.is_the_stored, "its address is that of the certification in two tasks"
    newest = next(one for one in certified_policies(copied.folder) if (one.number, one.rank) == (3, 0))
    np.testing.assert_array_equal(copied.policy("certified").parameters_D, newest.policy.parameters_D)


def test_a_comparison_shows_the_values_there_and_the_gaps(copied, tmp_path):
    other = api.run(api.load_config(CONFIG, ["seed=5"]), tmp_path / "of_seed_5", progress=False).run
    rows = [certify_run(run.folder, top=0, episodes=16, **CORNER)[0].row() for run in (copied, other)]
    [page] = es_service.write_comparison([copied.folder, other.folder], tmp_path / "both.html")
    table = page.read_text().partition('id="final"')[2].partition("</table>")[0]
    _, *heads = re.findall(r'<th scope="col">(.*?)</th>', table)
    shown = dict(zip(heads, re.findall(r"<td>(.*?)</td>", table), strict=True))
    for name, column in (("certified in", "elsewhere_return_mean"), ("gap in", "gap_return_mean")):
        values = [row[column] for row in rows]
        cell = shown[f"{name} point_maze (start = corner)"]
        assert number(float(np.median(values))) in cell
        assert f"{number(min(values))} to {number(max(values))}" in cell


def test_a_run_goes_on_with_them_and_a_fork_has_none_but_new_episodes(copied, tmp_path):
    certify_run(copied.folder, top=0, episodes=16, **CORNER)
    more = api.resume(copied.folder, ["budget.generations=5"], progress=False).run
    assert [*certified_elsewhere(more.folder)] == ["point_maze (start = corner)"]
    alone = api.run(api.load_config(CONFIG, ["budget.generations=5"]), tmp_path / "alone", progress=False).run
    assert more.digest() == alone.digest()
    child = api.fork(more.folder, ["budget.generations=6"], out=tmp_path / "fork", progress=False).run
    assert certified_elsewhere(child.folder) == {}
    assert [one.number for one in certify_run(child.folder, top=0, episodes=16, **CORNER)] == [1]


def test_nothing_is_stored_if_the_other_task_fails(of_python):
    before = len(all_certifications(of_python.folder))
    with pytest.raises(ValueError, match="it broke"):
        certify_run(of_python.folder, episodes=16, task=f"{TASKS}Fails")
    assert len(all_certifications(of_python.folder)) == before


def test_verify_names_what_differs_or_cannot_be_run_in_the_other_task(of_python, copied, monkeypatch):
    certify_run(copied.folder, top=0, episodes=16, **CORNER)
    stored = verification.stored_task
    monkeypatch.setattr(verification, "stored_task", lambda config, elsewhere: other_task(config, "point_maze"))
    [found] = recomputed_certifications(copied)
    assert set(found.differences) >= {"return_E in point_maze", "descriptor_E_B in point_maze"}
    assert CliRunner().invoke(app, ["verify", str(copied.folder)]).exit_code == 1

    def missing(config, elsewhere):
        raise ConfigError("the package is missing")

    monkeypatch.setattr(verification, "stored_task", missing)
    result = CliRunner().invoke(app, ["verify", str(copied.folder)])
    assert result.exit_code == 3
    assert "equal, but the episodes in point_maze cannot be run again: the package is missing" in result.stdout
    monkeypatch.setattr(verification, "stored_task", stored)
    assert CliRunner().invoke(app, ["verify", str(copied.folder)]).exit_code == 0


@pytest.mark.parametrize("change", ["no episodes there", "episodes of no task", "another count"])
def test_what_es_service_never_writes_is_refused(copied, change):
    from es_service.store import records

    certify_run(copied.folder, top=0, episodes=16, **CORNER)
    with database(copied.folder / "run.db") as connection:
        [(_, row)] = records.certified_rows(connection)
        assert row is not None
        facts, arrays = dict(row.facts), dict(row.arrays)
        if change == "no episodes there":
            del arrays["elsewhere_return_E"]
        elif change == "episodes of no task":
            del facts["elsewhere"]
        else:
            arrays["elsewhere_steps_E"] = arrays["elsewhere_steps_E"][:3]
        connection.execute("DELETE FROM certification")
        records.insert_certification(connection, 0, [(facts, arrays)])
    with pytest.raises(StoreError, match="is not what es-service writes: row 0 of certification 0"):
        _ = open_run(copied.folder).certified


def test_wrong_options_of_the_command_line_say_what_to_do(finished):
    for options, message in (
        (["--task", "point_maze"], "--task point_maze needs --certify"),
        (["--certify", "--set", "task.options.start=corner"], "needs --task, whose options it sets"),
        (["--certify", "--task", "point_maze", "--set", "task.options.start=edge"], "must be default or corner"),
    ):
        result = CliRunner().invoke(app, ["evaluate", str(finished.folder), *options])
        assert message in str(result.exception)


def test_intervals_of_gaps_are_those_of_the_tables():
    """Newcombe's own examples of method 10: 56 of 70 against 48 of 80, and 50 pairs with 36, 12, 2 and 0. Welch's t has
    4 and here 2.9412 degrees of freedom."""
    shares = share_gap_interval(np.arange(80) < 48, np.arange(70) < 56, paired=False)
    assert shares == pytest.approx((0.2, 0.0524, 0.3339), abs=5e-5)
    first, second = np.repeat([[1, 1], [0, 1], [1, 0], [0, 0]], [36, 12, 2, 0], axis=0).T
    assert share_gap_interval(first, second, paired=True) == pytest.approx((0.2, 0.0569, 0.3404), abs=5e-5)
    low, high = share_gap_interval(np.zeros(256), np.zeros(256), paired=True)[1:]
    assert -0.02 < low < 0.0 < high < 0.02, "no success in either is no proof"
    equal = gap_interval([1.0, 2.0, 3.0], [3.0, 4.0, 5.0], paired=False)
    assert equal == pytest.approx((2.0, 2.0 - 2.776445 * (2.0 / 3.0) ** 0.5, 2.0 + 2.776445 * (2.0 / 3.0) ** 0.5))
    assert gap_interval([1.0, 2.0, 3.0], [3.0, 4.0, 5.0], paired=True) == (2.0, 2.0, 2.0)
    assert gap_interval([1.0, 1.0], [3.0, 3.0], paired=False) == (2.0, 2.0, 2.0)
    assert np.isnan(gap_interval([1.0], [3.0], paired=False)[1:]).all()
    wide = gap_interval([0.0, 2.0, 4.0], [1.0, 2.0, 3.0], paired=False)
    freedom = (4 / 3 + 1 / 3) ** 2 / ((4 / 3) ** 2 / 2 + (1 / 3) ** 2 / 2)
    assert freedom == pytest.approx(2.9412, abs=1e-4)
    assert wide == pytest.approx((0.0, -4.1547, 4.1547), abs=1e-3)


def test_a_policy_that_is_invalid_in_all_episodes_of_another_task_has_no_numbers_there_and_is_shown(finished):
    def episodes(value):
        ones = np.ones(4)
        return StoredEpisodes(value * ones, value * ones, np.nan * ones, None, ones.astype(np.int64), ones[:, None])

    there = Elsewhere("point_maze", {}, None, "xla", True, episodes(np.nan))
    itself = policy_with(np.zeros(1, np.float32))
    policy = Certified(0, 0, "best", 1, 1.0, "return", 1.0, 16, 2, 3, False, 0, {}, episodes(1.0), itself, there)
    row = policy.row()
    assert np.isnan([row["elsewhere_return_mean"], row["gap_return_mean"], row["gap_last_reward_low"]]).all()
    assert row["gap_goal_distance_mean"] is None
    assert "a gap of none" in elsewhere_text(policy, "return")
    assert "a gap of nan" in model_card(open_run(finished.folder), ["best.onnx"], policy)


def test_the_seed_for_a_name_is_no_other_one():
    seeds = {seed_for(seed, name) for seed in range(50) for name in ("point_maze", "ant_maze", "1\0point_maze")}
    assert len(seeds) == 150
    assert max(seeds) < 2**63


@pytest.mark.long
def test_a_policy_moves_between_mjx_and_c_mujoco_both_ways_with_the_same_starts(tmp_path):
    names = ("mujoco:InvertedPendulum-v5", "gymnasium:InvertedPendulum-v5")
    for here, there in (names, names[::-1]):
        config = CONFIG | {"task": {"environment": here, "episode_steps": 60}, "map": {"enabled": False}}
        config |= {"search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 2}, "budget": {"generations": 2}}
        run = api.run(api.load_config(config), tmp_path / here.partition(":")[0], progress=False).run
        said: list[str] = []
        [found] = certify_run(run.folder, episodes=32, task=there, on_notice=said.append)
        assert f"{there} does not tell the descriptor" in said[0]
        assert found.elsewhere is not None
        assert found.elsewhere.paired
        assert np.ptp(found.episodes.return_E) > 0.0
        np.testing.assert_allclose(found.elsewhere.episodes.return_E, found.episodes.return_E, atol=1.0)
        assert abs(found.row()["gap_return_mean"]) < 0.2
        [again] = recomputed_certifications(run)
        assert (again.differences, again.changes, again.not_judged) == ((), [], "")
        [replay] = record(run, best=False, cells=[], certified=True)[0]
        assert replay.is_the_stored
