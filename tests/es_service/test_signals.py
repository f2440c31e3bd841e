"""A signal is heeded whenever it comes, and a second one ends a process at once."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys

import pytest

from es_service.errors import Interrupted
from es_service.runs import signals
from tests.system.session import ROOT

PROGRAM = """
import os, signal, time
from rich.live import Live
from es_service.runs import signals
signals.REPEAT_S = 0.0
with signals.stop_on_signals() as should_stop, Live("busy"):
    os.kill(os.getpid(), signal.SIGTERM)
    assert should_stop() == signal.SIGTERM
    time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)
"""


def test_a_signal_that_was_caught_and_forgotten_stops_whatever_begins_next(monkeypatch):
    monkeypatch.setattr(signals, "EARLY", signals.StopRequest())
    with signals.stop_on_signals() as should_stop:
        assert should_stop() is None
    with pytest.raises(Interrupted):
        signals.interrupt(signal.SIGTERM, None)
    with signals.stop_on_signals() as should_stop:
        assert should_stop() == signal.SIGTERM


def test_a_second_signal_leaves_the_terminal_with_its_cursor():
    ours, theirs = pty.openpty()
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM], stdout=theirs, cwd=ROOT, env={**os.environ, "TERM": "xterm"}
        )
        assert process.wait(timeout=60) == 128 + signal.SIGINT
        shown = os.read(ours, 10_000)
    finally:
        os.close(ours)
        os.close(theirs)
    assert b"\x1b[?25l" in shown
    assert shown.endswith(b"\x1b[?25h\r\n")
