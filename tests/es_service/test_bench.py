"""Processes that measure end with whoever asked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from es_service.cli import bench_rollouts
from es_service.errors import EvaluationError, Interrupted

FAILS, HANGS = "raise SystemExit('no such task')", "import time; time.sleep(60)"


def interrupt(number, frame):
    raise Interrupted(number)


@pytest.mark.parametrize("programs", [(FAILS, HANGS), (HANGS, HANGS)])
def test_nobody_goes_on_measuring_after_a_failure_or_a_signal(monkeypatch, programs):
    """Of two processes one fails, or the command is told to stop."""
    popen, started = subprocess.Popen, []

    def start(command, **options):
        started.append(popen([sys.executable, "-c", programs[len(started)]], **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    before = signal.signal(signal.SIGTERM, interrupt)
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGTERM))
    if FAILS not in programs:
        timer.start()
    began = time.monotonic()
    try:
        with pytest.raises((EvaluationError, Interrupted)):
            bench_rollouts._row({"task": "point_maze"}, 2)
        assert [process.poll() is None for process in started] == [False, False]
        assert time.monotonic() - began < 30
    finally:
        signal.signal(signal.SIGTERM, before)
        for process in started:
            process.kill()
            process.communicate()
