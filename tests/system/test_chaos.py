"""A run on four hosts with faults of every kind at random ends as one that nobody disturbed.

`ES_CHAOS_SEED=7 pytest tests/system/test_chaos.py -s` plays another plan, and prints the table of costs.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from es_service import api
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.dispatch_checker import check_dispatch
from tests.system import chaos, chaos_world, cluster
from tests.system.chaos_world import World
from tests.system.processes import ROOT
from tests.system.session import SMALL
from tests.system.test_cluster import inline_digest

pytestmark = [
    pytest.mark.long,
    pytest.mark.alone,  # one of its faults is that memory is short
    pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing())),
]
SEED = int(os.environ.get("ES_CHAOS_SEED", "11"))
CONFIG = SMALL | {
    "search": {"algorithm": "me_es", "pairs": 64, "evaluation_episodes": 16, "block_generations": 5},
    "budget": {"generations": 1_000_000},
    "compute": {
        "engine": "ray",
        "chunk_pairs": 8,
        "gradient_block_pairs": 64,
        "chunk_timeout_s": 4.0,
        "compile_timeout_s": 30.0,
        "max_attempts": 20,
        "no_worker_timeout_s": 180.0,
        "dispatch_log": True,
    },
}
"""Eight training chunks, one gradient chunk and one evaluation chunk a generation; a map and blocks from elites."""


LOOK = """
import sys, threading, time
from tests.system.chaos_world import set_clock
from pathlib import Path
before = time.time(), time.monotonic()
set_clock(Path(sys.argv[1]), 3600)
threading.Event().wait(0.2)
print(time.time() - before[0], time.monotonic() - before[1])
"""
SEND = """
import socket, time
ends = socket.create_server(("127.0.0.1", 0))
near = socket.create_connection(ends.getsockname())
far, _ = ends.accept()
began, left = time.monotonic(), 2**16
near.sendall(bytes(left))
while left:
    left -= len(far.recv(left))
print(time.monotonic() - began)
"""


@pytest.fixture
def can_have(request):
    """Skips a test of a kind of fault, by its name, where it cannot be had."""
    if reason := chaos.missing().get(request.param):
        pytest.skip(f"no faults of the kind {request.param!r}: {reason}")


@pytest.mark.parametrize("can_have", ["clock moved"], indirect=True)
@pytest.mark.usefixtures("can_have")
def test_a_wall_clock_is_moved_while_a_process_runs_and_its_waits_stay_as_long(tmp_path):
    chaos_world.build_clock(tmp_path)
    chaos_world.set_clock(tmp_path / "clock", 0)
    environment = os.environ | chaos_world.with_clock(tmp_path, "clock")
    command = [sys.executable, "-c", LOOK, tmp_path / "clock"]
    ran = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    wall_s, monotonic_s = map(float, ran.stdout.split())
    assert wall_s == pytest.approx(3600 + monotonic_s, abs=1.0)
    assert 0.1 < monotonic_s < 50.0


@pytest.mark.parametrize("can_have", ["link slow"], indirect=True)
@pytest.mark.usefixtures("can_have")
def test_a_link_is_slow_as_long_as_it_is_limited(tmp_path):
    """64 KiB at 256 kbit/s, of which 16 kB pass at once, take a second and a half."""
    limit = f'ip link set lo mtu 1500 up && tc qdisc add dev lo root {" ".join(chaos.SLOW)} && exec "$@"'
    command = ["unshare", "--net", "sh", "-c", limit, "sh", sys.executable, "-c", SEND]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert float(ran.stdout) > 1.0


@pytest.mark.parametrize(
    ("seconds", "kinds"),
    [
        pytest.param(60.0, 6, marks=pytest.mark.timeout(1200)),
        pytest.param(600.0, len(chaos.FAULTS), marks=pytest.mark.timeout(3600)),
    ],
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
    """Median seconds of a generation."""
    return float(api.open_run(run).history["wall_clock_s"].diff().median())
