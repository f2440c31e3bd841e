"""Cores that a process may use, by affinity and by a container's quota."""

from __future__ import annotations

import os

import pytest

from es_service.api import load_config
from es_service.cli import bench_rollouts, doctor
from es_service.dispatch import cores
from es_service.runs import session

SMALLEST = {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes files into what eight cores are said to be limited by."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.setattr(cores, "CGROUP", tmp_path)

    def write(files):
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)

    return write


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"cpu.max": "200000 100000\n"}, 2),
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "10000 100000\n"}, 1),
        ({"cpu.max": "1600000 100000\n"}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "what is this?\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "250000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({}, 8),
    ],
)
def test_a_quota_of_either_version_limits_the_cores(write, files, expected):
    write(files)
    assert cores.cores() == expected


def test_whoever_counts_cores_knows_of_the_quota(write, monkeypatch):
    write({"cpu.max": "300000 100000\n"})
    assert session.worker_count(load_config(SMALLEST)) == 3
    assert next(doctor._machine())[1].startswith("3 of ")
    asked = []
    monkeypatch.setattr(bench_rollouts, "_row", lambda arguments, count: asked.append(count) or {})
    list(bench_rollouts.bench_rollouts(["point_maze"], policies=[True], rollouts=["xla"]))
    assert asked == [1, 3]
