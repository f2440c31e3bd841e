"""Cores that a process may use, by affinity and by a container's quota."""

from __future__ import annotations

import os

import pytest

from es_service.api import load_config
from es_service.cli import bench, doctor
from es_service.protocol import machine
from es_service.runs.worker_count import worker_count

SMALLEST = {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes files into what eight cores are said to be limited by."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    monkeypatch.setattr(machine, "MEMBERSHIP", tmp_path / "membership")

    def write(files):
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
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
    assert machine.cores() == expected


IN_A_JOB = "0::/slurm/job_7/step_0\n"
OF_VERSION_1 = "3:cpuset:/other\n2:cpu,cpuacct:/slurm/job_7\n1:name=systemd:/system\n"


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"membership": IN_A_JOB, "slurm/job_7/step_0/cpu.max": "300000 100000\n"}, 3),
        ({"membership": IN_A_JOB, "slurm/job_7/cpu.max": "300000 100000\n", "cpu.max": "500000 100000\n"}, 3),
        (
            {
                "membership": IN_A_JOB,
                "slurm/cpu.max": "150000 50000\n",  # the shorter period: three cores as well
                "slurm/job_7/cpu.max": "max 100000\n",
                "slurm/job_7/step_0/cpu.max": "700000 100000\n",
            },
            3,
        ),
        ({"membership": IN_A_JOB, "slurm/job_8/cpu.max": "100000 100000\n"}, 8),
        ({"membership": "0::/not/seen/here\n", "cpu.max": "200000 100000\n"}, 2),
        ({"membership": "0::/../beside\n", "cpu.max": "200000 100000\n"}, 2),
        ({"membership": "no membership", "cpu.max": "200000 100000\n"}, 2),
        (
            {
                "membership": OF_VERSION_1,
                "cpu/slurm/cpu.cfs_quota_us": "250000\n",
                "cpu/slurm/cpu.cfs_period_us": "100000\n",
                "cpu/slurm/job_7/cpu.cfs_quota_us": "-1\n",
                "cpu/slurm/job_7/cpu.cfs_period_us": "100000\n",
                "cpu/other/cpu.cfs_quota_us": "100000\n",  # the group of another controller
                "cpu/other/cpu.cfs_period_us": "100000\n",
            },
            3,
        ),
        (
            {
                "membership": OF_VERSION_1 + IN_A_JOB,
                "cpu/cpu.cfs_quota_us": "600000\n",
                "cpu/cpu.cfs_period_us": "100000\n",
                "slurm/cpu.max": "400000 100000\n",
            },
            4,
        ),
    ],
)
def test_the_least_quota_of_the_groups_around_a_process_limits_the_cores(write, files, expected):
    write(files)
    assert machine.cores() == expected


def test_whoever_counts_cores_knows_of_the_quota(write, monkeypatch):
    write({"cpu.max": "300000 100000\n"})
    assert worker_count(load_config(SMALLEST)) == 3
    assert next(doctor._machine())[1].startswith("3 of ")
    asked = []
    monkeypatch.setattr(bench, "_row", lambda arguments, count: asked.append(count) or {})
    list(bench.bench_rollouts(["point_maze"], policies=[True], rollouts=["xla"]))
    assert asked == [1, 3]
