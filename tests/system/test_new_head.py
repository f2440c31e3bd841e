"""What a run does whose cluster is replaced by another one at the same address, as a supervisor does on its host."""

import signal

import pytest

from tests.system import cluster
from tests.system.chaos_world import HEAD, World
from tests.system.test_chaos import CONFIG

pytestmark = [pytest.mark.long, pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))]


def test_a_driver_whose_head_is_replaced_says_so_and_ray_does_not_end_it(tmp_path):
    """Ray ends a process that asks a new head for the nodes of the old one."""
    with World(tmp_path, CONFIG, clock=False) as world:
        world.may_end = True
        world.signal(world.pids(HEAD, "gcs_server"), signal.SIGKILL)
        world.wait(lambda: world.ends)
        (end,) = world.ends
        world.wait(lambda: world.tally.sessions == 2)
    assert end.code == 1, end.printed
    assert "another one was started at its address" in end.printed
    assert f"es-service resume {world.disk / 'run'}" in end.printed
