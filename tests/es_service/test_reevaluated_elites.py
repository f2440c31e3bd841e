"""The example whose elites are measured again: entries of its map change, move and leave, and their policies with them,
through kills, resumes and forks, and for everything that reads a run."""

from __future__ import annotations

import signal
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from es_service import api
from es_service.report.write import write_report
from es_service.runs import verification
from es_service.runs.export import export
from es_service.runs.replay import record
from tests.system.session import finish

pytestmark = pytest.mark.usefixtures("workers_here")
GENERATIONS = 30
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 40},
    "policy": {"hidden": [8]},
    "search": {
        "algorithm": "tests.examples.reevaluated_elites:reevaluated_elites",
        "pairs": 16,
        "sigma": 0.2,
        "step": {"learning_rate": 0.4},
        "evaluation_episodes": 1,
    },
    "map": {"enabled": True, "cells": [60, 60]},
    "budget": {"generations": GENERATIONS},
    "store": {"keep_every": 1, "commit_interval_s": 0},
    "compute": {"engine": "inline", "workers": 1},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory, workers_here):
    """A finished run; nobody changes it."""
    return api.run(api.load_config(CONFIG), tmp_path_factory.mktemp("run") / "whole").run


def maps(run):
    return [run.at(generation).behaviour_map for generation in range(GENERATIONS + 1)]


def origins(map_):
    """Cell of each entry, by the generation and the centre of its policy."""
    origin = zip(map_.generation_N.tolist(), map_.centre_N.tolist(), strict=True)
    return dict(zip(origin, map_.cell_N.tolist(), strict=True))


def test_elites_fall_move_and_leave(run):
    found = [origins(map_) for map_ in maps(run)]
    pairs = list(pairwise(found))
    moved = sum(before[one] != after[one] for before, after in pairs for one in before.keys() & after.keys())
    left = sum(len(before.keys() - after.keys()) for before, after in pairs)
    assert moved >= 3
    assert left >= 3
    counted = sum(int(count) for count in run.at().nodes["extra/left"].values())
    assert 0 < counted <= moved + left
    assert run.history["qd_score"].diff().min() < 0.0


def test_an_entry_is_the_mean_of_its_samples_wherever_it_is(run):
    """Every change of an entry by itself is that of a mean by a sample of the same policy."""
    table = run.evaluations.set_index(["generation", "centre"])
    several = 0
    for generation, (before, after) in enumerate(pairwise(maps(run)), 1):
        then = origins(before)
        for row, origin in enumerate(origins(after)):
            if origin not in then or after.samples_N[row] == 1:
                continue
            was = before.row_of(then[origin])
            new = after.samples_N[row] - before.samples_N[was]
            samples = table.loc[generation].query("centre >= 1")["fitness_mean"].to_numpy()
            means = (before.fitness_N[was] * before.samples_N[was] + samples) / (before.samples_N[was] + 1)
            assert new in (0, 1)
            expected = [before.fitness_N[was]] if new == 0 else means
            assert np.isclose(after.fitness_N[row], expected, rtol=1e-12).any()
            several += new
    assert several >= 20


def test_the_policy_of_an_elite_is_that_of_its_first_evaluation(run):
    centres = [run.at(generation).nodes["centres/0"]["centre_D"] for generation in range(GENERATIONS + 1)]
    for generation in (10, 20, GENERATIONS):
        map_, elites = run.elites(generation=generation)
        assert set(elites) == set(map_.cell_N.tolist())
        for cell, of, centre in zip(map_.cell_N.tolist(), map_.generation_N, map_.centre_N, strict=True):
            assert centre == 0
            np.testing.assert_array_equal(elites[cell].parameters_D, centres[of])


@pytest.mark.parametrize("stop", [1, 11, 12])
def test_a_resumed_run_and_a_fork_have_the_same_bits(run, tmp_path, stop):
    api.run(api.load_config(CONFIG, [f"budget.generations={stop}"]), tmp_path / "parts")
    api.resume(tmp_path / "parts", [f"budget.generations={stop + 5}"])
    assert api.resume(tmp_path / "parts", [f"budget.generations={GENERATIONS}"]).run.digest() == run.digest()
    assert api.fork(run.folder, generation=stop, out=tmp_path / "fork").run.digest() == run.digest()


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_bits(run, tmp_path):
    folder = tmp_path / "run"
    assert finish(folder, config=CONFIG, kill={"at": "before_commit", "nth": 9}) == -signal.SIGKILL
    assert finish(folder, kill={"at": "mid_transaction", "nth": 5}) == -signal.SIGKILL
    assert finish(folder) == 0
    assert api.open_run(folder).digest() == run.digest()


@pytest.mark.slow
def test_it_is_verified_reported_and_exported(run, tmp_path):
    assert all(not one.differences for one in verification.verify(run, 5))
    places = list(run.map[["cell_x", "cell_y"]].itertuples(index=False, name=None))[:4]
    assert all(replay.is_the_stored for replay in record(run, best=True, cells=places)[0])
    [page] = write_report(run.folder, out=tmp_path / "page.html", cells=places, trusted=True)
    assert 'class="problem' not in page.read_text()
    export(run, "csv", tmp_path / "csv")
    table = pd.read_csv(tmp_path / "csv" / "map.csv")
    assert table["samples"].tolist() == run.map["samples"].tolist()
    assert table["samples"].max() > 5
    export(run, "npz", tmp_path / "npz")
    with np.load(tmp_path / "npz" / "policies.npz") as arrays:
        assert arrays["samples"].tolist() == run.map["samples"].tolist()
