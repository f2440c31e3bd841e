"""Joining or starting a Ray cluster, and staying connected to it for the next run.

After each call, the caller's signal handlers and environment variables are the same as before.
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
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from es_service.dispatch.ray_head import require_head
from es_service.dispatch.ray_nodes import MEMBERSHIP_S, SILENCE_S, WITHOUT_RAY, ask_head, cores_of_nodes
from es_service.dispatch.staying import staying
from es_service.errors import Interrupted, StartError
from es_service.logs import logger
from es_service.protocol.process_environment import child_environment

_LOG = logger(__name__)
OBJECT_STORE_BYTES = 200 * 2**20
"""Shared memory of a local Ray, for a few centres and gradient blocks. Ray would take a third of the machine's memory.
"""
TOKEN = secrets.token_hex(32)
"""Authentication token of every Ray that this process starts, since Ray reads the token of a process only once.
Without it, Ray would write a token into the home folder."""
SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # send no usage statistics
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # actors without a GPU hide the GPUs themselves
}
"""Environment variables of all processes that Ray starts."""
LOCAL_SETTINGS = {
    "RAY_task_events_report_interval_ms": "0",  # record no calls, since there is no dashboard to show them
    "RAY_enable_metrics_collection": "0",
}
"""More environment variables for a Ray of our own. Without them, Ray's records take a tenth of a small generation."""


def connect(address: str | None, *, gpus: bool, cpus: int) -> ModuleType:
    """The `ray` module, newly connected to a cluster. A connection that waits ends, since Ray allows only one.

    Args:
        address: "HOST:PORT" of the cluster, "auto" for the one on this machine, or None to start one here.
        gpus: whether a new cluster has the GPUs of this machine.
        cpus: number of CPUs of a new cluster.

    Raises:
        StartError: Ray is not installed, is used by this process already, or cannot be started, or the connection
            to the cluster failed.
        Interrupted: SIGTERM arrived during the call.
    """
    if (waiting := staying().take(RAY)) is not None:
        waiting.end()
    ways_out = [WITHOUT_RAY]
    options: dict[str, Any] = {"address": address}
    settings = dict(SETTINGS)
    if address is None:
        options = {
            "address": "local",
            "num_cpus": cpus,
            "num_gpus": None if gpus else 0,  # None means all GPUs that Ray finds
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
        settings |= LOCAL_SETTINGS | {"RAY_AUTH_TOKEN": os.environ.get("RAY_AUTH_TOKEN", TOKEN)}
    with signal_handlers_kept() as arrived, environment_kept(settings):
        try:
            import ray
        except ImportError as error:
            text = f"Ray cannot be imported ({error}); install the package `ray`"
            raise StartError(text, ways_out=ways_out) from error
        if ray.is_initialized():
            raise StartError("this process already uses Ray; call ray.shutdown() first", ways_out=ways_out)
        if address is not None and find_spec("grpc"):  # without the extra `cluster`, Ray says it, after a minute
            try:
                require_head(address_here() if address == "auto" else address, is_auto=address == "auto")
            except StartError as error:
                error.ways_out = (*error.ways_out, *ways_out)
                raise
        try:
            ray.init(**options, logging_level=logging.ERROR, log_to_driver=False)
        except SystemExit as stop:  # Ray replaces the handler of SIGTERM by one that exits with the signal's number
            ray.shutdown()
            if stop.code != signal.SIGTERM:
                raise
            raise Interrupted(signal.SIGTERM) from stop
        except Exception as error:  # of many classes: ConnectionError, RuntimeError, ValueError, TimeoutError ...
            if address is None:
                raise StartError(f"could not start Ray on this machine: {error}", ways_out=ways_out) from error
            reason = str(error).rstrip(". ")
            raise StartError(
                f"could not connect to a Ray cluster at {address}: {reason}. Check that this host is a node of the "
                f"cluster, and that the cluster uses the same versions of Ray ({ray.__version__}) and Python "
                f"({platform.python_version()})",
                field="compute.address",
                value=address,
                ways_out=ways_out,
            ) from error
    if signal.SIGTERM in arrived:
        ray.shutdown()
        raise Interrupted(signal.SIGTERM)
    _let_print(ray, False)
    _LOG.info("joined a Ray cluster (%s), Ray %s", address or "one of our own on this machine", ray.__version__)
    return ray


def disconnect(ray: ModuleType, *, forget: bool = False) -> None:
    """Leave the cluster. A cluster that `connect` started ends.

    Args:
        forget: whether to delete the folder of this cluster's logs, which Ray itself never deletes.
    """
    _let_print(ray, True)
    folder = _session_folder(ray) if forget else None
    with signal_handlers_kept():
        ray.shutdown()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
        latest = folder.with_name("session_latest")
        with contextlib.suppress(OSError):
            if not latest.exists():  # Ray does not replace a link whose target is missing
                latest.unlink()


def require_node(address: str) -> None:
    """Raise StartError if Ray is not installed, or if no node of Ray runs on this host, from which to join a cluster.

    Without one, `ray.init` would wait for a minute, and then say only that it failed.
    """
    with signal_handlers_kept(), environment_kept(SETTINGS):
        try:
            from ray._private import services
        except ImportError as error:
            raise StartError(f"Ray cannot be imported ({error}); install the package `ray`") from error
        if not services.find_node_ids():
            raise StartError(
                f"could not connect to a Ray cluster at {address}: no node of Ray runs on this host. Do this on a "
                "machine of the cluster, or start Ray here first, with the address of its head",
                field="compute.address",
                value=address,
            )


def address_here() -> str:
    """HOST:PORT of the cluster on this machine, as Ray finds it for "auto". Raises StartError as `require_node`."""
    require_node("auto")
    with signal_handlers_kept(), environment_kept(SETTINGS):
        from ray._private import services

        return services.canonicalize_bootstrap_address("auto") or "auto"


def nodes_of_cluster(address: str) -> list[int]:
    """Cores of each node of a cluster, which is joined for this question only. Raises StartError as `connect`."""
    ray = connect(address, gpus=False, cpus=1)
    try:
        return cores_of_nodes(ray)
    finally:
        disconnect(ray)


class Connection:
    """A Ray that this process has joined or started, and actors there that wait for the next run."""

    def __init__(self, ray: ModuleType, use: Hashable = None, cpus: int | None = None) -> None:
        """Begin without actors.

        Args:
            ray: the module, which is connected.
            use: what else it can be used for: runs with the same.
            cpus: number of its CPUs, if it was started here; None: it was joined.
        """
        self.ray, self.use, self.cpus = ray, use, cpus
        self.keeps_logs = False
        """Whether the logs of a Ray of our own are needed when it has ended."""
        self._job = _job(ray)
        self._actors: list[tuple[Hashable, Any]] = []
        """What an actor can be used for, and the actor."""
        self._made: dict[Hashable, Any] = {}
        self._is_used = threading.Event()

    @property
    def is_running(self) -> bool:
        """Whether this process is still connected to it; the user may have ended that, and have begun another one."""
        return self.ray.is_initialized() and _job(self.ray) == self._job

    def answers(self) -> bool:
        """Whether its head answers."""
        try:
            ask_head(self.ray)
        except Exception:  # of several classes
            return False
        return True

    def remote(self, what: Any, make: Callable[[], Any], *given: Hashable) -> Any:
        """A class or function as Ray's own, which is made once, since Ray keeps each for good.

        Args:
            make: makes it.
            given: the options with which it is made.
        """
        if (what, *given) not in self._made:
            self._made[what, *given] = make()
        return self._made[what, *given]

    def rest(self, use: Hashable, actors: list[Any]) -> None:
        """Wait for the next run, inside a block of `workers`, with these actors; elsewhere end."""
        self._actors += [(use, actor) for actor in actors]
        self._is_used = used = threading.Event()
        staying().give(RAY, self)
        if not used.is_set():  # else it has ended
            threading.Thread(target=self._look, args=(used,), daemon=True, name="waiting-cluster").start()

    def begin(self) -> None:
        """It is used again."""
        self._is_used.set()

    def take(self, use: Hashable) -> list[Any]:
        """The actors that can be used for a run and answer at once; the others end, since they have the cores that the
        run needs."""
        actors, self._actors = self._actors, []
        errors, asked = self.ray.exceptions.RayError, dict[Any, Any]()
        for able, actor in actors:
            if able == use:
                with contextlib.suppress(errors):
                    asked[actor.place.remote()] = actor
        answered, _ = self.ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER_S) if asked else ([], [])
        taken = []
        for ref in answered:
            with contextlib.suppress(errors):
                self.ray.get(ref)
                taken.append(asked[ref])
        self._kill([actor for _, actor in actors if actor not in taken])
        return taken

    def kill(self) -> None:
        """Kill the actors."""
        actors, self._actors = self._actors, []
        if self.is_running:
            self._kill([actor for _, actor in actors])

    def end(self) -> None:
        """Kill the actors, and leave the cluster; one of our own ends."""
        self._is_used.set()
        self.kill()
        if self.is_running:
            disconnect(self.ray, forget=self.cpus is not None and not self.keeps_logs)
        else:
            _let_print(self.ray, True)

    def _kill(self, actors: list[Any]) -> None:
        for actor in actors:
            with contextlib.suppress(self.ray.exceptions.RayError, ValueError):
                self.ray.kill(actor, no_restart=True)

    def _look(self, used: threading.Event) -> None:
        """End if the head has not answered for SILENCE_S seconds while it waits: Ray would end this process."""
        answered_s = time.monotonic()
        while not used.wait(MEMBERSHIP_S) and self.is_running:
            if self.answers():
                answered_s = time.monotonic()
            elif time.monotonic() - answered_s > SILENCE_S:
                staying().end(self)
                return


RAY = "ray"
"""What a connection that waits can be used for, as `Staying` has it: this process has one at most."""
ANSWER_S = 5.0
"""Longest wait in seconds for actors that are to be taken over; one that has nothing to do answers in milliseconds."""


def connected(address: str | None, *, gpus: bool, cpus: int) -> Connection:
    """The connection that waits, if it is to the same cluster and its head answers, or else a new one.

    Args and raises as `connect`; a Ray of our own that waits may have more CPUs.
    """
    use = address, gpus, os.getcwd(), *sorted(child_environment().items())
    if (waiting := staying().take(RAY)) is not None:
        if waiting.use == use and (waiting.cpus is None or waiting.cpus >= cpus) and waiting.answers():
            waiting.begin()
            return waiting
        waiting.end()
    return Connection(connect(address, gpus=gpus, cpus=cpus), use, cpus if address is None else None)


def _job(ray: ModuleType) -> tuple[str, str]:
    """What tells a connection from a later one."""
    context = ray.get_runtime_context()
    return context.get_node_id(), context.get_job_id()


def _session_folder(ray: ModuleType) -> Path | None:
    """Folder of Ray's logs and sockets of this session, or None.

    Ray has no public function for this. If a version of Ray lacks this one, the folder is not deleted.
    """
    with contextlib.suppress(AttributeError):
        return Path(ray._private.worker._global_node.get_session_dir_path())
    return None


def _let_print(ray: ModuleType, allowed: bool) -> None:
    """Set whether Ray may print to our stdout. It prints a long text for each lost worker, which is reported anyway."""
    ray._private.worker._worker_logs_enabled = allowed


@contextlib.contextmanager
def signal_handlers_kept() -> Iterator[set[int]]:
    """Context manager that restores the signal handlers that Ray replaces; Ray can do so only in the main thread.

    It gives a set, which holds after the block the numbers of the signals that arrived in it. Ray's handler of SIGTERM
    raises SystemExit, which Python ignores in some places (a hook of os.fork, a finalizer), with a traceback on stderr
    that is left out here.
    """
    arrived: set[int] = set()
    if threading.current_thread() is not threading.main_thread():
        yield arrived
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    report = sys.unraisablehook
    noted, written = socket.socketpair()
    with noted, written:
        noted.setblocking(False)
        written.setblocking(False)
        fd_before = signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
        sys.unraisablehook = lambda ignored: None if ignored.exc_type is SystemExit else report(ignored)
        try:
            yield arrived
        finally:
            sys.unraisablehook = report
            for number, handler in before.items():
                if handler is not None:  # None: it is not Python's
                    signal.signal(number, handler)
            signal.set_wakeup_fd(fd_before)
            with contextlib.suppress(BlockingIOError):
                arrived.update(noted.recv(4096))


@contextlib.contextmanager
def environment_kept(settings: dict[str, str]) -> Iterator[None]:
    """Context manager that sets environment variables for processes that Ray starts, and restores ours at its end."""
    before = dict(os.environ)
    os.environ.update(settings)
    try:
        yield
    finally:
        # Restore only the variables that differ, because threads of Ray may be reading the others.
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        for name, value in before.items():
            if os.environ.get(name) != value:
                os.environ[name] = value
