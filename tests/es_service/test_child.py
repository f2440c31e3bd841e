"""Child processes that answer requests, and tasks of users that start runs in them."""

from __future__ import annotations

import importlib
import os
import time
from pathlib import Path

import pytest

from es_service.config.tasks import TASKS
from es_service.errors import TaskError
from es_service.protocol.child import Child, NoAnswerError, answer_of
from es_service.protocol.process_environment import DEPTH, MOST_DEPTH, child_environment, require_no_import_of_a_task
from es_service.protocol.user_code import RaisedError

SHELL = "tests.es_service.shell_child:shell"
LONG_S = 60.0
"""Longer than any of these tests may take."""
DESCRIBED = """
from es_service.config.tasks import TASKS
TASKS["function:{name}:value"]
"""
RUN = """
import es_service
es_service.run(
    dict(task=dict(environment="point_maze"), search=dict(algorithm="es"), budget=dict(generations=1)), {out!r}
)
"""


def is_running(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_process_that_a_simulator_leaves_delays_no_answer_and_is_ended(tmp_path):
    """It holds the child's stdout and stderr open, as a server does that a simulator starts."""
    begun_s = time.monotonic()
    program = f"sleep 99 & echo $! > {tmp_path}/pid; echo words; echo noise >&2; exit 3"
    assert answer_of(SHELL, "ends", request=(program,), limit_s=LONG_S) == 3
    assert time.monotonic() - begun_s < LONG_S / 2
    left = int((tmp_path / "pid").read_text())
    while is_running(left):  # it has been killed, and its new parent may take a moment to see that
        assert time.monotonic() - begun_s < LONG_S / 2
        time.sleep(0.001)


def test_the_end_of_a_child_is_a_sentence_with_the_last_that_it_printed(tmp_path):
    with pytest.raises(NoAnswerError) as ended:
        answer_of(SHELL, "ends", request=("echo no licence; kill -SEGV $PPID",), limit_s=LONG_S)
    assert (str(ended.value), ended.value.is_late) == ("ended with signal SIGSEGV:\nno licence", False)
    with Child(SHELL, child_environment()) as child:
        child.call("ends", limit_s=LONG_S)
        child.ask(f"echo waits for a licence; touch {tmp_path}/begun; sleep 99")
        until_s = time.monotonic() + LONG_S
        while not (tmp_path / "begun").exists() and time.monotonic() < until_s:
            time.sleep(0.001)
        with pytest.raises(NoAnswerError) as late:
            child.answer(0.01)
        assert child.is_ended
        assert child.is_answered
        with pytest.raises(NoAnswerError, match="ended with"):
            child.call("echo again")
    assert (str(late.value), late.value.is_late) == ("gave no answer within 0.01 s:\nwaits for a licence", True)
    with pytest.raises(RaisedError, match="cannot be imported"):
        answer_of(SHELL, "raises", limit_s=LONG_S)


def test_a_thread_that_does_not_end_delays_no_answer(monkeypatch):
    monkeypatch.setattr("es_service.protocol.child.END_S", 0.01)
    assert answer_of(SHELL, "waits", request=("exit 3",), limit_s=LONG_S) == 3


def test_of_a_child_that_printed_a_lot_only_the_end_is_read():
    """More than fits into memory: a hole in the file, which takes no room on the disk either."""
    child = Child(SHELL, child_environment())
    assert child._log is not None
    child._log.truncate(2**40)
    child._log.seek(0, os.SEEK_END)
    child._log.write("ä".encode() * 1500 + b" the last words\n")
    child._log.flush()
    how, last_words, _ = child.end()
    assert how == "signal SIGKILL"
    assert last_words.endswith("ää the last words")
    assert 990 < len(last_words) <= 2000


@pytest.mark.parametrize("program", [DESCRIBED, RUN])
def test_a_module_that_is_imported_by_a_process_of_its_task_starts_nothing(tmp_path, monkeypatch, program):
    """Each such process would import the module, too, and start further ones."""
    name = f"starts_{program is RUN}"
    (tmp_path / f"{name}.py").write_text(program.format(name=name, out=str(tmp_path / "run")))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(DEPTH, child_environment()[DEPTH])
    with pytest.raises(TaskError, match=f'while {name} is imported, .* below `if __name__ == "__main__":` in {name}'):
        importlib.import_module(name)
    assert not (tmp_path / "run").exists()


def test_a_function_may_have_runs_of_its_own_but_not_without_end(monkeypatch):
    for depth in range(MOST_DEPTH):
        assert os.environ.get(DEPTH, "0") == str(depth)
        require_no_import_of_a_task()
        monkeypatch.setenv(DEPTH, child_environment()[DEPTH])
    with pytest.raises(TaskError, match="3 deep"):
        TASKS["function:tests.workers.functions:bowl"]
