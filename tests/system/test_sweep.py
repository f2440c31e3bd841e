"""Sweeps: killed and given again, stopped, with a run that fails."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from es_service import api, open_run, sweep, write_comparison
from es_service.runs import sweep as sweeps
from es_service.store.digest import digest_parts
from tests.system.command_line import PROGRAM, es
from tests.system.processes import committed, is_running, running, wait_for, wait_until
from tests.system.session import SMALL

NAMES = [f"sigma={sigma}_seed={seed}" for sigma in (0.02, 0.05) for seed in (0, 1)]


def descendants(pid: int) -> list[str]:
    """Process ids of the children of a process and of theirs, and so on."""
    parents = {}
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            parents[int(entry)] = int(Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return [str(one) for one in found[1:]]


def end(pids: list[str]) -> None:
    """Wait until processes have ended by themselves; those that have not are killed."""
    try:
        wait_for(lambda: not any(map(is_running, pids)))
    finally:
        for pid in filter(is_running, pids):
            os.kill(int(pid), signal.SIGKILL)


def both_begun(out: Path, names: list[str]):
    return lambda: all((committed(out / name) or 0) >= 5 for name in names)


@pytest.mark.slow
def test_a_sweep_killed_and_given_again_ends_as_if_it_had_not_been_and_a_failed_run_stops_no_other(config, tmp_path):
    out, blocked = tmp_path / "sweep", tmp_path / "sweep" / NAMES[2]
    grid = ("--grid", "search.sigma=0.02,0.05", "--seeds", "0:2")
    command = ("sweep", config, *grid, "--parallel", 2, "--out", out, "--set")
    blocked.mkdir(parents=True)
    (blocked / "notes.txt").touch()  # a run is created in a new or empty folder only

    with running(PROGRAM, *command, "budget.generations=1000000") as process:
        wait_until(process, both_begun(out, NAMES[:2]))
        started = descendants(process.pid)
        process.kill()
    assert len(started) == 8, "two runs and workers, each with its guard"
    end(started)
    before = {name: committed(out / name) or 0 for name in NAMES[:2]}
    ids = {name: open_run(out / name).run_id for name in NAMES[:2]}
    assert not (out / NAMES[3]).exists()

    generations = max(before.values()) + 30
    code, printed = es(*command, f"budget.generations={generations}")
    assert code == 1, printed
    assert "4 runs: 1 failed, 3 finished" in printed
    (error,) = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert error.startswith(f"error: {NAMES[2]} failed: {blocked} ")
    for name in NAMES[:2]:
        log = (out / sweeps.INSIDE / f"{name}.log").read_text()
        assert f"generation {before[name] + 1} " in log, "it went on after the last committed generation"
        assert open_run(out / name).run_id == ids[name]
    settings = {"search.sigma": 0.02, "seed": 1, "budget.generations": generations}
    api.run(api.load_config(SMALL, settings), tmp_path / "undisturbed")
    assert digest_parts(out / NAMES[1]) == digest_parts(tmp_path / "undisturbed")
    assert write_comparison([str(out / NAMES[0]), out / NAMES[3]], str(tmp_path / "two.html")) == [
        tmp_path / "two.html"
    ]
    page = (out / "report.html").read_text()
    assert all(f"sigma = {sigma}" in page for sigma in (0.02, 0.05))

    (blocked / "notes.txt").unlink()
    untouched = [path for name in (*NAMES[:2], NAMES[3]) for path in (out / name).iterdir()]
    times = [path.stat().st_mtime_ns for path in untouched]
    seen = []
    wanted = {"budget.generations": generations}
    axes = {"search.sigma": [0.02, 0.05]}
    runs = sweep(SMALL, out, grid=axes, seeds=range(2), overrides=wanted, on_progress=seen.append)
    assert [(run.name, run.state) for run in runs] == [(name, "finished") for name in NAMES]
    assert [run.row["generation"] for run in runs] == [generations] * 4
    assert [run.state for run in seen[0]] == ["finished", "finished", "running", "finished"]
    assert [path.stat().st_mtime_ns for path in untouched] == times


@pytest.mark.slow
def test_a_signal_stops_all_runs_and_a_second_one_ends_at_once(config, tmp_path):
    out = tmp_path / "runs"
    endless = ("--set", "budget.generations=1000000", "--workers", 1, "--log-level", "info", "--log", "tensorboard")
    command = ("run", config, "--seeds", "0:2", *endless, "--out", out)
    names = ["seed=0", "seed=1"]
    with running(PROGRAM, *command) as process:
        wait_until(process, both_begun(out, names))
        code, printed = es(*command)
        assert (code, "another sweep is running in" in printed) == (1, True)
        started = descendants(process.pid)
        process.send_signal(signal.SIGINT)
        printed, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted; every finished generation of every run is saved" in errors
    *ends, last = printed.splitlines()[-3:]
    assert [line.split()[:2] for line in ends] == [[name, "stopped"] for name in names]
    assert last == "2 runs: 2 stopped"
    assert started
    assert not any(map(is_running, started))
    for name in names:
        log = (out / sweeps.INSIDE / f"{name}.log").read_text()
        assert "interrupted; " in log
        assert "INFO es_service.runs.session " in log
        assert list((out / name / "tensorboard").iterdir())

    with running(PROGRAM, *command) as process:
        before = [committed(out / name) for name in names]
        wait_until(process, lambda: all(committed(out / name) != old for name, old in zip(names, before, strict=True)))
        started = descendants(process.pid)
        for child in started:
            os.kill(int(child), signal.SIGSTOP)  # so that no run heeds the first signal
        process.send_signal(signal.SIGTERM)
        time.sleep(2.0)  # a signal within a second of the first is the same request
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
    end(started)
