"""Processes that tests start: none outlives its test, and waiting for one has an end."""

from __future__ import annotations

import contextlib
import math
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from es_service.errors import StoreError
from es_service.runs import engine
from es_service.store.reader import read_generation

ROOT = Path(__file__).parents[2]


@contextlib.contextmanager
def running(*command: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A process with its output in pipes, unless told otherwise; killed and collected at the end, if it still runs."""
    options = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    with subprocess.Popen([*map(str, command)], **options) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_until(process: subprocess.Popen[str], what: Callable[[], Any], timeout_s: float = 180.0) -> None:
    """Until something is true; a process that ends before, or takes too long, fails with what it printed."""
    until = time.monotonic() + timeout_s
    while not what():
        if process.poll() is not None or time.monotonic() > until:
            process.kill()
            printed = process.communicate()
            raise AssertionError(f"{process.args} ended with {process.returncode}, or was too slow: {printed}")
        time.sleep(0.002)


def wait_for(what: Callable[[], Any], timeout_s: float = 180.0) -> Any:
    """The first true answer."""
    until = time.monotonic() + timeout_s
    while not (answer := what()):
        assert time.monotonic() < until
        time.sleep(0.1)
    return answer


def committed(folder: Path) -> int | None:
    """The newest generation of a run; None before the first, and before there is a run."""
    try:
        return read_generation(folder)
    except StoreError:
        return None


def children() -> list[int]:
    """Process ids of this process's worker processes."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            parent = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
            command = Path(f"/proc/{pid}/cmdline").read_text()
        except OSError:
            continue
        if parent == os.getpid() and "workers.process" in command:
            found.append(int(pid))
    return sorted(found)


def is_running(pid: int | str) -> bool:
    """Whether a process exists and is more than a zombie that nobody has reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def without_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """No work item is sent a second time, so that only a deadline notices a worker that hangs."""
    limits = engine.dispatch_limits
    monkeypatch.setattr(engine, "dispatch_limits", lambda *given: replace(limits(*given), late_factor=math.inf))
