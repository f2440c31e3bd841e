"""Ctrl-C and SIGTERM at any time, and a second driver."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from pathlib import Path

import pytest

from es_service.store.reader import read_generation
from tests.system.command_line import PROGRAM, digest, es
from tests.system.processes import ROOT, committed, running, wait_until

ENDLESS = ["--set", "budget.generations=100000"]  # a fast machine finishes the 30 of the config before the signal


@pytest.mark.alone
@pytest.mark.parametrize(
    ("number", "code"), [pytest.param(signal.SIGINT, 130, marks=pytest.mark.long), (signal.SIGTERM, 143)]
)
def test_signals_stop_promptly_and_resume_equals_uninterrupted(config, tmp_path, number, code):
    folder = tmp_path / "run"
    long = ["--set", "budget.generations=400"]
    with running(PROGRAM, "run", config, "--out", folder, *long) as process:
        wait_until(process, lambda: (committed(folder) or 0) >= 5)
        sent = time.monotonic()
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert time.monotonic() - sent < 2.0
    assert process.returncode == code
    assert 5 <= (read_generation(folder) or 0) < 400
    way_back = re.search(r"es-service (resume .*)", errors)
    assert way_back is not None
    assert es(*way_back[1].split())[0] == 0
    assert es("run", config, "--out", tmp_path / "whole", *long)[0] == 0
    assert digest(folder) == digest(tmp_path / "whole")


def listens(pid: int) -> bool:
    """Whether a program has a handler of SIGTERM, which Python itself has not."""
    caught = re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())
    return bool(caught) and bool(int(caught[0], 16) >> (signal.SIGTERM - 1) & 1)


def test_a_signal_during_start_up_ends_quietly(config, tmp_path):
    """From the first moment in which it is the program, and no longer Python alone, that is told; later and later,
    until two signals have come after the first generation."""
    reached, delay_s = [], 0.0
    while len(reached) - reached.count(None) < 2:
        folder = tmp_path / f"run{len(reached)}"
        with running(PROGRAM, "run", config, "--out", folder, *ENDLESS) as process:
            wait_until(process, lambda pid=process.pid: listens(pid))
            time.sleep(delay_s)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        assert (process.returncode, "Traceback" in errors) == (130, False), (delay_s, errors)
        reached.append(committed(folder))
        delay_s = 2 * delay_s or 0.05
    assert reached[0] is None
    assert reached.count(None) >= 2


@pytest.mark.long
def test_sigterm_while_ray_starts_ends_as_at_any_other_time(config, tmp_path):
    """Ray has a handler of its own meanwhile. From when the run folder is there, before Ray starts; later and later."""
    reached, delay_s = [], 0.0
    while not reached or reached[-1] is None:
        folder = tmp_path / f"run{len(reached)}"
        with running(PROGRAM, "run", config, "--out", folder, "--engine", "ray", "--workers", 1, *ENDLESS) as process:
            wait_until(process, (folder / "run.db").exists)
            time.sleep(delay_s)
            process.terminate()
            _, errors = process.communicate(timeout=60)
        assert (process.returncode, "Traceback" in errors) == (143, False), (delay_s, errors)
        assert errors.endswith(f"Continue with: es-service resume {folder}\n")
        reached.append(read_generation(folder))
        delay_s = 2 * delay_s or 0.5
    assert reached.count(None) >= 3


def test_a_second_driver_is_refused_and_told_who_holds_the_run(config, tmp_path):
    folder = tmp_path / "run"
    with running(PROGRAM, "run", config, "--out", folder, *ENDLESS) as process:
        wait_until(process, lambda: committed(folder) is not None)
        code, printed = es("resume", folder)
        assert code == 1
        assert f"{process.pid}" in printed
        assert socket.gethostname() in printed
        assert f"pid {process.pid}" in es("status", folder)[1]
        follow, unbuffered = tmp_path / "follow", {**os.environ, "PYTHONUNBUFFERED": "1"}
        with (
            follow.open("w") as stdout,
            running(PROGRAM, "status", folder, "--follow", stdout=stdout, env=unbuffered) as follower,
        ):
            wait_until(follower, lambda: follow.read_text().count("\ngeneration ") >= 2)
            process.terminate()
            process.communicate(timeout=60)
            follower.communicate(timeout=60)
    followed = follow.read_text()
    seen = [int(number) for number in re.findall(r"^generation (\d+)", followed, re.MULTILINE)]
    assert seen == sorted(set(seen))
    assert seen[-1] == read_generation(folder)
    assert "no driver is running" in followed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_doctor_without_a_finding(tmp_path, number, code):
    """While its worker starts."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with running(PROGRAM, "doctor", cwd=tmp_path, env=environment) as process:
        assert process.stdout is not None
        assert any("noise equals" in line for line in process.stdout)
        time.sleep(0.2)
        process.send_signal(number)
        printed, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert "FAIL" not in printed
