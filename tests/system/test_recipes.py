"""Policies made in worker processes: the same bits with parents that are forgotten, workers that are killed, on Ray."""

from __future__ import annotations

import os
import signal
from collections import Counter
from pathlib import Path

import pytest

from es_service import api
from es_service.dispatch.inline_engine import ChildProcesses
from es_service.dispatch.ray_engine import Actors
from es_service.store.digest import digest_parts
from tests.helpers import workers_in_this_process
from tests.system.processes import children

GENERATIONS, SWITCH = 12, 7
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 40},
    "policy": {"hidden": [128, 128]},
    "search": {"algorithm": "map_elites", "batch": 64, "iso_sigma": 0.1, "line_sigma": 0.2},
    "budget": {"generations": GENERATIONS},
    "compute": {"engine": "inline", "workers": 2},
}
"""A policy takes 68 kB, too much for a message of Ray's; a MiB is room for fifteen, of thirty and more parents."""


def run(folder: Path, generations: int = GENERATIONS, on_notice=pytest.fail, **compute):
    config = api.load_config(CONFIG | {"compute": CONFIG["compute"] | compute, "budget": {"generations": generations}})
    return api.run(config, folder, on_notice=on_notice).run


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "run"
    with workers_in_this_process():
        run(folder, workers=1)
    return digest_parts(folder)


def test_with_room_for_few_parents(tmp_path, reference):
    run(tmp_path / "run", workers=3, parent_cache_mb=1)
    assert digest_parts(tmp_path / "run") == reference


@pytest.mark.alone
def test_with_killed_workers_whose_followers_have_no_parents(tmp_path, reference, monkeypatch):
    """Two are, each with the work items of policies that it has just been sent."""
    left, send = {3, 8}, ChildProcesses.send

    def send_and_strike(self, worker, key, attempt, work):
        strikes = key.kind == "PolicyChunk" and key.generation in left
        if strikes:
            left.discard(key.generation)
            os.kill(self.process_ids()[worker], signal.SIGSTOP)  # or it might have answered before it is struck
        send(self, worker, key, attempt, work)
        if strikes:
            os.kill(self.process_ids()[worker], signal.SIGKILL)

    monkeypatch.setattr(ChildProcesses, "send", send_and_strike)
    found = run(tmp_path / "run", on_notice=lambda notice: None)
    assert digest_parts(tmp_path / "run") == reference
    assert found.history["lost_workers"].sum() == 2
    assert not left
    assert children() == []


@pytest.mark.alone
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_run_that_goes_on_with_ray(tmp_path, reference, monkeypatch):
    """New workers begin without parents. Those of some items are believed to have what they lack, and say so."""
    sent, send = Counter(), Actors.send

    def send_in_vain(self, worker, key, attempt, work):
        sent[key] += 1
        if key.kind == "PolicyChunk" and key.generation in (SWITCH + 1, SWITCH + 3) and sent[key] == 1:
            for name in [name for subject, _ in work for name in subject.parameters_N_D.names]:
                self._memories[worker].add(name, 1)
        send(self, worker, key, attempt, work)

    monkeypatch.setattr(Actors, "send", send_in_vain)
    run(tmp_path / "run", generations=SWITCH)
    changes = [f"budget.generations={GENERATIONS}", "compute.engine=ray", "compute.workers=2"]
    found = api.resume(tmp_path / "run", changes).run
    assert digest_parts(tmp_path / "run") == reference
    assert found.history["retries"].sum() == 0
    assert {key.generation for key, times in sent.items() if times > 1} >= {SWITCH + 1, SWITCH + 3}
