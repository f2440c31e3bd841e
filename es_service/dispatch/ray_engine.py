"""The Ray engine: workers are actors, on this machine or on a cluster. The only file that imports Ray, and only in use.

Ray starts processes and moves messages. Retries, deadlines and replacements are the scheduler's: actors are never
restarted by Ray and calls are never repeated by it, so each fault is seen here once, as what it was.
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import secrets
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.messages import Failure, Policy, WorkerLost, WorkerUp
from es_service.errors import EvaluationError
from es_service.protocol import Centre, Chunk, WorkerSpec

OBJECT_STORE_BYTES = 200 * 2**20
"""Shared memory of a local Ray: a few centres and gradient blocks. Ray would take a third of the machine's."""
PLACEMENT_S = 30.0
"""Longest wait for the first actor to be given a place; Ray itself would wait for ever."""
CONNECT_S = 5.0
"""Longest wait for the port of a cluster to answer; Ray itself would try for more than a minute."""
TOKEN = secrets.token_hex(32)
"""For every Ray that this process starts: Ray reads the token of a process only once, and else writes one into HOME."""
SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}
"""Nothing phones home; actors without a GPU hide the GPUs themselves."""


def ray_engine(
    spec: WorkerSpec,
    policy: Policy,
    should_stop: Callable[[], int | None] = lambda: None,
    *,
    actor: type,
    address: str | None = None,
    all_cpus: bool = False,
) -> Engine[Actors]:
    """An Evaluator whose workers are Ray actors, starting.

    Args:
        actor: the worker's class, with the methods of `workers.actor.WorkerActor`.
        address: a cluster's "HOST:PORT", or "auto" for the one on this machine; None starts a Ray of our own here,
            whatever other Ray or RAY_ADDRESS there may be, and ends it with the engine.
        all_cpus: with an address, want as many workers as the cluster has CPUs, instead of `policy.workers`.

    Raises:
        EvaluationError: Ray is missing, does not start, or no cluster answers at the address.
    """
    ray = _connect(address, policy.workers)
    if address is not None and all_cpus:
        policy = replace(policy, workers=max(1, int(ray.cluster_resources().get("CPU", 1))))
    try:
        return Engine(Actors(ray, spec, actor), policy, should_stop)
    except BaseException:
        _disconnect(ray)
        raise


@dataclass(frozen=True)
class _Call:
    """What a result still to come is the answer to."""

    worker: int
    what: str
    """place, build or run."""
    key: Hashable = None
    attempt: int = 0


class Actors:
    """A Transport whose workers are Ray actors."""

    def __init__(self, ray: ModuleType, spec: WorkerSpec, actor: type) -> None:
        self._ray = ray
        self._spec = ray.put(spec)
        self._class = ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0, scheduling_strategy="SPREAD")(actor)
        self._handles: dict[int, Any] = {}
        self._calls: dict[Any, _Call] = {}
        self._places: dict[int, str] = {}
        self._inbox: deque[Message] = deque()
        self._centre: tuple[Centre, Any] | None = None
        self._placed_by_s = time.monotonic() + PLACEMENT_S

    def places(self) -> dict[int, str]:
        """Worker id -> host and process id of those that have a place; for diagnosis and for tests that kill them."""
        return dict(self._places)

    def start(self, worker: int) -> None:
        """Ask Ray for an actor; it is up once it has a place and has built its functions."""
        try:
            handle = self._class.remote(self._spec, worker)
            self._handles[worker] = handle
            self._calls[handle.place.remote()] = _Call(worker, "place")
            self._calls[handle.build.remote()] = _Call(worker, "build")
        except self._ray.exceptions.RayError as error:
            self._lose(worker, f"cannot be started: {error}")

    def kill(self, worker: int) -> None:
        """Kill an actor's process and drop whatever it still owes."""
        for ref in [ref for ref, call in self._calls.items() if call.worker == worker]:
            del self._calls[ref]
        self._places.pop(worker, None)
        handle = self._handles.pop(worker, None)
        if handle is not None:
            with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.kill(handle, no_restart=True)

    def send(self, worker: int, centre: Centre, key: Hashable, attempt: int, chunk: Chunk) -> None:
        """Call the actor. A centre is stored once, however many chunks share it, and dropped with the next one."""
        if worker not in self._handles:
            return  # lost a moment ago, when it was sent another chunk; that is on its way to the scheduler
        try:
            if self._centre is None or self._centre[0] is not centre:
                self._centre = centre, self._ray.put(centre)
            ref = self._handles[worker].run.remote(self._centre[1], chunk)
        except self._ray.exceptions.RayError as error:
            self._lose(worker, _reason(error))
            return
        self._calls[ref] = _Call(worker, "run", key, attempt)

    def receive(self, timeout_s: float) -> Message | None:
        """The next message. Raises EvaluationError if the cluster has had no place for any actor in PLACEMENT_S."""
        if self._inbox:
            return self._inbox.popleft()
        if not self._calls:
            time.sleep(timeout_s)
            return None
        # Oldest first, so that the answers of one worker stay in order.
        ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=timeout_s)
        if ready:
            return self._message(ready[0], self._calls.pop(ready[0]))
        if not self._places and time.monotonic() > self._placed_by_s:
            raise EvaluationError(
                f"no worker was given a place in {PLACEMENT_S:g} s. Each needs 1 CPU; the cluster has "
                f"{_resources(self._ray.cluster_resources())} in all, free are "
                f"{_resources(self._ray.available_resources())}. Add nodes, or stop what else runs there."
            )
        return None

    def close(self) -> None:
        """Kill all actors and leave the cluster; a Ray of our own ends."""
        for worker in list(self._handles):
            self.kill(worker)
        self._calls.clear()
        self._centre = None
        _disconnect(self._ray)

    def _message(self, ref: Any, call: _Call) -> Message | None:
        errors = self._ray.exceptions
        try:
            value = self._ray.get(ref)
        except errors.RayTaskError as error:  # it raised, and lives
            if call.what == "run":
                return Failure(call.worker, call.key, call.attempt, str(error))
            self.kill(call.worker)
            return WorkerLost(call.worker, str(error))
        except errors.RayError as error:
            where = self._places.get(call.worker, "before it had a place")
            self.kill(call.worker)
            return WorkerLost(call.worker, f"{where}: {_reason(error)}")
        if call.what == "run":
            return Answer(call.worker, call.key, call.attempt, value)
        if call.what == "build":
            return WorkerUp(call.worker)
        self._places[call.worker] = value
        self._placed_by_s = float("inf")
        return None

    def _lose(self, worker: int, reason: str) -> None:
        self.kill(worker)
        self._inbox.append(WorkerLost(worker, reason))


def _reason(error: Exception) -> str:
    """What a fault of an actor means, on one line."""
    first = str(error).strip().partition("\n")[0]
    known = {
        "OutOfMemoryError": "its node ran out of memory and Ray killed it",
        "ActorUnavailableError": "its node does not answer",
        "ActorDiedError": "its process or its node died",
    }
    kind = type(error).__name__
    return f"{known.get(kind, kind)}: {first}"


def _resources(amounts: dict[str, float]) -> str:
    """The resources that matter here, as a user would name them."""
    return ", ".join(f"{amounts.get(name, 0.0):g} {name}" for name in ("CPU", "GPU"))


def _connect(address: str | None, workers: int) -> ModuleType:
    """Import Ray and join a cluster or start one; the caller's signal handlers and environment stay as they were."""
    without = "`--engine inline` runs on this machine without Ray"
    options: dict[str, Any] = {"address": address}
    settings = dict(SETTINGS)
    if address is None:
        options = {
            "address": "local",
            "num_cpus": workers,
            "num_gpus": 0,
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
        settings["RAY_AUTH_TOKEN"] = os.environ.get("RAY_AUTH_TOKEN", TOKEN)
    with _signal_handlers_kept(), _environment_kept(settings):
        try:
            import ray
        except ImportError as error:
            raise EvaluationError(f"Ray cannot be imported ({error}); install it, or: {without}") from error
        if ray.is_initialized():
            raise EvaluationError(f"this process uses Ray already; call ray.shutdown() first, or: {without}")
        try:
            if address not in (None, "auto"):
                _knock(address)
            ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
        except Exception as error:  # Ray raises many kinds: ConnectionError, RuntimeError, ValueError, TimeoutError ...
            if address is None:
                raise EvaluationError(f"Ray does not start on this machine: {error}. {without}") from error
            raise EvaluationError(
                f"no Ray cluster at {address} took us in: {error}. Check the address, that RAY_AUTH_TOKEN is the "
                f"cluster's (with RAY_AUTH_MODE=token), and that it has this Ray ({ray.__version__}) and this Python "
                f"({platform.python_version()}); {without}"
            ) from error
    return ray


def _knock(address: str) -> None:
    """Raise OSError or ValueError unless something listens at HOST:PORT."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdigit():
        raise ValueError(f"{address!r} is neither HOST:PORT nor auto")
    socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()


def _disconnect(ray: ModuleType) -> None:
    with _signal_handlers_kept():
        ray.shutdown()


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
        os.environ.clear()
        os.environ.update(before)
