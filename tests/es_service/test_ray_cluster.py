"""What Ray changes and leaves on this machine, without Ray."""

from __future__ import annotations

import os
import signal
import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest
from test.support import catch_unraisable_exception

from es_service.config.workload import ANY_NUMBER
from es_service.dispatch import ray_cluster, ray_nodes
from es_service.dispatch.events import Limits
from es_service.errors import EvaluationError, Interrupted
from es_service.protocol.policies import ALL_TOGETHER, POLICY_SLOTS
from tests.system.processes import wait_for


def test_variables_that_nobody_changed_are_never_touched(monkeypatch):
    """Threads of Ray's read the environment while ours is restored, and must not find it empty."""
    monkeypatch.setenv("OLD", "old")
    monkeypatch.setenv("SAME", "same")
    monkeypatch.delenv("NEW", raising=False)
    before, touched = dict(os.environ), []
    for function in ("putenv", "unsetenv"):
        monkeypatch.setattr(os, function, lambda name, *_: touched.append(name))
    with ray_cluster.environment_kept({"OLD": "new", "NEW": "new"}):
        os.environ["RAYS_OWN"] = "1"
        assert os.environ["OLD"] == os.environ["NEW"] == "new"
    assert dict(os.environ) == before
    assert set(touched) == {b"OLD", b"NEW", b"RAYS_OWN"}


@pytest.fixture
def found(monkeypatch):
    """A cluster on this machine, whose head accepts this process."""
    monkeypatch.setattr(ray_cluster, "address_here", lambda: "127.0.0.1:6379")
    monkeypatch.setattr(ray_cluster, "require_head", lambda address, *, is_auto: None)


@pytest.mark.usefixtures("found")
def test_a_sentence_of_ray_s_ends_with_one_full_stop(monkeypatch):
    import ray

    def refuse(**_):
        raise ConnectionError("Could not find any running Ray instance. Please specify one.")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(
        EvaluationError, match=r"at auto: Could not find .* specify one\. Check that this host is a node"
    ):
        ray_cluster.connect("auto", gpus=False, cpus=1)


@pytest.mark.usefixtures("found")
def test_sigterm_is_not_lost_where_python_ignores_the_exception_of_ray_s_handler(monkeypatch):
    import ray

    ended, before = [], signal.getsignal(signal.SIGTERM)

    class Finalized:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    def start(**_):
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))
        Finalized()

    monkeypatch.setattr(ray, "init", start)
    monkeypatch.setattr(ray, "shutdown", lambda: ended.append(True))
    with catch_unraisable_exception() as shown:
        with pytest.raises(Interrupted):
            ray_cluster.connect("auto", gpus=False, cpus=1)
        assert shown.unraisable is None
    assert ended == [True]
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("is_latest", [True, False])
def test_a_session_is_forgotten_with_the_link_to_it_and_with_no_other(tmp_path, is_latest):
    ours, other, latest = tmp_path / "session_ours", tmp_path / "session_other", tmp_path / "session_latest"
    for folder in (ours, other):
        (folder / "logs").mkdir(parents=True)
    latest.symlink_to(ours if is_latest else other)
    node = SimpleNamespace(get_session_dir_path=lambda: str(ours))
    worker = SimpleNamespace(_global_node=node)
    ray = SimpleNamespace(_private=SimpleNamespace(worker=worker), shutdown=lambda: delattr(worker, "_global_node"))
    assert latest.exists()
    ray_cluster.disconnect(ray, forget=True)
    assert (ours.exists(), other.exists(), latest.is_symlink()) == (False, True, not is_latest)
    worker._global_node = node
    node.get_session_dir_path = lambda: str(other)
    ray_cluster.disconnect(ray)
    assert other.exists()


@pytest.mark.parametrize(
    ("nodes", "workers", "most", "cores"),
    [
        ([64, 64, 64], None, 10_000, 64),
        ([64, 64], None, 24, 24),  # there is no work for more
        ([64, 64], 128, None, 64),
        ([64, 64], 96, None, 48),  # two actors
        ([4, 4], 7, None, 1),  # a prime
        ([64, 32], None, 10_000, 1),  # nodes that differ
        ([], None, 10_000, 1),  # none yet
        ([1, 1], None, 10_000, 1),
    ],
)
def test_an_actor_owns_a_whole_node_where_nodes_are_equal(nodes, workers, most, cores):
    assert ray_nodes.actor_cores(nodes, workers, most) == cores


@pytest.mark.parametrize(
    ("nodes", "workers", "cpus", "most", "actors", "cores"),
    [
        ([8] * 8, 64, None, 64, 8, 8),
        ([8] * 8, 64, None, 37, 5, 8),
        ([8] * 8, 64, None, 38, 5, 8),
        ([8] * 8, 64, None, 3, 1, 8),
        ([8] * 8, 64, None, ANY_NUMBER, 8, 8),
        ([64, 64], 96, None, 49, 2, 48),
        ([8, 4], 12, None, 5, 5, 1),
        ([8, 8], 5000, 10, 8, 1, 10),
        ([8] * 8, None, None, 37, 5, 8),
        ([64, 64], None, None, 24, 1, 24),
    ],
)
def test_too_little_work_makes_fewer_actors_and_not_smaller_ones(nodes, workers, cpus, most, actors, cores):
    """Messages are counted by actor. Without a number of workers, one node can be too large for all the work."""
    alive = [{"NodeID": str(node), "Resources": {"CPU": float(cpu)}, "Alive": True} for node, cpu in enumerate(nodes)]
    _, limits, _ = ray_nodes.layout(
        SimpleNamespace(nodes=lambda: alive),  # pyright: ignore[reportArgumentType]
        Limits(workers or 1),
        cpus,
        0.0,
        most,
        grows=workers is None,
        ours=False,
    )
    assert (limits.workers, limits.cores) == (actors, cores)
    assert (limits.policies_together == ALL_TOGETHER) == (cores > 1), "which several cores share"


def test_an_actor_with_a_gpu_is_sent_no_more_policies_than_one_core():
    """It has no cores of its own that would take them apart."""
    alive = [{"NodeID": "0", "Resources": {"CPU": 8.0, "GPU": 1.0}, "Alive": True}]
    ray: Any = SimpleNamespace(nodes=lambda: alive)
    claim, limits, _ = ray_nodes.layout(ray, Limits(8), 8, 1.0, 8, grows=False, ours=False)
    assert (claim.cpus, claim.gpus, limits.policies_together) == (8, 1.0, POLICY_SLOTS)


def test_nodes_without_cores_and_dead_ones_do_not_count():
    nodes = [({"CPU": 8.0}, True), ({}, True), ({"CPU": 0.0}, True), ({"CPU": 4.0}, False)]
    ray = SimpleNamespace(nodes=lambda: [{"Resources": has, "Alive": alive} for has, alive in nodes])
    assert ray_nodes.cores_of_nodes(ray) == [8]


class Head:
    """What Ray knows of a head node, which fails with `error`, if there is one; it counts what it is asked then."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.asked = 0
        client = SimpleNamespace(check_alive=self._check)
        draining = SimpleNamespace(get_draining_nodes=self._ask)
        state = SimpleNamespace(state=draining, available_resources_per_node=self._ask)
        worker = SimpleNamespace(global_worker=SimpleNamespace(gcs_client=client))
        self._private = SimpleNamespace(worker=worker, state=state)
        self.nodes = self.cluster_resources = self.available_resources = self._ask

    def _check(self, nodes: list[bytes], timeout: float) -> list[bool]:
        if self.error is not None:
            raise self.error
        return []

    def _ask(self) -> dict:
        self.asked += self.error is not None
        return {}


def test_a_cluster_that_was_replaced_by_another_at_its_address_is_named_at_once(monkeypatch):
    """Ray waits for a head node where it is asked for nodes, and ends the process if that is a new one."""
    monkeypatch.setattr(ray_nodes, "MEMBERSHIP_S", 0.001)
    monkeypatch.setattr(ray_nodes, "SILENCE_S", 60.0)
    head = Head()
    watch = ray_nodes.Watch(head, ray_nodes.ONE_CORE)  # pyright: ignore[reportArgumentType]
    try:
        nodes = watch.latest()
        head.error = RuntimeError("timed out while waiting for GCS")
        time.sleep(0.1)
        head.asked = 0  # it may have been lost in the middle of a look
        time.sleep(0.1)
        assert watch.latest() == nodes
        assert "the head node of the cluster does not answer" in ray_nodes.shortage(head, ray_nodes.ONE_CORE, nodes)
        head.error = RuntimeError("RPC error: WrongClusterID: Perhaps the client is accessing GCS after a restart")
        wait_for(lambda: says(watch, "another one was started at its address"))
        assert head.asked == 0
    finally:
        watch.close()


def says(watch: ray_nodes.Watch, text: str) -> bool:
    """Whether a watch has an error with this text."""
    try:
        watch.latest()
    except EvaluationError as error:
        return text in str(error)
    return False
