"""Child processes that answer one question, and tasks of users that start runs in them."""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path

import pytest

from es_service.config.tasks import TASKS
from es_service.errors import TaskError
from es_service.protocol.parent import answer_of
from es_service.protocol.process_environment import DEPTH, MOST_DEPTH, child_environment, require_no_import_of_a_task

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


def shell(program: str) -> list[str]:
    """A child that is a shell, whose $0 is the file for the answer."""
    return ["/bin/sh", "-c", program]


def is_running(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_process_that_a_simulator_leaves_delays_no_answer_and_is_ended(tmp_path):
    """It holds the child's stdout and stderr open, as a server does that a simulator starts."""
    begun_s = time.monotonic()
    told = answer_of(shell(f"sleep 99 & echo $! > {tmp_path}/pid; echo noise; echo words >&2; printf 3 > $0"), LONG_S)
    assert (told.content, told.code, told.errors) == (b"3", 0, "words")
    assert time.monotonic() - begun_s < LONG_S / 2
    left = int((tmp_path / "pid").read_text())
    while is_running(left):  # it has been killed, and its new parent may take a moment to see that
        assert time.monotonic() - begun_s < LONG_S / 2
        time.sleep(0.001)


def test_an_answer_counts_however_the_child_ends():
    told = answer_of(shell("printf 3 > $0; echo crashed >&2; kill -SEGV $$"), LONG_S)
    assert (told.content, told.errors) == (b"3", "crashed")
    told = answer_of(shell("echo why >&2; exit 4"), LONG_S)
    assert (told.content, told.code, told.errors) == (None, 4, "why")
    told = answer_of(shell("exec sleep 99"), 0.01)
    assert (told.content, told.code) == (None, None)


def test_a_thread_that_does_not_end_delays_no_answer():
    lines = (
        "import sys, threading",
        "from es_service.protocol import parent",
        "threading.Thread(target=threading.Event().wait).start()",
        "parent.write_answer(sys.argv[1], b'3')",
        "parent.END_S = 0.01",
        "parent.end_soon()",
    )
    told = answer_of([sys.executable, "-c", "\n".join(lines)], LONG_S)
    assert (told.content, told.code) == (b"3", 0)


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
