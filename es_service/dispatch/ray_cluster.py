"""Joining a Ray cluster or starting one, and watching who belongs to it.

Nothing of the caller's changes: signal handlers and environment are as before once a call returns.
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import secrets
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from es_service.config.compute import ENGINE_IMPLIES
from es_service.errors import EvaluationError, Interrupted, WayOut
from es_service.logs import logger

_LOG = logger(__name__)
OBJECT_STORE_BYTES = 200 * 2**20
"""Shared memory of a local Ray: a few centres and gradient blocks. Ray would take a third of the machine's."""
CONNECT_S = 5.0
"""Longest wait for the port of a cluster to answer; Ray itself would try for more than a minute."""
MEMBERSHIP_S = 1.0
"""Time between two looks at the nodes of a cluster."""
SILENCE_S = 20.0
"""A cluster that has not answered for so long has lost its head. Ray would end this process after a minute."""
PAUSE_S = 5.0
"""Between two questions of whether the cluster answers, after which its silence is counted anew."""
TOKEN = secrets.token_hex(32)
"""For every Ray that this process starts: Ray reads the token of a process only once, and else writes one into HOME."""
SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing phones home
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # actors without a GPU hide the GPUs themselves
}
LOCAL_SETTINGS = {
    "RAY_task_events_report_interval_ms": "0",  # a record of each call for a dashboard that is not there
    "RAY_enable_metrics_collection": "0",
}
"""Further ones for a Ray of our own; without them its own bookkeeping takes a tenth of a small generation."""
WITHOUT_RAY = WayOut(
    "resume", "go on on this machine without Ray", settings={"compute.engine": "inline", **ENGINE_IMPLIES["inline"]}
)


@dataclass(frozen=True)
class Claim:
    """What one worker needs of a node."""

    cpus: int = 1
    gpus: float = 0.0

    def __str__(self) -> str:
        return f"{self.cpus} CPU" + (f" and {self.gpus:g} GPU" if self.gpus else "")


ONE_CORE = Claim()


@dataclass(frozen=True)
class Membership:
    """The nodes of a cluster at one moment."""

    room: int
    """Workers that the nodes which are alive, and stay, could hold together."""
    leaving: frozenset[str]
    """Ids of the nodes that are about to go and want no more work."""
    alive: frozenset[str]
    """Ids of the nodes that are there, those about to go among them."""


def connect(address: str | None, claim: Claim, cpus: int) -> ModuleType:
    """The `ray` module, in a cluster: that at `address`, or with None a new one here that counts `cpus` CPUs.

    Raises:
        EvaluationError: Ray is missing, in use by this process already, does not start, or no cluster takes us in.
        Interrupted: SIGTERM arrived meanwhile.
    """
    ways_out = [WITHOUT_RAY]
    options: dict[str, Any] = {"address": address}
    settings = dict(SETTINGS)
    if address is None:
        options = {
            "address": "local",
            "num_cpus": cpus,
            "num_gpus": None if claim.gpus else 0,  # None: as many as Ray finds
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
        settings |= LOCAL_SETTINGS | {"RAY_AUTH_TOKEN": os.environ.get("RAY_AUTH_TOKEN", TOKEN)}
    with _signal_handlers_kept(), _environment_kept(settings):
        try:
            import ray
        except ImportError as error:
            raise EvaluationError(f"Ray cannot be imported ({error}); install it", ways_out=ways_out) from error
        if ray.is_initialized():
            raise EvaluationError("this process uses Ray already; call ray.shutdown() first", ways_out=ways_out)
        try:
            if address not in (None, "auto"):
                _knock(address)
            ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
        except SystemExit as stop:  # Ray's handler of SIGTERM, which takes the place of ours, exits with its number
            ray.shutdown()
            if stop.code != signal.SIGTERM:
                raise
            raise Interrupted(signal.SIGTERM) from stop
        except Exception as error:  # Ray raises many kinds: ConnectionError, RuntimeError, ValueError, TimeoutError ...
            if address is None:
                raise EvaluationError(f"Ray does not start on this machine: {error}", ways_out=ways_out) from error
            raise EvaluationError(
                f"could not connect to a Ray cluster at {address}: {error}. Check the address, that RAY_AUTH_TOKEN is "
                f"the cluster's (with RAY_AUTH_MODE=token), and that it has this Ray ({ray.__version__}) and this "
                f"Python ({platform.python_version()})",
                field="compute.address",
                value=address,
                ways_out=ways_out,
            ) from error
    _let_print(ray, False)
    _LOG.info("joined a Ray cluster (%s), Ray %s", address or "one of our own on this machine", ray.__version__)
    return ray


def disconnect(ray: ModuleType, *, forget: bool = False) -> None:
    """Leave the cluster; one of our own ends.

    Args:
        forget: delete the folder in which a Ray of our own kept its logs, which Ray itself never does.
    """
    _let_print(ray, True)
    folder = _session_folder(ray) if forget else None
    with _signal_handlers_kept():
        ray.shutdown()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
        latest = folder.with_name("session_latest")
        with contextlib.suppress(OSError):
            if not latest.exists():  # Ray puts no other link in the place of one that leads nowhere
                latest.unlink()


def look(ray: ModuleType, claim: Claim) -> Membership:
    """Who belongs to the cluster now. Blocks for as long as its head does not answer."""
    leaving = frozenset(_draining(ray))
    alive = {node["NodeID"]: node["Resources"] for node in ray.nodes() if node["Alive"]}
    room = sum(_room(resources, claim) for node, resources in alive.items() if node not in leaving)
    return Membership(room, leaving, frozenset(alive))


def demand(ray: ModuleType, claim: Claim) -> str:
    """What workers need, and what there is."""
    return (
        f"Each needs {claim}; the cluster has {_resources(ray.cluster_resources())} in all, free are "
        f"{_resources(ray.available_resources())}"
    )


class Watch:
    """Looks at the cluster again and again in a thread of its own, since a look may block."""

    def __init__(self, ray: ModuleType, claim: Claim) -> None:
        self._ray, self._claim = ray, claim
        self._latest = look(ray, claim)
        self._answered_s = self._asked_s = time.monotonic()
        self._end = threading.Event()
        threading.Thread(target=self._run, daemon=True, name="cluster-watch").start()

    def latest(self) -> Membership:
        """What was seen last. Raises EvaluationError if that was more than SILENCE_S ago."""
        now = time.monotonic()
        if now - self._asked_s > PAUSE_S:  # this process was stopped, or busy: no silence of the cluster's
            self._answered_s = now
        self._asked_s = now
        silent_s = now - self._answered_s
        if silent_s > SILENCE_S:
            raise EvaluationError(
                f"the Ray cluster has not answered for {silent_s:.0f} s: its head node is gone or out of reach. "
                "Start a cluster again and resume there, or on this machine alone",
                ways_out=[WITHOUT_RAY],
            )
        return self._latest

    def close(self) -> None:
        """Look no more."""
        self._end.set()

    def _run(self) -> None:
        while not self._end.wait(MEMBERSHIP_S):
            with contextlib.suppress(Exception):  # of many kinds, all of them meaning: no answer
                self._latest = look(self._ray, self._claim)
                self._answered_s = time.monotonic()


def _room(resources: dict[str, float], claim: Claim) -> int:
    """Workers that a node with these resources can hold."""
    by_cpu = int(resources.get("CPU", 0.0) / claim.cpus)
    # Ray does not split one worker's share over two GPUs.
    by_gpu = int(resources.get("GPU", 0.0)) * int(1 / claim.gpus) if 0 < claim.gpus < 1 else by_cpu
    if claim.gpus >= 1:
        by_gpu = int(resources.get("GPU", 0.0) / claim.gpus)
    return min(by_cpu, by_gpu)


def _resources(amounts: dict[str, float]) -> str:
    """The resources that matter here, as a user would name them."""
    return ", ".join(f"{amounts.get(name, 0.0):g} {name}" for name in ("CPU", "GPU"))


def _draining(ray: ModuleType) -> dict[str, int]:
    """Ids of nodes being drained. Ray has no public way to ask; if this one goes, a drained node is lost later."""
    with contextlib.suppress(AttributeError):
        return ray._private.state.state.get_draining_nodes()
    return {}


def _session_folder(ray: ModuleType) -> Path | None:
    """Where Ray keeps logs and sockets of this session. It has no public way to ask; if this one goes, they stay."""
    with contextlib.suppress(AttributeError):
        return Path(ray._private.worker._global_node.get_session_dir_path())
    return None


def _let_print(ray: ModuleType, allowed: bool) -> None:
    """Whether Ray may print on our stdout: each loss of a worker, at length, which we report ourselves."""
    ray._private.worker._worker_logs_enabled = allowed


def _knock(address: str) -> None:
    """Raise OSError or ValueError unless something listens at HOST:PORT."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdigit():
        raise ValueError(f"{address!r} is neither HOST:PORT nor auto")
    socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()


@contextlib.contextmanager
def _signal_handlers_kept() -> Iterator[None]:
    """Ray replaces the SIGTERM handler; put back what was there. Elsewhere than in the main thread it cannot."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _environment_kept(settings: dict[str, str]) -> Iterator[None]:
    """Environment variables for the processes that Ray starts; afterwards ours are as before."""
    before = dict(os.environ)
    os.environ.update(settings)
    try:
        yield
    finally:
        # Nothing but what differs, since threads of Ray's may be reading the rest.
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        for name, value in before.items():
            if os.environ.get(name) != value:
                os.environ[name] = value
