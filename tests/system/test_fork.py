"""What a fork takes from its parent, what it leaves behind, what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from es_service import api
from tests.system.session import SMALL


def run(folder: Path, *overrides: str, config=SMALL):
    return api.run(api.load_config(config, overrides), folder).run


def fork(parent, folder: Path, *overrides: str):
    return api.fork(parent.folder, overrides, out=folder).run


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    """Six generations of nsra_es."""
    return run(tmp_path_factory.mktemp("parent") / "run", "budget.generations=6")


def test_a_record_of_another_fitness_does_not_hold_the_weight_down(tmp_path):
    """Sums of rewards are far below the last reward alone: against its record nothing would ever be an improvement."""
    parent = run(tmp_path / "parent", "task.fitness=final", "budget.generations=6")
    before = parent.parts()[1]["weight"]
    forked = fork(parent, tmp_path / "fork", "task.fitness=sum", "budget.generations=8")
    after, history = forked.parts()[1]["weight"], forked.history
    assert before["value"] < 1.0
    assert after["record"] == history["centre_fitness_mean"].iloc[7:].max() < before["record"]
    assert history["fitness_weight"].iloc[7] == before["value"] < history["fitness_weight"].iloc[8]
