"""Processes that measure end with whoever asked."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from es_service.cli import bench
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol.child import Child

FAILS, HANGS = "tests.es_service.shell_child:shell", "tests.es_service.test_system"
"""Modules: the first refuses what `workers.measure` is asked, the second sleeps."""


def interrupt(number, frame):
    raise Interrupted(number)


@pytest.mark.parametrize("modules", [(FAILS, HANGS), (HANGS, HANGS)])
def test_nobody_goes_on_measuring_after_a_failure_or_a_signal(monkeypatch, modules):
    """Of two processes one fails, or the command is told to stop."""
    started: list[Child] = []

    def start(module, environment):
        started.append(Child(modules[len(started)], environment))
        return started[-1]

    monkeypatch.setattr(bench, "Child", start)
    before = signal.signal(signal.SIGTERM, interrupt)
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGTERM))
    if FAILS not in modules:
        timer.start()
    began = time.monotonic()
    try:
        with pytest.raises((EvaluationError, Interrupted)):
            bench._row({"task": "point_maze"}, 2)
        assert [child.is_ended for child in started] == [True, True]
        assert time.monotonic() - began < 30
    finally:
        signal.signal(signal.SIGTERM, before)
