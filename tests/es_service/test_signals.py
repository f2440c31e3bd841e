"""A signal is heeded whenever it comes, and a second one ends a process at once."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys

import optuna
import pytest

from es_service import load_config, run
from es_service.cli.main import main
from es_service.dispatch.ray_cluster import signal_handlers_kept
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
SMALL = {
    "task": {"environment": "point_maze", "episode_steps": 10},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 1},
    "map": {"enabled": False},
    "budget": {"generations": 3},
    "compute": {"engine": "inline", "workers": 1, "inline_workers": "threads"},
}


def test_a_signal_that_was_caught_and_forgotten_stops_whatever_begins_next(monkeypatch):
    monkeypatch.setattr(signals, "EARLY", signals.StopRequest())
    with signals.stop_on_signals() as should_stop:
        assert should_stop() is None
    with pytest.raises(Interrupted):
        signals.interrupt(signal.SIGTERM, None)
    with signals.stop_on_signals() as should_stop:
        assert should_stop() == signal.SIGTERM


def test_a_signal_at_the_end_of_a_part_of_a_command_stops_the_next_one(monkeypatch):
    monkeypatch.setattr(signals, "EARLY", signals.StopRequest())
    before = signal.signal(signal.SIGTERM, signals.interrupt)
    try:
        with signals.stop_on_signals() as should_stop:
            os.kill(os.getpid(), signal.SIGTERM)
            while should_stop() is None:
                pass
        with signals.stop_on_signals() as should_stop:
            assert should_stop() == signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_handler_that_is_not_python_s_stays(monkeypatch):
    """Python has none to restore, as where it is embedded in another program."""
    ours = signal.getsignal(signal.SIGTERM)
    known = signal.getsignal
    monkeypatch.setattr(signal, "getsignal", lambda number: None if number == signal.SIGTERM else known(number))
    with signals.stop_on_signals():
        assert known(signal.SIGTERM) is ours
        assert known(signal.SIGINT) is not signal.default_int_handler
    with signal_handlers_kept():
        pass


@pytest.mark.parametrize(("does", "reported"), [("os.kill(os.getpid(), signal.SIGTERM)", False), ("1 / 0", True)])
def test_only_an_interruption_that_python_ignored_is_not_reported(does, reported):
    program = IGNORED.format(does=does)
    ended = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (0, "went on\n")
    assert ("Traceback" in ended.stderr) == reported


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("workers_here")
def test_a_signal_ends_what_goes_on_after_the_error_of_a_run(number, tmp_path):
    """A loop of trials ends with the one that the signal has interrupted, and so does a study of Optuna."""
    begun = []

    def trial(folder: str) -> float:
        begun.append(folder)
        run(SMALL, tmp_path / folder, on_generation=lambda row: os.kill(os.getpid(), number))
        return 0.0

    def loop() -> None:
        for seed in range(3):
            try:
                trial(f"loop{seed}")
            except Exception as error:
                begun.append(error)

    study = optuna.create_study()
    for ends in (loop, lambda: study.optimize(lambda each: trial(f"trial{each.number}"), 3, catch=(Exception,))):
        with pytest.raises(Interrupted, match=f"interrupted by {number.name}") as stopped:
            ends()
        assert stopped.value.signal_number == number
    assert begun == ["loop0", "trial0"]


def test_a_signal_while_code_of_a_user_is_imported_is_no_error_of_that_code(tmp_path, monkeypatch):
    monkeypatch.setattr(signals, "EARLY", signals.StopRequest())
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "late_search.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\n")
    before = signal.signal(signal.SIGTERM, signals.interrupt)
    try:
        with pytest.raises(Interrupted, match="interrupted by SIGTERM"):
            load_config(SMALL, {"search.algorithm": "late_search:make"})
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize(
    ("raised", "code"),
    [(Interrupted(signal.SIGINT), 130), (Interrupted(signal.SIGTERM), 143), (KeyboardInterrupt, 143)],
)
def test_the_exit_code_names_the_signal_whoever_has_caught_it(raised, code, monkeypatch):
    """Typer knows one code alone, and Ray raises a KeyboardInterrupt of its own in place of that of the handler."""

    def interrupted(*_):
        raise raised

    monkeypatch.setattr(signals.EARLY, "number", signal.SIGTERM)
    monkeypatch.setattr(sys, "argv", ["es-service", "status", "anywhere"])
    monkeypatch.setattr("es_service.cli.common.runs_of", interrupted)
    with pytest.raises(Interrupted) as stopped:
        main()
    assert 128 + stopped.value.signal_number == code


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
