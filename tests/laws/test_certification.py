"""Certified values: who is selected, by which episodes, what is stored, and what it does not change."""

from __future__ import annotations

import json
import math
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

import es_service
from es_service import api
from es_service.cli.main import app
from es_service.config.tasks import task_of
from es_service.errors import ConfigError, NotInRunError, RunLockedError, StoreError
from es_service.loop.contents import policy_work
from es_service.protocol.content import OF_POLICY
from es_service.protocol.episodes import gathered
from es_service.protocol.machine import platform_info
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.noise import Domain, stream_keys
from es_service.report.write import python_call
from es_service.runs import certification
from es_service.runs.certification import OTHER_PROGRAMS, certified_outputs, certify, certify_run
from es_service.runs.certified import certified_policies
from es_service.runs.evaluation import FRESH_GENERATION
from es_service.runs.export import arrays
from es_service.runs.selection import mean_interval, share_interval
from es_service.runs.verification import recomputed_certifications
from es_service.runs.view import open_run
from es_service.store import records
from es_service.store.codec import decode_part, encode_part
from es_service.store.schema import EXTENDED_SCHEMA, get_meta, put_meta
from es_service.store.writer import RunStore
from tests.database import database, execute
from tests.helpers import DirectEvaluator

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 60},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "map_elites", "batch": 16, "centres": 8},
    "map": {"cells": [6, 6]},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1},
    "seed": 4,
}

pytestmark = pytest.mark.usefixtures("workers_here")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, workers_here):
    """A run with two certifications, of two policies each."""
    folder = tmp_path_factory.mktemp("certified") / "run"
    run = api.run(api.load_config(CONFIG), folder, progress=False).run
    digest = run.digest()
    for _ in range(2):
        certify_run(folder, top=5, episodes=40, keep=2)
    return open_run(folder), digest


def episodes_of(config, policy, episodes, number, ask, domain) -> EpisodesResult:
    """Episodes of one policy, computed apart from any engine."""
    from es_service.config.workload import worker_spec

    task = task_of(config)
    direct = DirectEvaluator(worker_spec(config, task, certified_outputs(task)))
    parameters_D, mean_O, std_O = (x[None] for x in policy)
    asked = policy_work(
        parameters_D, (mean_O, std_O), episodes, seed=config.seed, generation=number, ask=ask, domain=domain
    )
    return gathered([asked.shape], [one for one in direct.evaluate(asked.work) if isinstance(one, EpisodesResult)])[0]


def selected(config, policies, number: int, keep: int) -> tuple[list[int], int]:
    """Reference implementation of the selection by return: ranks and environment steps."""
    returns: dict[int, list[float]] = {index: [] for index in range(len(policies))}
    left, episodes, ask, steps = list(returns), 16, 0, 0
    while len(left) > 1:
        for index in left:
            result = episodes_of(config, policies[index], episodes, number, ask, Domain.CANDIDATE_RESET)
            returns[index] += result.returns[0].tolist()
            steps += int(result.steps.sum())
        left.sort(key=lambda index: (-sum(returns[index]) / len(returns[index]), index))
        if len(left) <= keep:
            break
        left = left[: max(keep, math.ceil(len(left) / 2))]
        episodes, ask = 2 * episodes, ask + 1
    return left, steps


@pytest.mark.parametrize(("count", "keep"), [(1, 1), (2, 1), (2, 3), (7, 1), (7, 2)])
def test_selection_is_that_of_the_reference(count, keep):
    config = api.load_config(CONFIG)
    rng = np.random.default_rng(count)
    policies = rng.normal(size=(count, 2 * 8 + 8 + 8 * 2 + 2)).astype(np.float32)
    found = certify(policies, CONFIG, keep=keep, number=3, episodes=20)
    given = [(policy_D, np.zeros(2, np.float32), np.ones(2, np.float32)) for policy_D in policies]
    wanted, steps = selected(config, given, OTHER_PROGRAMS + 3, keep)
    assert [int(one.name) for one in found] == wanted
    assert [one.rank for one in found] == list(range(len(wanted)))
    assert {one.selection_steps for one in found} == {steps}
    for one in found:
        result = episodes_of(config, given[int(one.name)], 20, OTHER_PROGRAMS + 3, 0, Domain.CERTIFICATION_RESET)
        np.testing.assert_array_equal(one.episodes.return_E, result.returns[0])
        np.testing.assert_array_equal(one.episodes.goal_distance_E, result.goal_distance[0, :, 1])
        row = one.row()
        assert row["return_mean"] == pytest.approx(float(np.mean(result.returns[0], dtype=np.float64)))
        assert row["successes"] == int(result.outputs["success"][0].sum())


def test_equal_candidates_rank_in_the_order_given():
    policies = np.repeat(np.random.default_rng(0).normal(size=(1, 2 * 8 + 8 + 8 * 2 + 2)), 5, axis=0)
    assert [one.name for one in certify(policies, CONFIG, keep=3, episodes=16)] == ["0", "1", "2"]


def test_no_other_purpose_has_the_episodes_of_a_certification():
    """No seed of `evaluate`, no generation of a run and no round of a selection reaches their streams."""
    episode_E = np.arange(64)
    streams = {
        tuple(key)
        for domain in (
            Domain.EVALUATION_RESET,
            Domain.CANDIDATE_RESET,
            Domain.DECISION_RESET,
            Domain.CERTIFICATION_RESET,
        )
        for generation in (0, 1, 2, FRESH_GENERATION, FRESH_GENERATION + 1)
        for ask in (0, 1)
        for key in stream_keys(4, domain, generation, episode_E, 0, ask).tolist()
    }
    assert len(streams) == 4 * 5 * 2 * 64


def test_a_repeated_certification_has_new_episodes_and_all_are_listed(finished):
    run, _ = finished
    table = run.certified
    assert table[["certification", "rank"]].to_numpy().tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    first, *_, last = certified_policies(run.folder)
    assert not np.array_equal(first.episodes.return_E, last.episodes.return_E)
    assert (table["episodes"] == 40).all()
    elites = run.elites()[1].values()
    different = {elite.parameters_D.tobytes() for elite in elites} | {run.policy("best").parameters_D.tobytes()}
    assert len(different) == len(elites), "the best centre is an elite"
    assert (table["candidates"] == min(5, len(elites))).all()


def test_the_certified_policy_is_the_first_of_the_newest_selection(finished):
    run, _ = finished
    newest = next(one for one in certified_policies(run.folder) if (one.number, one.rank) == (1, 0))
    np.testing.assert_array_equal(run.policy("certified").parameters_D, newest.policy.parameters_D)


def test_it_changes_no_digest_and_a_fork_has_none(finished, tmp_path):
    run, digest = finished
    assert run.digest() == digest
    child = api.fork(run.folder, ["budget.generations=4"], out=tmp_path / "fork", progress=False).run
    assert child.certified.empty
    with pytest.raises(NotInRunError, match="no certified policy") as raised:
        child.policy("certified")
    assert raised.value.ways_out[0].call() == f"certify_run('{child.folder}')"
    assert [one.number for one in certify_run(child.folder, episodes=16)] == [2], "those of its parent have been seen"


def test_a_run_goes_on_with_its_certifications(finished, tmp_path):
    run, _ = finished
    shutil.copytree(run.folder, tmp_path / "run")
    more = api.resume(tmp_path / "run", ["budget.generations=5"], progress=False).run
    assert len(more.certified) == 4
    alone = api.run(api.load_config(CONFIG, ["budget.generations=5"]), tmp_path / "alone", progress=False).run
    assert more.digest() == alone.digest()


def test_the_same_episodes_again_have_the_same_bits(finished):
    run, _ = finished
    found = list(recomputed_certifications(run))
    assert [(one.differences, one.changes, one.not_judged) for one in found] == [((), [], "")] * 4


def test_what_has_changed_since_is_named(finished, monkeypatch):
    run, _ = finished
    monkeypatch.setattr(certification, "platform_info", lambda: {**platform_info(), "numpy": "99.0"})
    [first, *_] = recomputed_certifications(run)
    assert first.changes == [f"numpy {platform_info()['numpy']} -> 99.0"]


def test_a_changed_bit_is_seen_and_its_row_removed(finished, tmp_path):
    run, _ = finished
    shutil.copytree(run.folder, tmp_path / "run")
    with database(tmp_path / "run" / "run.db") as connection:
        [(payload,)] = connection.execute("SELECT payload FROM certification WHERE number = 1 AND rank = 1").fetchall()
        changed = bytes([*payload[:-1], payload[-1] ^ 1])
        connection.execute("UPDATE certification SET payload = ? WHERE number = 1 AND rank = 1", (changed,))
    damaged = open_run(tmp_path / "run")
    with pytest.raises(StoreError, match="row 1 of certification 1"):
        _ = damaged.certified
    with RunStore.open(tmp_path / "run") as store:
        assert "row 1 of certification 1" in store.notices[0]
    assert len(damaged.certified) == 3
    assert damaged.digest() == run.digest()
    execute(tmp_path / "run", "UPDATE certification SET facts = 'x' WHERE number = 1 AND rank = 0")
    with RunStore.open(tmp_path / "run") as store:
        assert store.next_certification == 2, "its episodes have been seen"
    again = certify_run(tmp_path / "run", top=5, episodes=40)
    assert [one.number for one in again] == [2]
    assert not any(one.differences for one in recomputed_certifications(damaged))


def test_a_certified_policy_is_stored_once_under_its_name(finished):
    run, _ = finished
    certified = certified_policies(run.folder)
    with database(run.folder / "run.db") as connection:
        stored = [name for (name,) in connection.execute("SELECT name FROM content")]
        sizes = [len(payload) for (payload,) in connection.execute("SELECT payload FROM certification")]
    for one in certified:
        assert stored.count(one.policy.name) == 1
        assert one.policy.spec == run.policy_spec
    assert {one.policy.name for one in certified} <= {elite.name for elite in run.elites()[1].values()}
    assert max(sizes) - min(sizes) < 64, "each has as many episodes, and only the name of its policy"


def test_the_certified_policies_of_a_run_of_version_0_27_have_no_names_and_are_read(finished, tmp_path):
    run, _ = finished
    folder, before = shutil.copytree(run.folder, tmp_path / "run"), certified_policies(run.folder)
    with database(folder / "run.db") as connection:
        put_meta(connection, "schema_version", "8")
        for number, rank, facts, payload in connection.execute(
            "SELECT number, rank, facts, payload FROM certification"
        ).fetchall():
            arrays = decode_part(payload)
            del arrays["policy"]
            (one,) = (one for one in before if (one.number, one.rank) == (number, rank))
            arrays |= {name: getattr(one.policy, name) for name in OF_POLICY}
            connection.execute("DELETE FROM certification WHERE number = ? AND rank = ?", (number, rank))
            row = number, rank, facts, encode_part(arrays)
            connection.execute(
                "INSERT INTO certification VALUES (?, ?, ?, ?, ?)", (*row, records._certified_sha256(*row))
            )
    after = certified_policies(folder)
    assert [(one.row(), one.policy.name) for one in after] == [(one.row(), one.policy.name) for one in before]
    certify_run(folder, top=5, episodes=40, keep=2)
    with database(folder / "run.db") as connection:
        assert get_meta(connection, "schema_version") == str(EXTENDED_SCHEMA), "an older version would delete a policy"
    assert [one.policy.name for one in certified_policies(folder)][:4] == [one.policy.name for one in before]


def test_another_policy_does_not_take_the_place_of_a_damaged_first(finished, tmp_path):
    run, _ = finished
    shutil.copytree(run.folder, tmp_path / "run")
    execute(tmp_path / "run", "UPDATE certification SET facts = 'x' WHERE number = 1 AND rank = 0")
    RunStore.open(tmp_path / "run").close()
    assert open_run(tmp_path / "run").certified[["certification", "rank"]].to_numpy().tolist() == [
        [0, 0],
        [0, 1],
        [1, 1],
    ]
    with pytest.raises(NotInRunError, match="no certified policy"):
        open_run(tmp_path / "run").policy("certified")


def test_nothing_is_stored_of_a_certification_that_fails(finished, monkeypatch):
    run, _ = finished

    def fails(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(certification, "halved", fails)
    with pytest.raises(KeyboardInterrupt):
        certify_run(run.folder)
    assert len(run.certified) == 4


def test_a_driver_keeps_others_from_certifying(finished):
    run, _ = finished
    with RunStore.open(run.folder), pytest.raises(RunLockedError, match="is being written by process"):
        certify_run(run.folder)


def test_after_an_error_of_the_store_the_certification_is_repeated(finished, tmp_path):
    run, _ = finished
    folder = shutil.copytree(run.folder, tmp_path / "run")
    (folder / "run.lock").unlink(missing_ok=True)
    (folder / "run.lock").mkdir()
    with pytest.raises(StoreError, match="locking") as caught:
        certify_run(folder)
    assert [(way.action, way.run) for way in caught.value.ways_out] == [("certify", str(folder))]


def test_candidates_are_the_best_centre_and_the_fittest_elites(finished):
    run, _ = finished
    names = {one.name for one in certify_run_without_storing(run, top=3)}
    fittest = run.map.sort_values("fitness", ascending=False, kind="stable").head(3)
    assert names == {"best", *(f"{x},{y}" for x, y in fittest[["cell_x", "cell_y"]].to_numpy())}


def certify_run_without_storing(run, **asked):
    from es_service.runs.evaluation import candidates

    return candidates(run, best=True, centre=False, cells=(), every=False, **asked)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed", "3"], "--seed and --certify cannot be combined"),
        (["--all"], "--all and --certify cannot be combined"),
        (["--by", "luck"], "choose return, last_reward, success, goal_distance"),
        (["--generation", "0"], "does not keep the state of generation 0"),
        (["--cell", "77,0"], "is not in the map"),
    ],
)
def test_wrong_options_say_what_to_do(finished, options, message):
    run, _ = finished
    result = CliRunner().invoke(app, ["evaluate", str(run.folder), "--certify", *options])
    assert message in str(result.exception)
    assert len(run.certified) == 4


def test_the_command_line_certifies_and_shows_it(finished, tmp_path):
    run, _ = finished
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder)
    asked = ["evaluate", str(folder), "--certify", "--top", "2", "--episodes", "20", "--by", "success", "--json"]
    [row] = json.loads(CliRunner().invoke(app, asked, catch_exceptions=False).stdout)
    assert row["certification"] == 2
    assert row["selected_by"] == "success"
    assert row["episodes"] == 20
    status = CliRunner().invoke(app, ["status", str(folder)], catch_exceptions=False).stdout
    policy = f"{row['policy']} of generation {row['generation']}"
    assert f"certified          {policy}: return {row['return_mean']:,.2f} [" in status
    assert "selected, not certified" in status
    verified = CliRunner().invoke(app, ["verify", str(folder), "--json"], catch_exceptions=False)
    assert [one["differences"] for one in json.loads(verified.stdout)["certified"]] == [[]] * 5
    es_service.write_report(folder, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert f"The certified policy, {policy}, has a mean return of" in page
    exported = CliRunner().invoke(app, ["export", str(folder), "--to", "csv", "--out", str(tmp_path / "out")])
    assert exported.exit_code == 0, exported.output
    assert len((tmp_path / "out" / "certified.csv").read_text().splitlines()) == 1 + 5
    certified = es_service.open_run(folder).policy("certified")
    np.testing.assert_array_equal(arrays(es_service.open_run(folder))["certified_parameters"], certified.parameters_D)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], (True, None)),
        (["--top", "2"], (True, 2)),
        (["--best"], (True, 0)),
        (["--centre"], (False, 0)),
        (["--centre", "--top", "3"], (False, 3)),
    ],
)
def test_the_command_line_certifies_the_best_centre_and_elites_unless_others_are_named(
    finished, monkeypatch, options, expected
):
    asked: list[dict] = []

    def noted(folder, **given):
        asked.append(given)
        raise NotInRunError("noted")

    monkeypatch.setattr(certification, "certify_run", noted)
    CliRunner().invoke(app, ["evaluate", str(finished[0].folder), "--certify", *options])
    assert [(given["best"], given["top"]) for given in asked] == [expected]


def test_there_must_be_something_to_certify(finished):
    run, _ = finished
    with pytest.raises(NotInRunError, match="no policy to certify; no candidate is named"):
        certify_run(run.folder, best=False, top=0)
    assert len(run.certified) == 4


@pytest.mark.parametrize("wrong", [{"episodes": 1}, {"keep": 0}, {"top": -1}, {"keep": 1.5}, {"by": "luck"}])
def test_wrong_numbers_are_refused_before_anything_runs(finished, monkeypatch, wrong):
    run, _ = finished
    monkeypatch.delattr(certification, "engine_here")
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        certify_run(run.folder, **wrong)


def test_wrong_arguments_are_named(finished):
    run, _ = finished
    with pytest.raises(ConfigError, match="parameters has the shape"):
        certify(np.zeros((3, 2)), CONFIG)
    with pytest.raises(ConfigError, match=r"parameters is no array .*; give the parameters_D of each policy"):
        certify([run.policy("best")], CONFIG)


def test_a_policy_has_a_name_or_a_place_that_may_be_an_array(finished):
    run, _ = finished
    place = run.map[["cell_x", "cell_y"]].to_numpy()[0]
    np.testing.assert_array_equal(run.policy(place).parameters_D, run.policy(tuple(place.tolist())).parameters_D)
    with pytest.raises(ConfigError, match=r"policy\('fittest'\): choose 'best'"):
        run.policy("fittest")


def test_the_call_in_a_page_that_python_writes_certifies_that_policy(tmp_path):
    run = api.run(CONFIG, tmp_path / "run", progress=False).run
    x, y = run.map[["cell_x", "cell_y"]].iloc[0]
    call = python_call(run.folder)
    names = ["best", "centre", f"{x},{y}"]
    for name in names if run.at().newest_centre is not None else [names[0], names[2]]:
        [policy] = eval(call(name).replace("top=0", "top=0, episodes=2"))
        assert policy.name == name


def test_intervals_are_those_of_the_tables():
    """Student's t with 2 degrees of freedom is 4.302653 at 97.5 %; Wilson's interval for 0 of 256 ends at
    z^2 / (256 + z^2)."""
    mean, low, high = mean_interval([1.0, 2.0, 3.0])
    assert mean == 2.0
    assert (low, high) == pytest.approx((2.0 - 4.302653 / math.sqrt(3.0), 2.0 + 4.302653 / math.sqrt(3.0)))
    assert np.isnan(mean_interval([5.0])[1:]).all()
    z2 = 1.959964**2
    assert share_interval(0, 256) == pytest.approx((0.0, z2 / (256 + z2)))
    assert (share_interval(0, 100)[0], share_interval(256, 256)[1]) == (0.0, 1.0)  # not nearly
    assert share_interval(256, 256) == pytest.approx((256 / (256 + z2), 1.0))
    assert share_interval(5, 10) == pytest.approx((0.236593, 0.763407), abs=1e-6)
