import fcntl
import os
import socket
import subprocess
import sys
import threading
import time

import pytest

from es_service.errors import RunLockedError, StoreError, WayOut
from es_service.loop.state import Generation
from es_service.store import lock as run_lock
from es_service.store.lock import acquire_lock, last_end, lock_holder
from es_service.store.writer import RunStore
from tests.es_service.store_examples import create, finished


def test_a_second_writer_is_told_who_writes_and_how_to_watch(tmp_path):
    folder = tmp_path / "run"
    with create(folder, generations=1) as store:
        with pytest.raises(
            RunLockedError, match=f"process {os.getpid()} on host {socket.gethostname()} since 20"
        ) as info:
            RunStore.open(folder)
        assert info.value.way_out == WayOut("watch", "watch it", str(folder))
        assert "; that is this process itself: leave its block of `ask_tell`, or wait" in str(info.value)
        assert "stop that process" not in str(info.value)
        store.commit(
            [
                Generation(
                    1, {}, dict.fromkeys(("env_steps", "centre_fitness_mean", "goal_distance", "seconds_rollout"), 1)
                )
            ]
        )
    RunStore.open(folder).close()


def test_the_holder_is_known_while_and_only_while_it_holds(tmp_path):
    assert lock_holder(tmp_path) is None
    lock = acquire_lock(tmp_path)
    holder = lock_holder(tmp_path)
    assert holder is not None
    assert (holder["host"], holder["pid"]) == (socket.gethostname(), os.getpid())
    assert holder["since"].startswith("20")
    lock.say(waiting=True)
    waiting = lock_holder(tmp_path)
    assert waiting is not None
    assert waiting["waiting_since"].startswith("20")
    assert holder | {"waiting_since": waiting["waiting_since"]} == waiting
    lock.say(doing="compiling")
    assert lock_holder(tmp_path) == holder | {"doing": "compiling"}
    lock.say()
    assert lock_holder(tmp_path) == holder
    lock.say(waiting=True)
    lock.release()
    lock.release()
    lock.say(waiting=True)
    assert lock_holder(tmp_path) is None


def test_what_a_dead_writer_left_in_the_file_means_nothing(tmp_path):
    (tmp_path / "run.lock").write_text('{"host": "elsewhere", "pid": 1, "since": "long ago", "waiting_since": "then"}')
    assert lock_holder(tmp_path) is None
    lock = acquire_lock(tmp_path)
    holder = lock_holder(tmp_path)
    assert holder is not None
    assert (holder["pid"], holder["waiting_since"]) == (os.getpid(), None)
    lock.release()


def test_how_the_last_session_ended_is_known_until_another_one_ends(tmp_path):
    assert last_end(tmp_path) == ""
    lock = acquire_lock(tmp_path)
    lock.note_end("interrupted by SIGTERM")
    lock.release()
    assert last_end(tmp_path) == "interrupted by SIGTERM"
    acquire_lock(tmp_path).release()  # as of a certification, which is no session
    assert last_end(tmp_path) == "interrupted by SIGTERM"
    for character in ("\u2028", "\U0001f600", "\0", "\udc80"):  # the last one as of a file's name that is no UTF-8
        lock = acquire_lock(tmp_path)
        lock.note_end(character * 100_000)
        lock.release()
        assert last_end(tmp_path) == character * 500
    lock = acquire_lock(tmp_path)
    lock.abandon()  # as a kill does
    killed = f"its driver on {socket.gethostname()}, pid {os.getpid()}, was killed, or its host failed"
    assert last_end(tmp_path) == killed
    acquire_lock(tmp_path).release()
    assert last_end(tmp_path) == killed
    for text in ("", "[", "3", '{"ended": 1}'):
        (tmp_path / "run.lock").write_text(text)
        assert last_end(tmp_path) == ""


def test_a_holder_that_has_not_yet_written_its_name(tmp_path):
    with (tmp_path / "run.lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert lock_holder(tmp_path) == {"host": None, "pid": None, "since": None, "waiting_since": None, "doing": None}
        with pytest.raises(RunLockedError, match=r"process \(unknown\) on host \(unknown\)"):
            acquire_lock(tmp_path)


def test_somebody_looking_at_the_lock_does_not_keep_a_writer_out(tmp_path):
    folder = finished(tmp_path / "run", 1)
    stream = (folder / "run.lock").open()
    fcntl.flock(stream, fcntl.LOCK_SH)
    assert lock_holder(folder) is None
    threading.Timer(0.1, stream.close).start()
    RunStore.open(folder).close()
    assert stream.closed


def test_a_forked_child_that_outlives_the_writer_does_not_hold_the_lock(tmp_path):
    script = (
        "import os, sys, time; from pathlib import Path; from es_service.store.lock import acquire_lock\n"
        "lock = acquire_lock(Path(sys.argv[1]))\n"
        "child = os.fork()\n"
        "if child == 0: time.sleep(60)\n"
        "print(child, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        child = int(writer.stdout.readline())
        try:
            assert lock_holder(tmp_path)["pid"] == writer.pid
            with pytest.raises(RunLockedError, match="; stop that process first, or wait until it ends"):
                acquire_lock(tmp_path)
            writer.kill()
            writer.wait()
            os.kill(child, 0)
            acquire_lock(tmp_path).release()
        finally:
            os.kill(child, 9)


def test_a_lock_file_that_was_replaced_meanwhile_is_not_taken_for_the_lock(tmp_path, monkeypatch):
    real, swapped = fcntl.flock, []

    def flock(descriptor, operation):
        real(descriptor, operation)
        if not swapped:
            swapped.append(True)
            (tmp_path / "run.lock").unlink()

    monkeypatch.setattr(run_lock.fcntl, "flock", flock)
    lock = acquire_lock(tmp_path)
    assert lock_holder(tmp_path)["pid"] == os.getpid()
    lock.release()


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    def flock(descriptor, operation):
        raise OSError(run_lock.errno.ENOLCK, "No locks available")

    monkeypatch.setattr(run_lock.fcntl, "flock", flock)
    with pytest.raises(StoreError, match="does not support file locks"):
        acquire_lock(tmp_path)


def test_being_refused_takes_less_than_two_seconds(tmp_path):
    lock = acquire_lock(tmp_path)
    start = time.monotonic()
    with pytest.raises(RunLockedError):
        acquire_lock(tmp_path)
    assert time.monotonic() - start < 2
    lock.release()
