"""The scheduler in a simulated world, from many seeds."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.es_service.scheduler_world import simulate

SEEDS, BLOCKS = 3000, 10


@pytest.fixture(scope="module")
def seen() -> Counter[str]:
    """Which rare things happened over all simulations."""
    return Counter()


@pytest.mark.parametrize("block", range(BLOCKS))
def test_every_task_is_delivered_once_or_the_run_fails_for_a_reason(block, seen):
    for seed in range(block, SEEDS, BLOCKS):
        try:
            world = simulate(seed)
        except Exception as error:
            error.add_note(f"seed {seed}")
            raise
        seen.update(world.seen)
        seen["failed" if world.failed else "survived faults" if world.lost else "untouched"] += 1


def test_the_simulation_reached_every_rare_case(seen):
    if seen["failed"] + seen["survived faults"] + seen["untouched"] < SEEDS:
        pytest.skip("not all simulations ran")
    rare = ("poison", "start failures", "no worker", "no place", "placed late", "quarantine", "deadline")
    rare += ("no first place", "superseded result", "lost while draining", "survived faults")
    rare += ("compiled too long", "long", "hangs after progress", "copy", "copy was first", "copy charged")
    too_rare = {case: seen[case] for case in rare if seen[case] < 20}
    assert not too_rare
    assert seen["failed"] < SEEDS / 2
