"""What a page says of a replay: that it is the stored episode, or why it is not. The bits: laws/test_readers.py."""

from __future__ import annotations

import base64
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pytest

from es_service import api
from es_service.errors import NotInRunError
from es_service.loop import finished
from es_service.protocol.recordings import Mesh, Scene, Shape
from es_service.report.replays import followed_link, goal_radius, is_floor, packed_mesh, reach_of
from es_service.report.write import write_report
from es_service.runs.certification import certify_run
from es_service.runs.replay import record

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 30},
    "policy": {"hidden": [8]},
    "search": {"algorithm": "map_elites", "batch": 20, "centres": 3, "iso_sigma": 0.2},
    "map": {"cells": [8, 8]},
    "budget": {"generations": 2},
    "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
}
UP, GREY = (1.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory, workers_here):
    return api.run(CONFIG, tmp_path_factory.mktemp("run") / "run").run


def page_of(run):
    [page] = write_report(run.folder)
    return page.read_text()


def replays_of(run):
    """Those of the best policy and of three elites that are older than a fork of the run."""
    old = run.map.query("generation <= 2")[["cell_x", "cell_y"]].head(3)
    return record(run, best=True, cells=list(old.itertuples(index=False, name=None)))[0]


def test_a_fork_with_another_seed_replays_what_its_parent_has_evaluated(run, tmp_path):
    fork = api.fork(run.folder, {"seed": 7, "budget.generations": 3}, out=tmp_path / "fork").run
    assert set(fork.evaluations["reset_seed"]) == {0, 7}
    assert [one.is_the_stored for one in replays_of(fork)] == [True] * 4


def test_a_fork_with_another_rollout_says_that_bits_may_differ(run, tmp_path):
    settings = {"compute.rollout": "xla", "compute.inline_workers": "processes", "budget.generations": 3}
    fork = api.fork(run.folder, settings, out=tmp_path / "fork").run
    _, *of_parent = replays_of(fork)
    assert [one.stored.changes for one in of_parent] == [("rollout simd -> xla",)] * 3
    again = api.fork(fork.folder, {"compute.rollout": "simd", "budget.generations": 4}, out=tmp_path / "again").run
    _, *of_both = replays_of(again)
    assert [one.stored.changes for one in of_both] == [("rollout simd or xla -> simd",)] * 3


def test_a_fork_in_which_fitness_means_something_else_has_no_stored_episode_of_the_best(run, tmp_path):
    fork = api.fork(run.folder, {"task.fitness": "final", "budget.generations": 3}, out=tmp_path / "fork").run
    stored = record(fork, best=True, cells=[])[0][0]
    assert (stored.stored is None) == (stored.candidate.generation < 3)
    ended = api.fork(run.folder, {"task.fitness": "final"}, out=tmp_path / "ended", on_notice=print).run
    page = page_of(ended)
    assert "have changed the meaning of fitness" in page
    assert 'class="problem' not in page


def test_a_replay_that_is_not_the_stored_episode_is_an_error_in_the_page(tmp_path, monkeypatch):
    table_of = finished.evaluated_table

    def wrong(*arguments, **named):
        table = table_of(*arguments, **named)
        return table | {"fitness_first": table["fitness_first"] + 1.0}

    monkeypatch.setattr(finished, "evaluated_table", wrong)
    page = page_of(api.run(CONFIG, tmp_path / "run").run)
    assert 'class="problem episode"' in page
    assert "This is not the stored episode, whose fitness is" in page
    assert "so this is an error; please report it" in page


@pytest.mark.slow
@pytest.mark.parametrize("fitness", ["sum", "final"])
def test_the_certified_policy_is_shown_in_its_certification_episode_of_median_fitness(tmp_path, fitness):
    config = {**CONFIG, "task": CONFIG["task"] | {"fitness": fitness}}
    run = api.run(config, tmp_path / "run").run
    with pytest.raises(NotInRunError, match="has no certified policy"):
        record(run, best=False, cells=[], certified=True)
    assert "certification" not in page_of(run)
    for number, episodes in enumerate((5, 20)):
        [certified] = certify_run(run.folder, episodes=episodes)
        one, best = record(run, best=True, cells=[], certified=True)[0]
        assert (one.is_the_stored, one.stored.certification, best.stored.certification) == (True, number, None)
        kept = certified.episodes
        fitness_E = kept.return_E if fitness == "sum" else kept.last_reward_E
        assert one.stored.fitness == sorted(fitness_E)[(episodes - 1) // 2]
    page = page_of(run)
    assert "of certification 1, which is the one of median fitness" in page
    assert page.count("bit for bit") == 2
    assert 'class="problem' not in page


def test_elites_are_of_the_generation_in_which_they_were_chosen_also_while_a_driver_writes(tmp_path):
    begun, goes_on = Event(), Event()

    def after(row):
        if row["generation"] == 2:
            begun.set()
            goes_on.wait(60)

    def choose(snapshot):
        goes_on.set()
        ended.result(60)
        return snapshot.behaviour_map.cell_N.tolist()

    with ThreadPoolExecutor(1) as driver:
        config = api.load_config(CONFIG, ["budget.generations=12"])
        ended = driver.submit(api.run, config, tmp_path / "run", on_generation=after)
        begun.wait(60)
        run = api.open_run(tmp_path / "run")
        before_map, before = run.elites()
        map_, elites = run.elites(choose)
    assert run.generation == 12
    np.testing.assert_array_equal(map_.centre_N, before_map.centre_N)
    then, now, later = (
        {cell: elite.parameters_D.tolist() for cell, elite in some.items()}
        for some in (before, elites, run.elites()[1])
    )
    assert now == then
    assert now != {cell: later[cell] for cell in now if cell in later}, "some have been replaced"


def test_a_replay_executes_code_that_a_config_names_only_if_that_is_trusted(tmp_path):
    config = {"task": {"environment": "gymnasium:Pendulum-v1", "episode_steps": 3, "descriptor": f"{__name__}:angle"}}
    config |= {"search": {"algorithm": "es", "pairs": 2}, "map": {"bounds": [[-1, 1]], "cells": [4]}}
    run = api.run(config | {"budget": {"generations": 1}, "compute": {"workers": 1}}, tmp_path / "run").run
    assert f"A replay would execute {__name__}:angle" in page_of(run)


def angle(episode):
    """A descriptor of an episode of Pendulum-v1."""
    return [float(np.clip(episode.observation_O[0], -1, 1))]


def shape(kind: str, link: int, size: tuple[float, ...], **named) -> Shape:
    return Shape(kind, link, size, **{"position": (0.0, 0.0, 0.0), "rotation": UP, "colour": GREY, **named})


def test_the_camera_follows_what_moves_from_as_far_as_it_reaches():
    """A robot of three links beside a post; a far wall, and a target that stays where it is, do not count."""
    poses_T_L_7 = np.zeros((3, 4, 7))
    poses_T_L_7[..., 3] = 1.0
    poses_T_L_7[:, 0, 0] = 50.0  # the post
    poses_T_L_7[:, 1, :2] = (1.0, 0.0), (1.1, 0.0), (1.2, 0.0)
    poses_T_L_7[:, 2, :2] = (1.5, 0.0), (1.5, 0.1), (1.5, 0.2)
    poses_T_L_7[:, 3, 1] = -20.0  # the target
    shapes = (
        shape("box", -1, (100.0, 1.0, 1.0)),
        shape("sphere", 0, (9.0, 0.0, 0.0)),
        shape("sphere", 1, (0.25, 0.0, 0.0)),
        shape("box", 2, (0.3, 0.4, 0.0), position=(0.0, 0.0, 1.0)),
        shape("sphere", 3, (7.0, 0.0, 0.0)),
    )
    assert followed_link(poses_T_L_7) == 1
    assert reach_of(poses_T_L_7, Scene(shapes, (), (), 0.1)) == pytest.approx(0.5 + 1.0 + 0.5)
    turns = poses_T_L_7[:1].repeat(3, axis=0)
    turns[:, 2, 3:] = (1.0, 0.0, 0.0, 0.0), (0.8, 0.6, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)
    assert followed_link(turns) == 2


def test_the_mark_of_a_goal_is_small_beside_an_arm_and_seen_from_afar():
    start_2 = np.zeros(2)
    assert goal_radius((0.5, 0.0), start_2, 1.0) == pytest.approx(0.06)
    assert 0.7 < goal_radius((60.0, 0.0), start_2, 1.2) < 0.8
    assert goal_radius((1e4, 0.0), start_2, 1.2) == pytest.approx(0.78)


def test_a_floor_is_a_plane_of_the_world_that_looks_up():
    tilted = (np.cos(0.3), np.sin(0.3), 0.0, 0.0)
    turned = (np.cos(0.3), 0.0, 0.0, np.sin(0.3))
    planes = {
        "flat": shape("plane", -1, (0.0, 0.0, 1.0)),
        "turned about z": shape("plane", -1, (0.0, 0.0, 1.0), rotation=turned),
        "tilted": shape("plane", -1, (0.0, 0.0, 1.0), rotation=tilted),
        "of a body": shape("plane", 0, (0.0, 0.0, 1.0)),
        "a box": shape("box", -1, (1.0, 1.0, 1.0)),
    }
    assert [name for name, plane in planes.items() if is_floor(plane)] == ["flat", "turned about z"]


def test_a_mesh_is_packed_in_steps_of_its_extent():
    vertices_V_3 = np.array([[0.0, 0.5, -0.25], [1e-3, 0.0, 0.0], [0.0, 0.0, 0.1]])
    mesh = packed_mesh(Mesh(vertices_V_3, np.array([[0, 1, 2]], np.int32)))
    places = np.frombuffer(base64.b64decode(mesh["vertices"]), "<i2").reshape(-1, 3) * mesh["unit"]
    np.testing.assert_allclose(places, vertices_V_3, atol=0.5 / 32767)
    assert np.frombuffer(base64.b64decode(mesh["triangles"]), "<u4").tolist() == [0, 1, 2]
