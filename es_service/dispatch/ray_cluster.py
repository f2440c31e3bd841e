"""Joining or starting a Ray cluster: whether its head is there and accepts this process, staying connected for the next
run, and watching its nodes.

After each call, the caller's signal handlers and environment variables are the same as before.
"""

from __future__ import annotations

import contextlib
import importlib
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

from es_service.config.model import ENGINE_IMPLIES
from es_service.dispatch.ray_nodes import OTHER_CLUSTER, Claim, Membership, ask_head, cores_of_nodes, read_membership
from es_service.dispatch.staying import staying
from es_service.errors import EvaluationError, Interrupted, StartError, WayOut
from es_service.logs import logger
from es_service.protocol.machine import given_path
from es_service.protocol.process_environment import child_environment

# Whether the head of a Ray cluster is at an address and accepts this process, which Ray itself takes a minute to say.
#
# If this host uses TLS, the calls do so, too, because Ray accepts only the certificates of its own authority then.

HEAD_CALL = "/ray.rpc.NodeInfoGcsService/CheckAlive"
"""A call of Ray's protocol to its head that changes nothing and takes an empty message."""
CONNECT_S = 3.0
"""Longest time in seconds to connect to a port; a lost packet is sent again after one second."""
CALL_S = 4.0
"""Longest wait for an answer, in seconds."""


def uses_tls() -> bool:
    """Whether Ray uses TLS on this host."""
    return os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true")


def require_head(address: str, *, is_auto: bool = False) -> None:
    """Raise StartError unless the head of a Ray cluster is at HOST:PORT and accepts the token of this process.

    Args:
        is_auto: whether the address was found and not given: then Ray uses a token also if RAY_AUTH_MODE is not set.
    """
    grpc = grpc_module()
    problem = _why_no_connection(grpc, address) or _why_refused(grpc, address, is_auto)
    if problem:
        text = f"could not connect to a Ray cluster at {address}: {problem}"
        raise StartError(text, field="compute.address", value=address)


def status_code(grpc: Any, target: str, call: str, token: str | None = None) -> Any:
    """Status code with which a call with an empty message fails; None if it is answered."""
    metadata = None if token is None else [("authorization", f"Bearer {token}")]
    with _channel(grpc, target) as channel:
        try:
            channel.unary_unary(call)(b"", timeout=CALL_S, metadata=metadata)
        except grpc.RpcError as error:
            return error.code()
    return None


def grpc_module() -> Any:
    """The module `grpc`, which the extra installs."""
    try:
        return importlib.import_module("grpc")
    except ImportError as error:
        ways_out = [WayOut("install", "install it", extra="cluster")]
        raise StartError(f"checks of a cluster need the extra `cluster` ({error})", ways_out=ways_out) from error


def _why_no_connection(grpc: Any, address: str) -> str:
    """Why no gRPC server can be reached at an address; empty if one can."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdigit():
        return "an address is HOST:PORT, or auto on a machine of the cluster"
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except (OSError, OverflowError) as error:  # a port above 65535 overflows
        return (
            f"nothing listens at that address ({getattr(error, 'strerror', None) or error}). Give the address of "
            "its head, HOST:PORT (usually port 6379), or auto on a machine of the cluster"
        )
    with _channel(grpc, address) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CALL_S)
        except grpc.FutureTimeoutError:
            tls = "this host uses TLS, so the cluster must" if uses_tls() else "if the cluster uses TLS, this host must"
            return f"its port is open, but gives no answer within {CALL_S:g} s; {tls}, too"
    return ""


def _why_refused(grpc: Any, address: str, is_auto: bool) -> str:
    """Why the server at an address accepts no call of this process; empty if it does."""
    code, (token, source) = status_code(grpc, address, HEAD_CALL), _token(is_auto)
    asks = code == grpc.StatusCode.UNAUTHENTICATED
    if asks and token is None:
        return (
            f"the cluster asks for a token, and {source}. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to the token of "
            "the cluster"
        )
    if asks:
        code = status_code(grpc, address, HEAD_CALL, token)
    if code == grpc.StatusCode.UNAUTHENTICATED:
        return f"the token in {source} is not the cluster's. Set RAY_AUTH_TOKEN to the token of the cluster"
    if code is not None:
        return (
            f"the server there does not answer as the head of a Ray cluster does ({code.name}). Give the port with "
            "which its head was started, usually 6379"
        )
    if not asks and _mode() == "token":
        return (
            "the cluster uses no token, but RAY_AUTH_MODE=token is set here, with which no worker would start there. "
            "Unset RAY_AUTH_MODE, or start the cluster with a token, which is safer"
        )
    return ""


def _mode(default: str = "") -> str:
    return os.environ.get("RAY_AUTH_MODE", default).lower()


def _token(is_auto: bool) -> tuple[str | None, str]:
    """The token that Ray sends from this process, and where it is from; or None, and why it sends none."""
    given = os.environ.get("RAY_AUTH_TOKEN")
    if _mode("token" if is_auto else "") != "token":
        return (
            None,
            f"this process sends {'that in RAY_AUTH_TOKEN only if RAY_AUTH_MODE is token' if given else 'none'}",
        )
    if given:
        return given.strip(), "RAY_AUTH_TOKEN"
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or "~/.ray/auth_token"
    try:
        return given_path(path).read_text().strip(), path
    except OSError:
        return None, f"there is none in RAY_AUTH_TOKEN or {path}"


def _channel(grpc: Any, target: str) -> Any:
    if not uses_tls():
        return grpc.insecure_channel(target)
    names = ("RAY_TLS_CA_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_SERVER_CERT")
    try:
        read = [Path(os.environ[name]).read_bytes() for name in names]
    except (KeyError, OSError) as error:
        raise StartError(
            f"RAY_USE_TLS is set, so {', '.join(names)} must name the files of certificates ({error})"
        ) from error
    return grpc.secure_channel(target, grpc.ssl_channel_credentials(*read))


_LOG = logger(__name__)
OBJECT_STORE_BYTES = 200 * 2**20
"""Shared memory of a local Ray, for a few centres and gradient blocks. Ray would take a third of the machine's memory.
"""
MEMBERSHIP_S = 1.0
"""Seconds between two queries for the nodes of a cluster."""
SILENCE_S = 20.0
"""Seconds without an answer after which a cluster is considered lost. Ray would end this process after a minute."""
PAUSE_S = 5.0
"""If `Watch.latest` was not called for this many seconds, the time without an answer is counted from the next call."""
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
WITHOUT_RAY = WayOut(
    "resume",
    "work on this machine without Ray",
    settings={"compute.engine": "inline", **ENGINE_IMPLIES["inline"], "compute.workers": "auto"},
)
"""Suggestion for errors of Ray. The number of workers was that of a cluster."""


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


class Watch:
    """Regular queries for the nodes of a cluster, in a separate thread because a query may block."""

    def __init__(self, ray: ModuleType, claim: Claim) -> None:
        self._ray, self._claim = ray, claim
        self._latest = read_membership(ray, claim)
        self._answered_s = self._asked_s = time.monotonic()
        self._is_replaced = False
        self._end = threading.Event()
        threading.Thread(target=self._run, daemon=True, name="cluster-watch").start()

    def latest(self) -> Membership:
        """The latest answer. Raises EvaluationError if there was none for more than SILENCE_S seconds, or if another
        cluster answers at the same address."""
        if self._is_replaced:
            raise EvaluationError(
                "the Ray cluster has ended, and another one was started at its address. Resume the run there, or on "
                "this machine alone",
                ways_out=[WITHOUT_RAY],
            )
        now = time.monotonic()
        if now - self._asked_s > PAUSE_S:  # this process was stopped or busy, so the cluster may have answered
            self._answered_s = now
        self._asked_s = now
        silent_s = now - self._answered_s
        if silent_s > SILENCE_S:
            raise EvaluationError(
                f"the Ray cluster has not answered for {silent_s:.0f} s; its head node has ended or cannot be reached. "
                "Start a cluster again and resume the run there, or resume it on this machine alone",
                ways_out=[WITHOUT_RAY],
            )
        return self._latest

    def close(self) -> None:
        """End the queries."""
        self._end.set()

    def _run(self) -> None:
        while not self._end.wait(MEMBERSHIP_S):
            try:
                self._latest = read_membership(self._ray, self._claim)
                self._answered_s = time.monotonic()
            except Exception as error:  # of any class; it means that there is no answer
                self._is_replaced = OTHER_CLUSTER in str(error)


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
