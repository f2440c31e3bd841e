"""What a worker reports: what it prints, and that it should be replaced."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from es_service.protocol.errors import TaskError
from es_service.protocol.machine import memory_of_tree_bytes
from es_service.protocol.messages import EpisodesResult, Moments, Report
from es_service.protocol.process_environment import cut, newest_lines
from es_service.runs.engine import reader_of_reports
from es_service.store.lock import MOST_LINE, MOST_LINES, acquire_lock, last_output, lock_holder
from tests.helpers import spec
from workers import reports
from workers.actor import KEPT_LOGS, remove_old_logs
from workers.reports import Reports, Tail, printable, require_room

MIB = 2**20


def result(episodes, *, trains=False):
    zeros = np.zeros((episodes // 2, 2) if trains else episodes, np.float32)
    moments = Moments(0.0, np.zeros(1), np.zeros(1)) if trains else None
    return EpisodesResult(zeros, zeros, zeros[..., None], zeros.astype(np.int32), zeros, moments)


def test_of_a_file_the_newest_lines_are_read_once_also_after_its_beginning_was_cut_off(tmp_path):
    with open(tmp_path / "printed", "a+b", buffering=0) as file:
        file.write(b"before\n")
        tail = Tail(file.fileno())
        assert tail.new() == ""
        file.write(b"one\ntwo\r\n")
        assert (tail.new(), tail.new()) == ("one\ntwo", "")
        file.write(b"".join(b"%4d\n" % number for number in range(1000)))
        assert tail.new(10) == " 998\n 999"
        file.write(b"a long line\nthe next\n")
        assert tail.new(14) == "the next"
        file.write(b"a line that does not end")
        assert tail.new(3) == "end"
        file.write(b"\n")
        assert tail.new() == ""
        cut(file.fileno(), 100)
        file.write(b"after\n")
        assert tail.new().endswith("not end\nafter")
        assert newest_lines(file.fileno(), 9) == b"after\n"
        assert newest_lines(file.fileno(), 6) == b"after\n"
        tail.close()
        file.write(b"late\n")
        assert tail.new() == ""
    ends = os.pipe()
    assert not Tail(ends[1]).is_readable
    for end in ends:
        os.close(end)


def test_what_would_change_how_a_terminal_shows_other_lines_is_left_out():
    assert printable(b"\x1b[31mred\x1b[0m\x07 1 %\r 2 %\n\n\tx\xff\n") == "red 1 %\n 2 %\n        x\ufffd"


def test_a_worker_says_once_that_it_has_computed_its_episodes():
    worker = Reports(spec(recycle_after_episodes=10, episodes_per_member=2), cores=2)
    worker.note([result(4, trains=True), result(11), SimpleNamespace()])
    assert worker.report() is None, "8 of training and 11 others, of 20 for two cores"
    worker.note([result(1)])
    report = worker.report()
    assert report == Report("", "it has computed 20 episodes (task.recycle_after_episodes)")
    worker.note([result(50)])
    assert worker.report() is None


def test_a_worker_says_that_it_has_more_memory_than_it_may_and_is_refused_if_it_begins_with_that(monkeypatch):
    monkeypatch.setattr(reports, "LOOK_S", 0.0)
    monkeypatch.setattr(reports, "memory_of_tree_bytes", lambda: 250 * MIB)
    assert Reports(spec(memory_bytes=250 * MIB)).report() is None
    assert Reports(spec(memory_bytes=125 * MIB), cores=2).report() is None
    report = Reports(spec(memory_bytes=249 * MIB)).report()
    assert report == Report("", "it has 250 MiB of memory after 0 episodes (compute.worker_memory_mb)")
    require_room(spec(memory_bytes=125 * MIB), cores=2)
    with pytest.raises(TaskError, match=r"worker_memory_mb = 249 is too little: before its first .* has 250 MiB"):
        require_room(spec(memory_bytes=249 * MIB))


def test_memory_is_that_of_a_process_and_of_all_that_it_has_started():
    code = "x = bytes(b'1') * (64 << 20); print(flush=True); input()"
    before = memory_of_tree_bytes()
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert 64 * MIB < memory_of_tree_bytes() - before < 128 * MIB
        child.communicate(b"\n")


def test_the_newest_lines_are_read_by_others_and_the_first_replacement_is_a_notice(tmp_path):
    lock, notices, lines = acquire_lock(tmp_path), [], []
    read = reader_of_reports(notices.append, lines.append, lock)
    assert last_output(tmp_path) == ()
    read("worker 3", Report("a\nb", ""))
    assert (lines, last_output(tmp_path)) == (["worker 3: a", "worker 3: b"], ("worker 3: a", "worker 3: b"))
    lock.say(doing="compiling")
    assert (lock_holder(tmp_path) or {})["doing"] == "compiling"
    assert last_output(tmp_path)[-1] == "worker 3: b"
    read("worker 4", Report("\n".join(["é" * 1000] * 50), "it leaks"))
    read("worker 5", Report("", "it leaks, too"))
    lock.note_end("done")
    lock.release()
    assert last_output(tmp_path) == tuple([f"worker 4: {'é' * 1000}"[:MOST_LINE]] * MOST_LINES)
    (notice,) = notices
    assert notice.startswith("worker 4 is replaced by a new process, since it leaks. Later replacements are in the log")


def files_of(worker):
    """Files of a worker of Ray, whose output is named worker-ID-JOB-PROCESS."""
    _, number, _, process = worker.split("-")
    return f"{worker}.out", f"{worker}.err", f"python-core-worker-{number}_{process}.log"


def test_of_the_output_of_ended_workers_of_a_job_the_newest_files_stay(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    names = [f"worker-{number:02}-01000000-{ended.pid}" for number in range(KEPT_LOGS + 3)]
    others = [f"worker-aa-02000000-{ended.pid}", f"worker-bb-01000000-{os.getpid()}"]
    for number, name in enumerate([*others, *names]):
        for file in files_of(name):
            (tmp_path / file).touch()
            os.utime(tmp_path / file, (number, number))
    remove_old_logs(Path("pipe:[1]"))  # where a process that is none of Ray's prints
    remove_old_logs(tmp_path / f"{others[1]}.out")
    left = {file.name for file in tmp_path.iterdir()}
    assert left == {file for name in [*others, *names[3:]] for file in files_of(name)}
