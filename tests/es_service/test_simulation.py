"""Generations on simulated workers, by hand: how long they take and what limits them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.dispatch.simulation import Costs, Phase, predict

KINDS = ("TrainingChunk", "GradientChunk", "EvaluationChunk")


def generation(rollout, gradient, evaluation):
    counts = zip(("rollout", "gradient", "evaluation"), KINDS, (rollout, gradient, evaluation), strict=True)
    return [Phase(name, kind, chunks) for name, kind, chunks in counts]


def costs(message_s=0.0, way_s=0.0, driver_s=0.0, **chunk_s):
    seconds = {"TrainingChunk": 1.0, "GradientChunk": 0.1, "EvaluationChunk": 0.5} | chunk_s
    return Costs(seconds, dict.fromkeys(KINDS, message_s), dict.fromkeys(KINDS, way_s), driver_s)


def predicted(phases, paid, actors, cores=1, **more):
    """Every core takes equally many chunks, and the scheduler no time."""
    return predict(phases, paid, actors, cores, lambda chunks: -(-chunks // cores), lambda: 0.0, **more)


def test_one_worker_takes_the_sum_of_all():
    found = predicted(generation(8, 2, 2), costs(), 1)
    assert found.seconds == pytest.approx(8.0 + 0.2 + 1.0)
    assert found.efficiency == pytest.approx(1.0)
    assert found.limit == "nothing"


@pytest.mark.parametrize(("actors", "cores"), [(4, 1), (2, 2), (1, 4)])
def test_each_phase_takes_its_longest_worker(actors, cores):
    found = predicted(generation(10, 4, 2), costs(), actors, cores)  # 3 rounds, 1 round, 1 round for two of four
    assert found.seconds == pytest.approx(3.0 + 0.1 + 0.5)
    assert found.efficiency == pytest.approx((10 + 0.4 + 1) / (4 * 3.6))


def test_messages_cost_the_driver_time_and_the_worker_time_on_their_way():
    found = predicted(generation(1, 1, 1), costs(message_s=0.02, way_s=0.3), 1)
    assert found.seconds == pytest.approx(1.6 + 3 * (0.02 + 0.6))
    behind = predicted(generation(100, 1, 1), costs(message_s=0.5, way_s=0.0), 100)
    assert behind.seconds > 50.0, "the driver sends and receives one hundred messages"
    assert behind.limit == "the driver"


def test_what_the_driver_does_beside_rollouts_counts_as_far_as_it_takes_longer_than_they_do():
    paid = replace(costs(), beside_s=3.0)
    assert predicted(generation(8, 2, 2), paid, 1).seconds == pytest.approx(8.0 + 0.2 + 1.0)
    hurried = predicted(generation(8, 2, 2), paid, 8)
    assert hurried.seconds == pytest.approx(3.0 + 0.1 + 0.5)
    assert hurried.limit == "the driver"


def test_each_further_chunk_of_an_item_may_cost_the_driver_time():
    """A worker with eight cores takes eight chunks in a work item."""
    paid = replace(costs(message_s=0.02), chunk_message_s={"TrainingChunk": 0.1})
    phases = [Phase("rollout", "TrainingChunk", 8)]
    assert predicted(phases, paid, 1, cores=8).seconds == pytest.approx(1.0 + 0.02 + 7 * 0.1)
    assert predicted(phases, paid, 8).seconds == pytest.approx(1.0 + 8 * 0.02, abs=0.09)
    assert predicted([Phase("rollout", "GradientChunk", 8)], paid, 1, cores=8).seconds == pytest.approx(0.1 + 0.02)


@pytest.mark.parametrize(
    ("phases", "paid", "workers", "limit"),
    [
        (generation(4, 4, 4), costs(), 64, "too few items"),
        (generation(64, 64, 2), costs(EvaluationChunk=2.0), 64, "evaluation"),
        (generation(64, 64, 64), costs(driver_s=9.0), 64, "the driver"),
        (generation(129, 64, 64), costs(), 64, "the longest item"),
        (generation(6400, 64, 64), costs(), 64, "nothing"),
    ],
)
def test_what_limits(phases, paid, workers, limit):
    assert predicted(phases, paid, workers).limit == limit


@given(st.integers(1, 200), st.integers(1, 20), st.integers(1, 8), st.floats(0.0, 0.01))
def test_the_time_is_never_shorter_than_the_work_and_efficiency_is_a_share(chunks, actors, cores, message_s):
    found = predicted(generation(chunks, 1, 1), costs(message_s=message_s, driver_s=0.01), actors, cores)
    assert found.seconds >= chunks / (actors * cores) - 1e-9
    assert 0.0 < found.efficiency <= 1.0


@pytest.mark.parametrize("slowness", [5.0, 25.0])
def test_a_slow_worker_holds_up_a_phase_for_two_items_however_slow_it_is(slowness):
    """Three of four workers take an item each and one of them the slow one's too; without copies all wait for it."""

    def slow(actor):
        return slowness if actor == 0 else 1.0

    phases = [Phase("rollout", "TrainingChunk", 4)]
    assert predicted(phases, costs(), 4).seconds == pytest.approx(1.0)
    assert predicted(phases, costs(), 4, slowness=slow).seconds == pytest.approx(2.0)
    assert predicted(phases, costs(), 4, slowness=slow, late_factor=math.inf).seconds == pytest.approx(slowness)
    many = [Phase("rollout", "TrainingChunk", 400)]
    found = predicted(many, costs(), 4, slowness=slow)
    assert found.seconds <= 400 / (3 + 1 / slowness) + 2.0
    assert predicted(many, costs(), 4, slowness=slow, late_factor=math.inf).seconds > found.seconds


def test_equal_workers_get_no_second_copies():
    phases, paid = generation(64, 16, 4), costs(message_s=0.002, way_s=0.001)
    assert predicted(phases, paid, 16) == predicted(phases, paid, 16, late_factor=math.inf)
