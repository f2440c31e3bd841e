"""A search of one's own may replace what the map says of an elite; the store keeps it, and a resumed run has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service import api
from es_service.errors import StoreError
from es_service.search.algorithms import ALGORITHMS

pytestmark = pytest.mark.usefixtures("workers_here")
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [8]},
    "search": {"pairs": 16, "sigma": 0.2, "step": {"learning_rate": 0.1}},
    "map": {"enabled": True, "cells": [8, 8]},
    "budget": {"generations": 4},
    "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
}


def begin(folder, change, generations=4):
    settings = [f"search.algorithm={__name__}:{change}", f"budget.generations={generations}"]
    return api.run(api.load_config(CONFIG, settings), folder).run


def telling(config, change, at=2):
    """ES that changes the map in one generation, and nothing of it from then on."""
    ours = ALGORITHMS["es"](config)

    def tell(state, evaluations):
        generation = evaluations[0].generation
        told = ours.tell(state, evaluations) if generation < 2 else state
        return replace(told, map=change(told.map)) if generation == at else told

    return replace(ours, tell=tell)


def column(map_, name, value):
    changed = getattr(map_, name).copy()
    changed[0] = value
    return replace(map_, **{name: changed})


def lower_fitness(config):
    return telling(config, lambda map_: column(map_, "fitness_N", map_.fitness_N[0] - 7.0))


def no_fitness(config):
    return telling(config, lambda map_: column(map_, "fitness_N", np.nan))


def other_place(config):
    return telling(config, lambda map_: column(map_, "descriptor_N_B", (0.5, -0.25)))


def signed_score(config):
    return telling(config, lambda map_: column(column(map_, "score_N", 0.0), "score_N", -0.0))


CHANGES = {"lower_fitness": "fitness", "no_fitness": "fitness", "other_place": "x", "signed_score": None}


@pytest.mark.parametrize("change", CHANGES)
def test_a_resumed_run_has_the_changed_entry(tmp_path, change):
    whole = begin(tmp_path / "whole", change)
    before = begin(tmp_path / "parts", change, generations=1).map.iloc[0]
    begin(tmp_path / "stopped", change, generations=2)
    for folder in ("parts", "stopped"):
        resumed = api.resume(tmp_path / folder, ["budget.generations=4"]).run
        assert resumed.digest() == whole.digest()
        if name := CHANGES[change]:
            assert resumed.map.iloc[0][name] != before[name]
    assert len(whole.map) > 0


def in_place(config):
    def change(map_):
        map_.fitness_N[0] = 0.0
        return map_

    return telling(config, change)


def centre_in_place(config):
    ours = ALGORITHMS["es"](config)

    def step(state, asked, gradient_D):
        state.centres[0].centre_D[:] += gradient_D
        return state

    return replace(ours, step=step)


@pytest.mark.parametrize("change", ["in_place", "centre_in_place"])
def test_a_change_in_place_is_an_error_since_it_would_not_be_stored(tmp_path, change):
    with pytest.raises(ValueError, match="read-only"):
        begin(tmp_path / "run", change)


def short(config):
    return telling(config, lambda map_: replace(map_, fitness_N=map_.fitness_N[1:]))


def single(config):
    return telling(config, lambda map_: replace(map_, score_N=map_.score_N.astype(np.float32)))


@pytest.mark.parametrize(
    ("change", "what"), [("short", r"fitness_N is float64 \(\d+,\)"), ("single", "score_N is float32")]
)
def test_arrays_of_other_shapes_and_types_end_the_run(tmp_path, change, what):
    with pytest.raises(StoreError, match=f"generation 2 cannot be stored: the map's {what}.*it must be float64"):
        begin(tmp_path / "run", change)
    assert api.open_run(tmp_path / "run").generation == 1


def single_at_first(config):
    return telling(config, lambda map_: replace(map_, fitness_N=map_.fitness_N.astype(np.float32)), at=0)


def test_the_map_of_the_first_generation_is_checked_too(tmp_path):
    """The store would convert it, so that a resumed run would differ from this one."""
    message = "generation 0 cannot be stored: the map's fitness_N is float32 .*it must be float64"
    with pytest.raises(StoreError, match=message):
        begin(tmp_path / "run", "single_at_first")
