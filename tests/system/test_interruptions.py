"""Ctrl-C and SIGTERM at any time, and a second driver."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

from es_service.store.reader import read_generation
from tests.system.command_line import COMMAND, digest, es
from tests.system.session import ROOT


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_stop_promptly_and_resume_equals_uninterrupted(config, finished, tmp_path, number, code):
    folder = tmp_path / "run"
    long = ["--set", "budget.generations=400"]
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), *long], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not (folder / "run.db").exists() or (read_generation(folder) or 0) < 5:
        time.sleep(0.01)
    sent = time.monotonic()
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert time.monotonic() - sent < 2.0
    assert process.returncode == code
    assert 5 <= (read_generation(folder) or 0) < 400
    way_back = re.search(r"es-service (resume .*)", errors)
    assert way_back is not None
    assert es(*way_back[1].split())[0] == 0
    assert es("run", config, "--out", tmp_path / "whole", *long)[0] == 0
    assert digest(folder) == digest(tmp_path / "whole")


def wait_until_it_listens(pid):
    """Until a program has a handler of SIGTERM, which Python itself has not."""
    caught = 0
    while not caught >> (signal.SIGTERM - 1) & 1:
        time.sleep(0.005)
        caught = int(re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())[0], 16)


@pytest.mark.parametrize("delay_s", [0.0, 0.15, 0.3, 0.5, 0.9, 1.5])
def test_a_signal_during_start_up_ends_quietly(config, tmp_path, delay_s):
    """From the first moment in which it is the program, and no longer Python alone, that is told."""
    long = ["--set", "budget.generations=100000"]  # a fast machine finishes the 30 of the config before the signal
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(tmp_path / "run"), *long],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until_it_listens(process.pid)
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in errors


@pytest.mark.parametrize("delay_s", [0.5, 1.0, 1.5, 2.5])
def test_sigterm_while_ray_starts_ends_as_at_any_other_time(config, tmp_path, delay_s):
    """Ray has a handler of its own meanwhile. Seconds count from when the run folder is there, before Ray starts."""
    folder = tmp_path / "run"
    long = ["--engine", "ray", "--workers", "1", "--set", "budget.generations=100000"]
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), *long], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    while not (folder / "run.db").exists():
        time.sleep(0.01)
    time.sleep(delay_s)
    process.terminate()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    assert errors.endswith(f"Go on with: es-service resume {folder}\n")
    assert "Traceback" not in errors


def test_a_second_driver_is_refused_and_told_who_holds_the_run(config, tmp_path):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        [*COMMAND, "run", str(config), "--out", str(folder), "--set", "budget.generations=100000"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
    )
    try:
        while not (folder / "run.db").exists() or read_generation(folder) is None:
            time.sleep(0.01)
        code, printed = es("resume", folder)
        assert code == 1
        assert f"{process.pid}" in printed
        assert socket.gethostname() in printed
        assert f"pid {process.pid}" in es("status", folder)[1]
        follower = subprocess.Popen(
            [*COMMAND, "status", str(folder), "--follow"], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        time.sleep(3.0)
    finally:
        process.terminate()
        process.wait(timeout=20)
    followed, _ = follower.communicate(timeout=20)
    seen = [int(number) for number in re.findall(r"^generation (\d+)", followed, re.MULTILINE)]
    assert len(seen) >= 2
    assert seen == sorted(set(seen))
    assert seen[-1] == read_generation(folder)
    assert "no driver is running" in followed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_doctor_without_a_finding(tmp_path, number, code):
    """While its worker starts."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen([*COMMAND, "doctor"], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert any("noise equals" in line for line in process.stdout)
    time.sleep(0.2)
    process.send_signal(number)
    printed, _ = process.communicate(timeout=20)
    assert process.returncode == code
    assert "FAIL" not in printed
