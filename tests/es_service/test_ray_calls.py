"""Calls of Ray actors: whose answer comes next, and what it costs to find it."""

from __future__ import annotations

import pytest

from es_service.dispatch.ray_calls import MANY, Call, Calls


class Waits:
    """Of Ray only `wait`, which keeps the order of what it is given."""

    def __init__(self) -> None:
        self.answered: set[str] = set()
        self.looked_at = 0

    def wait(self, refs: list[str], num_returns: int, timeout: float) -> tuple[list[str], list[str]]:
        self.looked_at += len(refs)
        return [ref for ref in refs if ref in self.answered][:num_returns], []


def calls_of(ray: Waits, workers: int, each: int) -> Calls:
    calls = Calls(ray)  # pyright: ignore[reportArgumentType]
    for number in range(each):
        for worker in range(workers):
            calls[f"{worker} {number}"] = Call(worker, "run", number, 1)
    return calls


def read(calls: Calls) -> list[Call]:
    """All answers that are there."""
    found = []
    while (ref := calls.answered(0.0)) is not None:
        found.append(calls[ref])
        del calls[ref]
    return found


@pytest.mark.parametrize("workers", [2, MANY + 1])
def test_answers_of_a_worker_come_in_the_order_of_its_calls_and_none_of_one_that_was_forgotten(workers):
    """An answer that is there before an older one waits for it, as a node's refusal did not for the node's name."""
    ray = Waits()
    calls = calls_of(ray, workers, 3)
    ray.answered = {f"{worker} {number}" for worker in range(workers) for number in (2, 1)}
    assert calls.answered(0.0) is None
    ray.answered |= {f"{worker} 0" for worker in range(workers)}
    first = calls.answered(0.0)
    assert first is not None
    assert calls[first] == Call(0, "run", 0, 1)
    calls.forget(1)
    assert calls.owed_first() == {worker: "run" for worker in range(workers) if worker != 1}
    found = read(calls)
    assert all([c.item_id for c in found if c.worker == w] == [0, 1, 2] * (w != 1) for w in range(workers))
    assert len(calls) == 0
    assert calls.owed_first() == {}


def test_the_cost_of_many_answers_is_not_the_square_of_their_number():
    ray = Waits()
    calls = calls_of(ray, 1000, 3)
    ray.answered = {f"{worker} {number}" for worker in range(1000) for number in range(3)}
    assert len(read(calls)) == 3000
    assert ray.looked_at <= 2 * 3000
