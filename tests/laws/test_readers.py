"""Every method with everything that reads a run, on one short run of each. A new method takes part by its name."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from es_service import api, plots
from es_service.cli.main import app
from es_service.errors import NotInRunError
from es_service.runs.lineage import started
from es_service.runs.replay import record
from es_service.search.algorithms import ALGORITHMS
from tests.helpers import workers_in_this_process

pytestmark = pytest.mark.usefixtures("workers_here")
GENERATIONS, EPISODES = 3, 3
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 40},
    "policy": {"hidden": [8, 8]},
    "search": {"evaluation_episodes": EPISODES},
    "map": {"enabled": True, "cells": [10, 10]},
    "budget": {"generations": GENERATIONS},
    "store": {"keep_every": 2},
    "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
}
OF_POPULATIONS = {"pairs": 16, "sigma": 0.2}
SETTINGS = {
    "map_elites": {"batch": 20, "iso_sigma": 0.2, "centres": 3},
    "me_es": {**OF_POPULATIONS, "emitters": 2, "block_generations": 2},
    "memes": {**OF_POPULATIONS, "emitters": 3, "stagnation_generations": 1},
    "jedi": {**OF_POPULATIONS, "emitters": 2, "target_generations": 2},
    "tests.laws.test_policies:mixed": {**OF_POPULATIONS, "centres": 2},
}
"""Settings of a method; others have those of populations."""
POLISHED = {**OF_POPULATIONS, "screened": 3, "candidates": 2, "round_generations": 2}
MEASURED_AGAIN = "map_elites, elites measured again"
VARIANTS = {
    MEASURED_AGAIN: (
        "map_elites",
        {"search": {"elites": {"kind": "eme", "depth": 2}}, "map": {"correct_every": 2, "correct_episodes": 2}},
    )
}
"""Name -> method and settings of its runs besides those of the method."""
QUICK = ("es", "map_elites", "memes")
"""Methods that `make quick` tries, too."""
METHODS = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in (*ALGORITHMS, "tests.laws.test_policies:mixed", *VARIANTS)
]


@cache
def parent():
    """Folder of a finished run, for methods that start from policies of another one."""
    with workers_in_this_process():
        folder = Path(tempfile.mkdtemp()) / "parent"
        atexit.register(shutil.rmtree, folder.parent)
        return str(api.run(config_of("nsr_es"), folder).run.folder)


def config_of(method, **more):
    method, changes = VARIANTS.get(method, (method, {}))
    settings = SETTINGS.get(method, OF_POPULATIONS)
    if ALGORITHMS[method].settings.needs_start:
        settings = POLISHED | {"init_from": parent()}
    search = {**CONFIG["search"], "algorithm": method, **settings, **changes.get("search", {})}
    return CONFIG | {"search": search, "map": CONFIG["map"] | changes.get("map", {})} | more


@pytest.fixture(scope="module", params=METHODS)
def run(request, tmp_path_factory, workers_here):
    """A finished run of a method; nobody changes it."""
    return api.run(config_of(request.param), tmp_path_factory.mktemp("run") / "first").run


@pytest.fixture
def copy(run, tmp_path):
    """A copy of it."""
    shutil.copytree(run.folder, tmp_path / "copy")
    return tmp_path / "copy"


def es(*words):
    """What a command prints; it ends without an error."""
    result = CliRunner().invoke(app, [*map(str, words)])
    assert result.exit_code == 0, (words, result.output, result.exception)
    return result.stdout


def updates_centres(run):
    return bool((run.evaluations.query("generation == @GENERATIONS")["centre"] < run.constants["search.centres"]).any())


def places(run, count=3):
    """The first cells that were filled, and the one filled last."""
    found = list(run.map[["cell_x", "cell_y"]].itertuples(index=False, name=None))
    return list(dict.fromkeys([*found[:count], found[-1]]))


def test_every_policy_is_the_one_that_was_evaluated(run):
    observation = np.array([[0.1, -0.8], [0.3, 0.2]], np.float32)
    for which in ("best", *places(run)):
        assert np.abs(run.policy(which)(observation)).max() <= 1.0
    elite = run.elite(places(run)[-1])
    np.testing.assert_array_equal(run.policy(places(run)[-1]).parameters_D, elite.parameters_D)
    if updates_centres(run):
        rows = run.evaluations.query("generation == @GENERATIONS and centre < @run.constants['search.centres']")
        fittest = int(rows.loc[rows["fitness_mean"].idxmax(), "centre"])
        centre_D = run.at().nodes[f"centres/{fittest}"]["centre_D"]
        np.testing.assert_array_equal(run.policy("centre").parameters_D, centre_D)
    else:
        with pytest.raises(NotInRunError, match="has no newest centre: its generation 3 evaluated only policies"):
            run.policy("centre")


def test_replays_are_the_stored_episodes_bit_for_bit(run):
    cells = places(run, 6)
    replays, _ = record(run, best=True, cells=cells)
    assert [one.stored is not None and one.is_the_stored for one in replays] == [True] * (1 + len(cells))


def test_a_report_shows_it_without_problems(run, tmp_path):
    cells = [word for place in places(run) for word in ("--replay", ",".join(map(str, place)))]
    trusted = ["--replay", "best", *cells]
    es("report", run.folder, "--out", tmp_path / "page.html", *trusted)
    page = (tmp_path / "page.html").read_text()
    assert 'id="replay"' in page
    assert 'class="problem' not in page


def test_plots_draw_it(run):
    from matplotlib.figure import Figure

    axes = Figure().subplots(2, 2).ravel()
    plots.behaviour_map(run, axes[0])
    plots.trajectory(run, axes[1])
    plots.centres(run, axes[2])
    plots.curves([run.folder], axes[3])
    assert all(one.has_data() for one in axes)


def test_status_and_digest_tell_of_it(run):
    assert "finished" in es("status", run.folder)
    [status] = json.loads(es("status", run.folder, "--json"))
    assert status["newest"]["generation"] == GENERATIONS
    assert es("digest", run.folder).split() == [run.digest()]


def test_fresh_episodes_of_each_policy(run):
    kinds = ["--best", "--all"] + ["--centre"] * updates_centres(run)
    rows = json.loads(es("evaluate", run.folder, *kinds, "--episodes", 2, "--json"))
    assert len(rows) == len(kinds) - 1 + len(run.map)
    assert np.isfinite([[row["stored_fitness"], row["fresh_fitness"]] for row in rows]).all()
    by_name = {row["policy"]: row for row in rows}
    assert by_name["best"]["stored_fitness"] == run.history["best_fitness"].iloc[-1]
    if updates_centres(run):
        of_centres = run.evaluations.query("generation == @GENERATIONS and centre < @run.constants['search.centres']")
        assert by_name["centre"]["stored_fitness"] == of_centres["fitness_mean"].max()
    else:
        result = CliRunner().invoke(app, ["evaluate", str(run.folder), "--centre"])
        assert isinstance(result.exception, NotInRunError)
    one = ",".join(map(str, places(run)[-1]))
    assert json.loads(es("evaluate", run.folder, "--cell", one, "--episodes", 2, "--json")) == [by_name[one]]


@pytest.mark.slow
def test_every_export_has_all_of_it(run, tmp_path):
    from ribs.archives import GridArchive  # noqa: F401 (its pickle needs it)

    for form in ("csv", "parquet", "npz", "ribs"):
        es("export", run.folder, "--to", form, "--out", tmp_path / form)
    for table, rows in (("history", GENERATIONS + 1), ("evaluations", len(run.evaluations)), ("map", len(run.map))):
        assert len(pd.read_csv(tmp_path / "csv" / f"{table}.csv")) == rows
        assert len(pd.read_parquet(tmp_path / "parquet" / f"{table}.parquet")) == rows
    with np.load(tmp_path / "npz" / "policies.npz") as arrays:
        np.testing.assert_array_equal(arrays["best_parameters"], run.policy("best").parameters_D)
        assert len(arrays["parameters"]) == len(run.map)
        assert ("centre_parameters" in arrays) == updates_centres(run)
    assert pd.read_pickle(tmp_path / "ribs" / "archive.pickle").stats.num_elites == len(run.map)


def test_it_is_verified_and_continued_with_the_same_bits(run, copy, tmp_path):
    assert json.loads(es("verify", run.folder, "--generations", 9, "--json"))["equal"]
    further = [f"budget.generations={GENERATIONS + 1}"]
    resumed = api.resume(copy, further).run
    assert api.fork(run.folder, further, out=tmp_path / "fork").run.digest() == resumed.digest()


def test_other_runs_start_from_its_policies(run):
    place = places(run)[-1]
    for written, which in (("", "centre"), (":best", "best"), (":" + ",".join(map(str, place)), place)):
        start = f"{run.folder}{written}"
        config = api.load_config(config_of("es"), {"search.init_from": start})
        if which == "centre" and not updates_centres(run):
            with pytest.raises(NotInRunError, match="has no newest centre"):
                started(config, start, print)
            continue
        lineage, beginning = started(config, start, print)
        assert lineage["run_id"] == run.run_id
        np.testing.assert_array_equal(beginning.start["centre_D"], run.policy(which).parameters_D)
