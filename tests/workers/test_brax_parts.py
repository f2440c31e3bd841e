"""What is changed of Brax while a substep is traced is the whole process's, and workers are threads of one process."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from workers.environments.ant import physics_step
from workers.environments.brax_task import brax_contact, collisions, pipeline


def test_threads_that_trace_substeps_wait_for_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    def step(system: Any, state: Any, action: Any) -> Any:
        time.sleep(0.01)  # Brax takes its time, too, before it comes to what was changed
        return pipeline.collisions.resolve(system, state)

    monkeypatch.setattr(pipeline, "step", step)
    monkeypatch.setattr(collisions, "resolve", lambda system, state: state)
    threads = 8
    together, found = threading.Barrier(threads), {}

    def trace(number: int) -> None:
        together.wait()
        anything: Any = number
        found[number] = physics_step(anything, anything, anything, None)

    started = [threading.Thread(target=trace, args=(number,)) for number in range(threads)]
    for thread in started:
        thread.start()
    for thread in started:
        thread.join()
    assert found == {number: (number, number) for number in range(threads)}
    assert (pipeline.collisions, collisions.contact) == (collisions, brax_contact)
