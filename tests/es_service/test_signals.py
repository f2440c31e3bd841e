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
IGNORED = """
import os, signal, sys, weakref
from es_service.__main__ import report_ignored
from es_service.runs.signals import interrupt
sys.unraisablehook = report_ignored
signal.signal(signal.SIGTERM, interrupt)
held = {{1}}
watched = weakref.ref(held, lambda reference: {does})
del held
print("went on")
"""


def test_a_signal_that_was_caught_and_forgotten_stops_whatever_begins_next(monkeypatch):
    monkeypatch.setattr(signals, "EARLY", signals.StopRequest())
    with signals.stop_on_signals() as should_stop:
        assert should_stop() is None
    with pytest.raises(Interrupted):
        signals.interrupt(signal.SIGTERM, None)
    with signals.stop_on_signals() as should_stop:
        assert should_stop() == signal.SIGTERM


@pytest.mark.parametrize(("does", "reported"), [("os.kill(os.getpid(), signal.SIGTERM)", False), ("1 / 0", True)])
def test_only_an_interruption_that_python_ignored_is_not_reported(does, reported):
    program = IGNORED.format(does=does)
    ended = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (0, "went on\n")
    assert ("Traceback" in ended.stderr) == reported


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
