"""Runs of strangers: right SHA-256s, wrong contents. Every reader gives an answer or one sentence, and no other run
suffers."""

from __future__ import annotations

import contextlib
import io
import random
import re
import shutil
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from es_service import api, load_config
from es_service.cli.main import app
from es_service.errors import ConfigError, ServiceError, StoreError
from es_service.loop.blocks import ARCHIVE, BEST, OBSERVATIONS
from es_service.loop.forms import Sizes, problem
from es_service.protocol.content import NAME
from es_service.report.data import read_run
from es_service.report.measures import GAP, with_derived
from es_service.report.page import run_page
from es_service.runs.certification import certify_run
from es_service.runs.evaluation import candidates
from es_service.runs.lineage import started
from es_service.runs.verification import verify
from es_service.search.algorithms.base import Ask
from es_service.search.algorithms.common import first_state, step_centre
from es_service.watch.pages import draw_comparison, draw_list, draw_run, metrics
from es_service.watch.runs import RunReading, Runs
from tests.es_service.forgeries import forge

LONGEST_S = 10.0
"""Seconds of the processor that a reader may take."""
SMALL = {
    "task": {"environment": "point_maze", "episode_steps": 10},
    "policy": {"hidden": [4]},
    "map": {"cells": [4, 4]},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
}
METHODS: dict[str, dict[str, Any]] = {
    "es": {"search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 2}},
    "me_es": {"search": {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 2, "emitters": 2}},
    "map_elites": {"search": {"algorithm": "map_elites", "batch": 16, "elites": {"kind": "eme", "depth": 2}}},
    "memes": {
        "search": {"algorithm": "memes", "pairs": 16, "emitters": 2, "evaluation_episodes": 2},
        "map": {"kind": "cvt", "cells": [20]},
    },
}
OTHER = "an honest run"


def command(*words: object) -> None:
    """Run a command, which prints ? for what is no UTF-8, as the program does; raises what it raises."""
    printed = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="replace")
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        app([*map(str, words)], standalone_mode=False)


def page(folder: Path) -> None:
    run_page(read_run(folder), lambda name: name)


def list_of_all(folder: Path) -> None:
    runs = Runs([folder.parent])
    drawn = draw_list(runs)()
    text = metrics(runs.summaries())
    assert f"{OTHER}</a>" in drawn.sections["runs"]
    assert f'es_service_generation{{run="{folder.parent.name}/{OTHER}",' in text


def live(folder: Path) -> None:
    runs = Runs([folder.parent])
    found = {one.folder.name: one for one in runs.find()}
    reading, other = RunReading(found[folder.name]), RunReading(found[OTHER])
    draw_run(runs, found[folder.name], reading)()
    draw_comparison([(found[folder.name], reading), (found[OTHER], other)], [])()


def exported(to: str) -> Callable[[Path], Any]:
    return lambda folder: command("export", folder, "--to", to, "--out", folder / to)


def policies(folder: Path) -> None:
    run = api.open_run(folder)
    run.policy("best")(run.policy("best").observation_mean_O)
    for read in (lambda: run.map, lambda: run.novelty, lambda: run.history, lambda: run.evaluations):
        read()


def forked(folder: Path) -> None:
    shutil.rmtree(folder.parent / "fork", ignore_errors=True)
    api.fork(folder, {"budget.generations": 4}, out=folder.parent / "fork", on_notice=lambda notice: None)


def begun(folder: Path) -> None:
    for which in ("", ":best"):
        settings = METHODS["es"] | {"search": METHODS["es"]["search"] | {"init_from": f"{folder}{which}"}}
        started(api.load_config(SMALL | settings), f"{folder}{which}", lambda notice: None)


READERS: dict[str, Callable[[Path], Any]] = {
    "status": lambda folder: command("status", folder),
    "status --json": lambda folder: command("status", folder, "--json"),
    "status of two": lambda folder: command("status", folder, folder),
    "digest": lambda folder: command("digest", folder),
    "report": page,
    "notebook": lambda folder: api.open_run(folder)._repr_html_(),
    "list and metrics": list_of_all,
    "live pages": live,
    "csv": exported("csv"),
    "npz": exported("npz"),
    "tensorboard": exported("tensorboard"),
    "ribs": exported("ribs"),
    "policies": policies,
    "certified": lambda folder: api.open_run(folder).certified,
    "comparison": lambda folder: command("report", folder, folder.parent / OTHER, "--out", folder.parent / "both.html"),
    "evaluate": lambda folder: candidates(api.open_run(folder), best=True, centre=True, cells=[], every=True),
    "init_from": begun,
    "fork": forked,
    "verify": lambda folder: [*verify(api.open_run(folder))],
    "opening": lambda folder: api.resume(folder, on_notice=lambda notice: None),
    "resume": lambda folder: api.resume(folder, {"budget.generations": 4}, on_notice=lambda notice: None),
}
"""What reads a run; the last two also write."""
COMPUTE = ("fork", "verify", "resume")
"""Readers that compute generations by what a search has stored of its own, which only that search can judge."""
OWN = re.compile(r" (own|whole_|rows_|cells_)|extra/")


@pytest.fixture(scope="module")
def originals(tmp_path_factory, workers_here) -> dict[str, Path]:
    """A run of each method, with a certified policy."""
    place = tmp_path_factory.mktemp("forged")
    for name, settings in METHODS.items():
        folder = place / "originals" / name
        api.run(SMALL | settings, folder)
        certify_run(folder, best=True, top=0, episodes=4)
    return {name: place / "originals" / name for name in METHODS}


def examined(originals: dict[str, Path], place: Path, number: int) -> Iterator[str]:
    """What each reader does with a forged run; begins with WRONG if it must not."""
    rng = random.Random(number)
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(originals["es"], place / OTHER)
    method = rng.choice(tuple(METHODS))
    shutil.copytree(originals[method], folder := place / "forged")
    what = f"forgery {number}: {forge(folder, rng)} of {method}"
    for name, read in READERS.items():
        if name in COMPUTE and OWN.search(what):
            continue
        begun_s = time.process_time()
        try:
            read(folder)
            answer = "read"
        except ServiceError as error:
            is_one = isinstance(error, ConfigError) or "\n" not in error.sentence
            answer = f"refused: {type(error).__name__}" if is_one else f"WRONG: not one sentence: {error.sentence}"
        except Exception:
            answer = f"WRONG: {traceback.format_exc()}"
        if (seconds := time.process_time() - begun_s) > LONGEST_S:
            answer = f"WRONG: it took {seconds:.0f} s"
        yield f"{answer} ({name}, {what})" if answer.startswith("WRONG") else answer


def wrong(originals: dict[str, Path], place: Path, numbers: range) -> tuple[list[str], Counter[str]]:
    answers = [answer for number in numbers for answer in examined(originals, place, number)]
    return [answer for answer in answers if answer.startswith("WRONG")], Counter(answers)


SIZES = Sizes(parameters=4, observation=2, dimensions=2, cells=None, bounds=())


@pytest.mark.parametrize(
    ("name", "arrays", "what"),
    [
        (BEST, {"generation": 1, "fitness": 0.5, "policy": np.zeros((), NAME)}, "names no policy"),
        (OBSERVATIONS, {"count": 2.0, "mean_O": [0.0, 0.0], "m2_O": [1.0, 1e300]}, "has statistics"),
        (OBSERVATIONS, {"count": 2.0, "mean_O": [0.0, 1e300], "m2_O": [1.0, 1.0]}, "has statistics"),
        (OBSERVATIONS, {"count": 0.0, "mean_O": [0.0, 0.0], "m2_O": [0.0, 0.0]}, ""),
        (ARCHIVE, {"descriptor_N_B": [[0.0, 1e300]], "generation_N": [0], "centre_N": [0]}, "has an array 'descr"),
        (ARCHIVE, {"descriptor_N_B": [[0.0, -3e38]], "generation_N": [0], "centre_N": [0]}, ""),
    ],
)
def test_values_that_no_state_has_are_named(name, arrays, what):
    found = problem(name, {key: np.asarray(value) for key, value in arrays.items()}, SIZES)
    assert found.startswith(f"{name} {what}") if what else not found


def test_a_centre_without_the_moments_of_its_step_is_refused():
    config = load_config(
        {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
    )
    zeros_D = np.zeros(3, np.float32)
    state = first_state([zeros_D], 2, 1.0)
    bare = replace(state, centres=(replace(state.centres[0], step={}),))
    with pytest.raises(StoreError, match=r"centre 0 lacks 'adam_step', which a step of search\.step\.kind = adam rem"):
        step_centre(bare, Ask(0, zeros_D, 0.1, 16, 1.0), zeros_D, config.search)


def test_the_gap_of_a_best_fitness_that_is_infinite_is_unknown():
    """Both may be -inf, of a function that calls each point infeasible."""
    history = {"env_steps": np.array([1.0, 2.0]), "best_fitness": np.full(2, -np.inf)}
    row = {"env_steps": 2, "return_mean": -np.inf, "successes": None, "episodes": 4}
    assert np.isnan(with_derived(history, [row], "sum")[GAP]).all()


@pytest.mark.slow
def test_forged_runs_are_read_or_refused_in_one_sentence(originals, tmp_path):
    found, counts = wrong(originals, tmp_path / "runs", range(5))
    assert not found, "\n".join(found)
    assert counts.keys() >= {"read", "refused: StoreError"}


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(0, 500, 25))
def test_five_hundred_forged_runs_are_read_or_refused_in_one_sentence(originals, tmp_path, first):
    found, _ = wrong(originals, tmp_path / "runs", range(first, first + 25))
    assert not found, "\n".join(found)
