"""What a run was computed on: its record, and when the digest says that it is mixed."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path

import pytest

from es_service import api
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.machine import VERSION, computed_on, is_mixed, platform_info, platform_text
from es_service.runs import session
from es_service.store.digest import checked_parts
from es_service.store.reader import read_platforms
from tests.helpers import WorkerHere
from workers.worker import make_worker

DRIVER = {"cpu": "a", "jax": "1"}
LIKE_THE_DRIVER, OTHER, NEWER = platform_text(DRIVER), platform_text({"cpu": "b"}), platform_text({"cpu": "a"})
CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 10},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 16},
    "budget": {"generations": 4},
    "compute": {"engine": "inline", "workers": 1},
    "store": {"commit_interval_s": 0},  # a worker that joins counts for all generations of a transaction
}


@pytest.mark.parametrize(
    ("workers", "recorded", "mixed"),
    [
        ((), None, False),
        ((LIKE_THE_DRIVER,), None, False),
        ((OTHER,), [{"cpu": "b"}], False),
        ((OTHER, LIKE_THE_DRIVER), [DRIVER, {"cpu": "b"}], True),
        ((OTHER, NEWER), [{"cpu": "a"}, {"cpu": "b"}], True),
    ],
)
def test_workers_are_recorded_where_they_are_not_like_the_driver(workers, recorded, mixed):
    platform = computed_on(DRIVER, workers)
    assert platform.get("workers") == recorded
    assert {**platform, "workers": None} == {**DRIVER, "workers": None}
    assert is_mixed([platform]) is mixed
    assert is_mixed([platform, DRIVER]) is (recorded is not None)


@pytest.mark.parametrize(
    ("joins", "mixed", "recorded"),
    [
        ({}, False, [0]),  # workers like the driver
        ({0: OTHER}, False, [0]),  # all workers on another kind of machine than the driver
        ({0: OTHER, 2: NEWER}, True, [0, 2]),
        ({4: OTHER}, True, [0, 4]),  # in the very last generation
    ],
)
def test_workers_of_several_kinds_make_a_run_mixed_from_the_generation_they_join(
    tmp_path, monkeypatch, joins, mixed, recorded
):
    class Cluster(WorkerHere):
        """Whose workers come up in the generations of `joins`."""

        def evaluate(self, work):
            kind = joins.get(work[0][0].generation, "" if joins and 0 in joins else platform_text(platform_info()))
            self.platforms |= {kind} - {""}
            return super().evaluate(work)

    @contextmanager
    def engine(config, should_stop, *_, **__):
        yield Cluster(make_worker(worker_spec(config, task_of(config))), should_stop)

    monkeypatch.setattr(session, "make_engine", engine)
    told: list[str] = []
    run = api.run(api.load_config(CONFIG), tmp_path / "run", on_notice=told.append).run
    assert checked_parts(run.folder)[1] is mixed
    assert [first for first, _ in read_platforms(run.folder)] == recorded
    assert [f"from generation {first} on" in notice for first, notice in zip(recorded[1:], told, strict=True)] == [
        True
    ] * len(told)


def test_our_own_version_is_that_of_the_code_not_of_its_last_installation(monkeypatch):
    """A clone that was pulled and not installed again runs new code under old metadata."""
    installed = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "0.0.1" if name == "es-service" else installed(name))
    assert platform_info()["es-service"] == VERSION
    printed = subprocess.run([sys.executable, "-m", "es_service", "--version"], capture_output=True, text=True)
    assert printed.stdout.strip() == VERSION
    described = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert described["project"]["dynamic"] == ["version"]
    assert described["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "es_service.protocol.machine.VERSION"}
