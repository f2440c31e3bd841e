"""What a fork, or a run that starts from another, takes from it, what it leaves behind, what it refuses."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from es_service import api, open_run
from es_service.cli.common import error_message
from es_service.config import tasks
from es_service.config.changes import START_KEYS, start_afresh
from es_service.errors import ConfigError, NotInRunError
from es_service.protocol.options import choice
from es_service.report.data import read_run
from es_service.report.summary import verdict
from es_service.runs import checked_config, engine, evaluation, lineage, sessions
from es_service.runs.engine import dispatch_limits
from es_service.runs.run_status import more, read_status
from es_service.store import reader
from es_service.store.digest import digest_at
from es_service.store.reader import read_generation
from tests.helpers import map_of
from tests.system.command_line import digest, es
from tests.system.session import ROOT, SMALL, finish
from workers.environments import SHIPPED

pytestmark = pytest.mark.usefixtures("workers_here")


def run(folder: Path, *overrides: str, config=SMALL):
    return api.run(api.load_config(config, overrides), folder).run


def fork(parent, folder: Path, *overrides: str):
    return api.fork(parent.folder, overrides, out=folder).run


@pytest.fixture(scope="module")
def parent(tmp_path_factory, workers_here):
    """Six generations of nsra_es."""
    return run(tmp_path_factory.mktemp("parent") / "run", "budget.generations=6")


def test_a_record_of_another_fitness_does_not_hold_the_weight_down(tmp_path):
    """Sums of rewards are far below the last reward alone: against its record nothing would ever be an improvement."""
    parent = run(tmp_path / "parent", "task.fitness=final", "budget.generations=6")
    before = parent.at().nodes["weight"]
    forked = fork(parent, tmp_path / "fork", "task.fitness=sum", "budget.generations=8")
    after, history = forked.at().nodes["weight"], forked.history
    assert before["value"] < 1.0
    assert after["record"] == history["centre_fitness_mean"].iloc[7:].max() < before["record"]
    assert history["fitness_weight"].iloc[7] == before["value"] < history["fitness_weight"].iloc[8]


@pytest.mark.parametrize(("algorithm", "weight"), [("ns_es", 0.0), ("nsr_es", 0.5), ("nsra_es", 0.75)])
def test_searches_with_the_same_state_may_follow_one_another(tmp_path, algorithm, weight):
    other = "nsra_es" if algorithm == "nsr_es" else "nsr_es"
    settings = ["search.centres=3", "budget.generations=4"]
    parent = api.run(api.load_config(SMALL, [f"search.algorithm={other}", *settings]), tmp_path / "parent").run
    wanted = [f"search.algorithm={algorithm}", "budget.generations=6"]
    wanted += ["search.fitness_weight_start=0.75"] if algorithm == "nsra_es" else []
    child = api.fork(parent.folder, wanted, out=tmp_path / "child").run
    assert child.constants["search.centres"] == 3
    rows = child.history
    for column in ("env_steps", "centre_fitness_mean", "fitness_weight"):
        assert rows.loc[:4, column].tolist() == parent.history[column].tolist()
    assert rows.loc[5, "fitness_weight"] == weight
    assert rows.loc[5, "archive_size"] == rows.loc[4, "archive_size"] + 1
    before, after = parent.at().nodes, child.at(5).nodes
    moved = int(rows.loc[5, "centre"])
    for index in {0, 1, 2} - {moved}:
        assert (after[f"centres/{index}"]["centre_D"] == before[f"centres/{index}"]["centre_D"]).all()
    with pytest.raises(ConfigError, match="would have no effect"):
        lineage.fork_config(parent.folder, [f"search.algorithm={other}", "search.fitness_weight_start=0.75"])
    with pytest.raises(ConfigError) as refused:
        api.resume(parent.folder, [f"search.algorithm={algorithm}"])
    assert refused.value.way_out is not None
    assert refused.value.way_out.settings["search.algorithm"] == algorithm


@pytest.mark.parametrize(
    ("before", "wanted"),
    [
        (["search.algorithm=memes"], "search.exploit_generations=2"),
        (["search.algorithm=memes", "search.stagnation_generations=1"], "search.starts=least_tried"),
        (["search.algorithm=me_es", "search.block_generations=2"], "search.cell_sampling=least_tried"),
    ],
)
def test_a_setting_that_counts_begins_to_count_in_the_fork(tmp_path, before, wanted):
    config = SMALL | {"search": {"pairs": 8, "evaluation_episodes": 1, "emitters": 2}}
    parent = api.run(api.load_config(config, [*before, "budget.generations=3"]), tmp_path / "parent").run
    child = api.fork(parent.folder, [wanted, "budget.generations=9"], out=tmp_path / "child").run
    assert child.generation == 9
    whole = api.fork(parent.folder, [wanted, "budget.generations=5"], out=tmp_path / "pieces").run
    assert api.resume(whole.folder, ["budget.generations=9"]).run.digest() == child.digest()


@pytest.mark.parametrize(
    ("override", "change"),
    [
        ("policy.hidden=[16]", "policy.hidden: [8] -> [16]"),
        ("search.algorithm=es", "search.algorithm: nsra_es -> es"),
        ("search.centres=3", "search.centres: 5 -> 3"),
        ("task.environment=ant_trap", "task.environment: point_maze -> ant_trap"),
        ("map.kind=cvt", "map.kind: grid -> cvt"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(parent, override, change):
    with pytest.raises(ConfigError) as caught:
        lineage.fork_config(parent.folder, [override, "budget.generations=9"])
    assert f"  {change}" in str(caught.value).splitlines()
    assert caught.value.way_out == start_afresh(parent.folder)
    assert error_message(caught.value).endswith(f": es-service run CONFIG --set search.init_from={parent.folder}:best")


def use_tasks(monkeypatch, known):
    """Let configs find these tasks."""
    monkeypatch.setattr(tasks, "TASKS", known)
    monkeypatch.setattr(checked_config, "KNOWN", checked_config.KNOWN._replace(tasks=known))


class Told(tasks.Tasks):
    """Tasks of which PointMaze is told to be another one."""

    def __init__(self, point_maze):
        self.point_maze = point_maze

    def chosen(self, name, options, choices):
        return self.point_maze if name == "point_maze" else super().chosen(name, options, choices)


def test_another_descriptor_is_refused(tmp_path, monkeypatch):
    """One of as many dimensions: a novelty archive of both would mean nothing."""
    bounds = SHIPPED["point_maze"].descriptor_bounds
    told = replace(
        SHIPPED["point_maze"],
        options={"descriptor": choice("place", "speed", "height")},
        descriptors={
            "place": (("x", "y"), bounds), "speed": (("u", "v"), bounds), "height": (("h",), bounds[:1])
        },
    )  # fmt: skip
    use_tasks(monkeypatch, Told(told))

    def work(*_, **__):  # as workers know of no such option
        yield from ()
        return api.Outcome(api.open_run(tmp_path / "run"), "", True)

    monkeypatch.setattr(sessions, "work", work)
    api.run(SMALL, tmp_path / "run")
    assert (
        lineage.fork_config(tmp_path / "run", ["task.options.descriptor=place"]).task.options["descriptor"] == "place"
    )
    for other in ("speed", "height"):
        with pytest.raises(ConfigError, match=rf"task\.options\.descriptor: place -> {other}\n[^$]*search\.init_from"):
            lineage.fork_config(tmp_path / "run", [f"task.options.descriptor={other}"])
    use_tasks(monkeypatch, Told(replace(told, descriptors={"place": (("a", "b"), bounds)})))
    with pytest.raises(ConfigError, match=r"the descriptor of point_maze: \[x, y\] -> \[a, b\]\n.*search\.init_from"):
        lineage.fork_config(tmp_path / "run")


def test_a_task_whose_sizes_have_changed_is_refused_by_resume_too(parent, monkeypatch):
    """A user's own, edited: the same parameters would mean another network."""
    other = replace(SHIPPED["point_maze"], action_size=3)
    use_tasks(monkeypatch, Told(other))
    with pytest.raises(ConfigError, match=r"point_maze has changed since the run was created \(action_size: 2 -> 3\)"):
        api.resume(parent.folder, ["budget.generations=7"])
    with pytest.raises(ConfigError, match=r"the network's layers: \[2, 8, 2\] -> \[2, 8, 3\]\n.*search\.init_from"):
        lineage.fork_config(parent.folder)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"descriptor_names": ("x", "z")}, r"descriptor_names: \[x, y\] -> \[x, z\]"),
        ({"has_goal": False}, "has_goal: true -> false"),
    ],
)
def test_a_task_with_other_columns_is_no_other_version(parent, monkeypatch, change, told):
    use_tasks(monkeypatch, Told(replace(SHIPPED["point_maze"], **change)))
    with pytest.raises(ConfigError, match=rf"the task point_maze has changed since the run was created \({told}\)"):
        api.resume(parent.folder, ["budget.generations=7"])


def test_a_fork_whose_budget_is_spent_says_so(parent, tmp_path):
    told: list[str] = []
    forked = api.fork(parent.folder, ["search.sigma=0.1"], out=tmp_path / "fork", on_notice=told.append).run
    assert forked.generation == 6
    (notice,) = told
    assert notice.startswith("no generation was run: the budget of 6 generations is spent already at generation 6")
    assert more(read_status(forked)) == {"budget.generations": 12}
    api.resume(forked.folder, ["budget.generations=7"], on_notice=told.append)
    assert (forked.generation, len(told)) == (7, 1)


@pytest.mark.parametrize("key", START_KEYS)
def test_what_would_change_nothing_is_refused(parent, key):
    with pytest.raises(ConfigError) as caught:
        lineage.fork_config(parent.folder, [f"{key}=uber", "search.sigma=0.1"])
    assert f"  {key}" in str(caught.value).splitlines()
    assert caught.value.way_out == start_afresh(parent.folder)


def test_without_normalisation_no_statistics_are_used_nor_a_centre_s_own(parent, tmp_path):
    """Whose block began from an elite that brought its own, and goes on in the fork; their bound goes with them."""
    search = {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "parent_statistics": "elite"}
    wanted = ("search.block_generations=8", f"search.init_from={parent.folder}", "budget.generations=6")
    begun = run(tmp_path / "begun", *wanted, config=SMALL | {"search": search})
    assert "own_std_O" in begun.at().nodes["centres/0"]
    assert (begun.policy("centre").observation_std_O != 1.0).all()
    forked = fork(begun, tmp_path / "fork", "policy.observation_normalization=false", "budget.generations=7")
    assert forked.constants["policy.observation_clip"] is None
    _, elites = forked.elites()
    centre = forked.policy("centre")
    for policy in (centre, *elites.values()):
        np.testing.assert_array_equal(policy.observation_mean_O, 0.0)
        np.testing.assert_array_equal(policy.observation_std_O, 1.0)
    assert len(elites) == 1
    kept, gone = (
        lineage.forked(begun, lineage.fork_config(begun.folder, overrides), None)[1].parts["centres/0"]
        for overrides in ([], ["search.parent_statistics=global"])
    )
    assert kept.keys() - gone.keys() == {"own_mean_O", "own_std_O"}


def test_a_start_from_a_run_that_did_not_normalise_takes_no_statistics(parent, tmp_path):
    """Which it has gathered, and its policy never saw."""
    told: list[str] = []
    raw = run(tmp_path / "raw", "policy.observation_normalization=false", "budget.generations=2")
    assert raw.at().nodes["observations"]["count"] > 0

    def start(origin, *overrides):
        wanted = api.load_config(SMALL, [f"search.init_from={origin.folder}", *overrides])
        found = lineage.started(wanted, str(origin.folder), told.append)[1].start
        assert found is not None
        return found

    begun = start(raw, "policy.observation_clip=null")
    assert (begun["count"], told) == (0.0, [])
    np.testing.assert_array_equal(begun["centre_D"], raw.policy("centre").parameters_D)
    assert start(parent)["count"] > 0
    assert told == []
    for origin, overrides, change in (
        (raw, [], "policy.observation_clip: null -> 5.0"),
        (parent, ["policy.observation_normalization=false"],
         "policy.observation_clip: 5.0 -> null, policy.observation_normalization: true -> false"),
    ):  # fmt: skip
        start(origin, *overrides)
        assert f"this run processes observations differently from {origin.folder} ({change})" in told.pop()


def test_what_a_resume_has_changed_is_so_for_a_fork_and_an_evaluation(parent, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    shutil.copytree(parent.folder, folder)
    recorded = folder / "config.yaml"
    recorded.write_text(recorded.read_text().replace("engine: inline", "engine: ray"))  # as a cluster's run has it
    assert lineage.fork_config(folder).compute.engine == "ray"
    run = api.resume(folder, ["budget.generations=7", "compute.engine=inline", "compute.compile_timeout_s=77"]).run
    config = lineage.fork_config(folder, ["search.sigma=0.1"])
    assert (config.budget.generations, config.compute.engine, config.compute.compile_timeout_s) == (7, "inline", 77.0)
    seen = []
    monkeypatch.setattr(
        engine, "dispatch_limits", lambda config, most: seen.append(config) or dispatch_limits(config, most)
    )
    list(evaluation.evaluate(run, [], episodes=1, workers=1))
    assert seen[0].compute.compile_timeout_s == 77.0
    recorded.unlink()
    assert lineage.fork_config(folder).budget.generations == 6, "as it was created"


def test_a_history_comes_along_in_pieces(parent, tmp_path, monkeypatch, noticed):
    """All at once, that of a night takes gigabytes."""
    monkeypatch.setattr(lineage, "ROWS_AT_ONCE", 4)
    read = reader.read_history
    lengths = []

    def counted(*arguments):
        lengths.append(len(rows := read(*arguments)))
        return rows

    monkeypatch.setattr(reader, "read_history", counted)
    child = fork(parent, tmp_path / "fork")
    assert noticed[-1].startswith("note: no generation was run")
    assert lengths == [4, 3]
    assert child.digest() == parent.digest()


def test_scores_of_a_population_that_was_luckier_or_less_are_forgotten(tmp_path):
    """They are the highest fitness of all its members, whose number, noise and episodes decide how high that gets."""
    search = {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "cell_sampling": "score"}
    parent = run(tmp_path / "parent", "budget.generations=4", config=SMALL | {"search": search})
    assert np.isfinite(parent.behaviour_map.score_N).any()
    known = parent.behaviour_map.score_N
    for override, same in (
        ("search.step.learning_rate=0.1", True), ("task.episodes_per_member=3", False), ("search.pairs=32", False),
        ("search.sigma=0.5", False), ("policy.action_noise=0", False),
    ):  # fmt: skip
        config = lineage.fork_config(parent.folder, [override])
        scores = map_of(lineage.forked(parent, config, None)[1].parts).score_N
        np.testing.assert_array_equal(scores, known if same else known * np.nan)


def test_fork_without_changes_goes_on_as_its_parent_would(config, finished, tmp_path):
    parent, child = tmp_path / "parent", tmp_path / "child"
    assert es("run", config, "--out", parent, "--set", "budget.generations=10")[0] == 0
    for generation in ([], ["--generation", 9]):
        code, printed = es("fork", parent, *generation, "--out", child, "--set", "budget.generations=30")
        assert code == 0
        assert "is computed" not in printed  # the same machine: no other platform to tell of
        assert digest(child) == digest(finished[0])
        origin = open_run(child).meta.parent
        assert origin is not None
        at = generation[1] if generation else 10
        assert (origin["generation"], origin["digest"]) == (at, digest_at(parent, at))
        assert re.search(rf"started from\s+{parent}, generation", es("status", child)[1].replace("\n", ""))
        child = tmp_path / "child9"


def test_fork_with_changes_and_from_a_generation_that_is_not_kept(finished, tmp_path):
    more = ("--set", "budget.generations=32")
    code, _ = es("fork", finished[0], "--out", tmp_path / "a", "--set", "search.pairs=24", *more)
    assert code == 0
    assert open_run(tmp_path / "a").config["search"]["pairs"] == 24
    assert len(open_run(tmp_path / "a").history) == 33
    code, printed = es("fork", finished[0], "--generation", 3, "--out", tmp_path / "c", *more)
    assert code == 1
    assert "it keeps the states of generations [29, 30]" in printed
    assert not (tmp_path / "c").exists()


def test_init_from_starts_at_the_other_run_s_centre(config, finished, tmp_path):
    code, printed = es("run", config, "--out", tmp_path / "r", "--set", f"search.init_from={finished[0]}",
                       "--set", "budget.target_fitness=-1e9", "--set", "search.sigma=0.01")  # fmt: skip
    assert code == 0, printed
    child, parent = open_run(tmp_path / "r"), open_run(finished[0])
    assert child.generation == 0
    parts = child.at().nodes
    assert (parts["observations"]["m2_O"] == parent.at().nodes["observations"]["m2_O"]).all()
    for centre in range(5):
        assert (parts[f"centres/{centre}"]["centre_D"] == parent.policy("centre").parameters_D).all()
    assert child.meta.parent is not None
    assert child.meta.parent["digest"] == digest(finished[0])
    code, printed = es("run", config, "--out", tmp_path / "s", "--set", f"search.init_from={finished[0]}",
                       "--set", "policy.hidden=[16]")  # fmt: skip
    assert code == 2
    assert "has layers [2, 8, 2], this run's policy has [2, 16, 2]" in printed
    assert not (tmp_path / "s").exists()


def test_init_from_the_best_centre_or_a_cell_s_elite(tmp_path):
    """With the statistics that each was evaluated with; and `RUN` alone is still the centre updated last."""
    mapping = SMALL | {"map": {"enabled": True, "cells": [4, 4]}, "budget": {"generations": 5}}
    origin = api.run(mapping, tmp_path / "origin").run
    place = tuple(origin.map[[name for name in origin.map if name.startswith("cell_")]].iloc[-1])
    for which, wanted in (("best", "best"), (",".join(map(str, place)), place)):
        setting = {"search.init_from": f"{origin.folder}:{which}", "budget.generations": 1}
        child = api.run(api.load_config(mapping, setting), tmp_path / f"from_{which}").run
        assert child.generation == 1
        policy = origin.policy(wanted)
        kept = api.run(api.load_config(mapping, setting | {"budget.generations": None, "budget.target_fitness": -1e9}),
                       tmp_path / f"at_{which}").run.at().nodes  # fmt: skip
        for index in range(child.constants["search.centres"]):
            assert (kept[f"centres/{index}"]["centre_D"] == policy.parameters_D).all()
        observed = kept["observations"]
        assert observed["count"] > 0
        np.testing.assert_array_equal(observed["mean_O"].astype(np.float32), policy.observation_mean_O)
        std_O = np.sqrt(observed["m2_O"] / observed["count"])
        np.testing.assert_allclose(std_O, policy.observation_std_O, rtol=1e-6)
        assert child.config["search"]["init_from"] == f"{origin.folder}:{which}"
    with pytest.raises(NotInRunError, match="cell 9,9 is not in the map"):
        api.run(api.load_config(mapping, {"search.init_from": f"{origin.folder}:9,9"}), tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(ConfigError, match=r"no_run does not exist; must be the folder of another run"):
        api.load_config(mapping, {"search.init_from": f"{tmp_path}/no_run:best"})


def test_init_from_keeps_what_it_started_from(config, finished, tmp_path):
    """The other run goes on, or away; a run that began from it and died at once is resumed to the same digest."""
    origin, whole, killed = tmp_path / "origin", tmp_path / "whole", tmp_path / "killed"
    shutil.copytree(finished[0], origin)
    mapping = yaml.safe_load(config.read_text())
    mapping["search"]["init_from"] = str(origin)
    mapping["budget"]["generations"] = 5
    assert finish(whole, config=mapping) == 0
    assert finish(killed, config=mapping, kill={"at": "opened"}) == -signal.SIGKILL
    assert read_generation(killed) is None
    shutil.rmtree(origin)
    assert es("resume", killed)[0] == 0
    assert digest(killed) == digest(whole)


def test_a_fork_killed_at_once_is_its_parent_s_state_already(config, finished, tmp_path):
    parent, child = tmp_path / "parent", tmp_path / "child"
    assert es("run", config, "--out", parent, "--set", "budget.generations=10")[0] == 0
    process = subprocess.run(
        [sys.executable, "-c", "import os, signal; from es_service import api\n"
         f"api.fork({str(parent)!r}, ['budget.generations=30'], out={str(child)!r}, "
         "hook=lambda name: os.kill(os.getpid(), signal.SIGKILL))"],
        cwd=ROOT, timeout=60, check=False,
    )  # fmt: skip
    assert process.returncode == -signal.SIGKILL
    assert read_generation(child) == 10
    assert es("resume", child)[0] == 0
    assert digest(child) == digest(finished[0])


def test_a_fork_with_another_fitness_forgets_the_best_of_before(finished, tmp_path):
    more = ("--set", "budget.generations=32")
    assert es("fork", finished[0], "--out", tmp_path / "a", "--set", "task.fitness=final", *more)[0] == 0
    history = open_run(tmp_path / "a").history
    assert history["best_fitness"].iloc[-1] == history["centre_fitness_mean"].iloc[31:].max()


def test_before_its_first_generation_a_fork_that_forgets_has_no_best_centre_in_its_report(parent, tmp_path):
    child = api.fork(parent.folder, ["task.options.start=corner"], out=tmp_path / "child", on_notice=[].append).run
    assert child.generation == 6
    assert verdict(read_run(child.folder)).startswith("The best centre is not known yet: with the settings")
