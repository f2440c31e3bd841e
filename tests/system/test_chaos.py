"""A run on four hosts with faults of every kind at random ends as one that nobody disturbed.

`ES_CHAOS_SEED=7 pytest tests/system/test_chaos.py -s` plays another plan, and prints the table of costs.
"""

import os
import statistics
from itertools import pairwise
from pathlib import Path

import pytest

from es_service import api
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.dispatch_checker import check_dispatch, read_dispatch_log
from tests.system import chaos, cluster
from tests.system.chaos_world import World
from tests.system.session import SMALL
from tests.system.test_cluster import inline_digest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]
SEED = int(os.environ.get("ES_CHAOS_SEED", "0"))
CONFIG = SMALL | {
    "search": {"algorithm": "me_es", "pairs": 64, "evaluation_episodes": 16, "block_generations": 5},
    "budget": {"generations": 1_000_000},
    "compute": {
        "engine": "ray",
        "chunk_pairs": 8,
        "gradient_block_pairs": 64,
        "chunk_timeout_s": 4.0,
        "compile_timeout_s": 30.0,
        "dispatch_log": True,
    },
}
"""Eight training chunks, one gradient chunk and one evaluation chunk a generation; a map and blocks from elites."""


@pytest.mark.parametrize("kind", chaos.FAULTS)
def test_this_machine_can_have_every_kind_of_fault(kind):
    if reason := chaos.missing().get(kind):
        pytest.skip(f"no faults of the kind {kind!r}: {reason}")


@pytest.mark.parametrize(
    ("seconds", "kinds"),
    [(60.0, 6), pytest.param(600.0, len(chaos.FAULTS), marks=[pytest.mark.long, pytest.mark.timeout(2400)])],
    ids=["one minute", "ten minutes"],
)
def test_faults_at_random_change_nothing(tmp_path, seconds, kinds):
    lacks = chaos.missing()
    possible = [kind for kind in chaos.FAULTS if kind not in lacks]
    with World(tmp_path, CONFIG, clock="clock moved" in possible) as world:
        costs = chaos.play(world, SEED, seconds, possible, min(kinds, len(possible)))
        assert world.stop() == 143, world.state()
    run = world.run_folder
    for end in world.ends:
        print(f"a driver ended with {end.code}: {(end.printed.strip() or 'nothing').splitlines()[-1]}")
    print(chaos.table(costs, usual_generation_s(run)))

    counts = check_dispatch(run)
    reached = read_generation(run)
    print(f"{len(costs)} faults, {counts}")
    assert counts["generations"] <= reached + 1
    assert list(api.open_run(run).history.index) == list(range(reached + 1))
    assert digest_parts(run) == inline_digest(tmp_path / "inline", CONFIG, reached)


def usual_generation_s(run: Path) -> float:
    """Median seconds between two commits."""
    times = [entry["time"] for entry in read_dispatch_log(run) if entry["is"] == "Committed"]
    return statistics.median(b - a for a, b in pairwise(times))
