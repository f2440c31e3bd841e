"""The nodes of a Ray cluster: what a worker claims of a node, for how many workers there is room, and watching them."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import ModuleType

from es_service.config.model import ENGINE_IMPLIES
from es_service.dispatch.events import Limits
from es_service.errors import EvaluationError, StartError, WayOut
from es_service.protocol.policies import ALL_TOGETHER


@dataclass(frozen=True)
class Claim:
    """CPUs and GPUs of a node that one worker needs."""

    cpus: int = 1
    gpus: float = 0.0

    def __str__(self) -> str:
        return f"{self.cpus} CPU" + (f" and {self.gpus:g} GPU" if self.gpus else "")


ONE_CORE = Claim()
HEAD_S = 2
"""Seconds in which a head node must answer a question for itself."""
OTHER_CLUSTER = "WrongClusterID"
"""Part of Ray's message when the head node that answers is that of another cluster, started at the same address."""
ASKED_AHEAD = 32
"""Most workers for which a cluster has no room, and for which a run with `workers: auto` still asks. An autoscaler sees
them as demand and starts nodes for them. Each of them is an actor that Ray must keep."""
MEMBERSHIP_S = 1.0
"""Seconds between two queries for the nodes of a cluster."""
SILENCE_S = 20.0
"""Seconds without an answer after which a cluster is considered lost. Ray would end this process after a minute."""
PAUSE_S = 5.0
"""If `Watch.latest` was not called for this many seconds, the time without an answer is counted from the next call."""
WITHOUT_RAY = WayOut(
    "resume",
    "work on this machine without Ray",
    settings={"compute.engine": "inline", **ENGINE_IMPLIES["inline"], "compute.workers": "auto"},
)
"""Suggestion for errors of Ray. The number of workers was that of a cluster."""


@dataclass(frozen=True)
class Membership:
    """The nodes of a cluster at one moment."""

    rooms: Mapping[str, int]
    """Node id -> number of workers for which it has room, used or not, for the nodes that are alive and not leaving."""
    free: Mapping[str, int]
    """Node id -> number of further workers for which it has room now, for the same nodes."""
    leaving: frozenset[str]
    """Ids of the nodes that are being drained."""
    alive: frozenset[str]
    """Ids of the nodes that are alive, including those that are being drained."""

    @property
    def room(self) -> int:
        """Number of workers for which these nodes have room."""
        return sum(self.rooms.values())


@dataclass(frozen=True)
class Growth:
    """How many workers a run with `workers: auto` asks a cluster for."""

    most: int
    """Number of workers for which there is work."""
    ahead: int = 0
    """Number of workers that it asks for beyond the room in the cluster."""

    def wanted(self, nodes: Membership, before: int) -> int:
        """Number of workers to ask for; as `before` if nothing is known of the nodes, or if all with room are gone."""
        if not nodes.alive or not nodes.room + self.ahead:
            return before
        return min(nodes.room + self.ahead, self.most)


def layout(
    ray: ModuleType, limits: Limits, cpus: int | None, gpus: float, most: int, *, grows: bool, ours: bool
) -> tuple[Claim, Limits, Growth | None]:
    """What each worker claims, the limits with the number of workers and their cores, and how that number changes.

    Args:
        limits: with the number of cores of all workers together as the number of workers.
        cpus, gpus, most, grows: as in `ray_engine`.
        ours: whether this Ray was started for the run and has this machine only.

    Raises:
        StartError: it is ours and has no room for a worker; there will never be any.
    """
    # An autoscaler starts a node for an actor of a size that was given. One core, which stands for a cluster without
    # nodes, would be no such size.
    ahead = 0 if ours or cpus is None else ASKED_AHEAD
    if cpus is None:  # on one machine, actors with one core were measured to be as fast or faster
        nodes = [] if ours or gpus else cores_of_nodes(ray)
        cpus = actor_cores(nodes, None, most) if grows else actor_cores(nodes, limits.workers, None)
    claim = Claim(cpus, gpus)
    nodes = read_membership(ray, claim)
    if ours and not nodes.room:
        text = f"this machine has no room for a worker. {demand(ray, claim)}. Lower compute.worker_resources."
        raise StartError(text)
    if ours:  # it has room, so a worker without a place is one whose process does not start
        limits = replace(limits, waits_for_place=False)
    growth = Growth(-(-most // cpus), ahead) if grows else None
    workers = with_work(limits.workers, cpus, most) if growth is None else growth.wanted(nodes, before=1)
    if cpus > 1 and not gpus:  # its actors have several cores, which share what comes together
        limits = replace(limits, policies_together=ALL_TOGETHER)
    return claim, replace(limits, workers=workers, cores=cpus), growth


def actor_cores(nodes: Sequence[int], workers: int | None, most: int | None) -> int:
    """Cores that each actor owns if they are not configured: all of a node, so that a node needs few messages.

    If the nodes differ, or if there is none yet, it is one core, which leaves no core of any node idle.

    Args:
        nodes: cores of each node.
        workers: number of cores that the run uses, which the result divides; None: as many as there are.
        most: number of cores that have work; None: no limit.
    """
    if not nodes or len(set(nodes)) > 1:
        return 1
    size = max(1, min(nodes[0], most or nodes[0]))
    if workers is None:
        return size
    return max(cores for cores in range(1, min(size, workers) + 1) if workers % cores == 0)


def with_work(cores: int, cpus: int, most: int) -> int:
    """Number of actors with `cpus` cores each, on `cores` cores, as far as there is work for them.

    So where there is too little work, fewer actors start, and not smaller ones, which would need more messages.

    Args:
        most: number of cores that have work.
    """
    return min(cores // cpus, -(-most // cpus))


def cores_of_nodes(ray: ModuleType) -> list[int]:
    """Cores of each node that is alive and has any."""
    cpus = [node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]]
    return [int(count) for count in cpus if count >= 1.0]


def read_membership(ray: ModuleType, claim: Claim) -> Membership:
    """The nodes of the cluster now. Raises an exception of Ray if its head node does not answer.

    Ray has no public function for the nodes that are being drained, nor for what nobody uses of a node. If a version of
    Ray lacks the first of these two, the workers of a drained node are lost when the node ends. If it lacks the second,
    no node counts as free, and Ray chooses.
    """
    ask_head(ray)
    leaving, unused = frozenset[str](), dict[str, dict[str, float]]()
    with contextlib.suppress(AttributeError):
        leaving = frozenset(ray._private.state.state.get_draining_nodes())
    alive = {node["NodeID"]: node["Resources"] for node in ray.nodes() if node["Alive"]}
    rooms = {node: _room(resources, claim) for node, resources in alive.items() if node not in leaving}
    with contextlib.suppress(AttributeError):
        unused = ray._private.state.available_resources_per_node()
    free = {node: _room(unused.get(node, {}), claim) for node in rooms}
    return Membership(rooms, free, leaving, frozenset(alive))


def emptiest(free: Mapping[str, int], planned: Iterable[str]) -> str | None:
    """The node that has room for the most further workers, the first of equal ones; None if no node has any.

    Args:
        free: as in `Membership`.
        planned: the node of each worker that is to be placed there.
    """
    workers = Counter(planned)
    left = {node: room - workers[node] for node, room in free.items()}
    node = max(left, key=left.__getitem__, default=None)
    return node if node is not None and left[node] > 0 else None


def shortage(ray: ModuleType, claim: Claim, nodes: Membership | None) -> str:
    """Text, without a full stop, on why workers have no place, and what can be done about it.

    Args:
        nodes: those of the cluster that was joined; None: a Ray of our own, which has room.
    """
    if nodes is not None:
        try:
            ask_head(ray)
        except Exception:  # of several classes
            return f"Each worker needs {claim}; the head node of the cluster does not answer"
    if nodes is None:
        advice = "The processes of the workers do not start or are very slow"
    elif any(nodes.free.values()):
        advice = "There is room, so the processes of the workers are still starting"
    elif nodes.room:  # Ray does not say whose the used CPUs are
        still = "If no other program uses it, the processes of the workers are still starting"
        advice = f"{still}; otherwise stop that program, or add nodes"
    else:
        advice = f"No node has {claim}; add one that does, or lower compute.worker_resources"
    return f"{demand(ray, claim)}. {advice}"


def demand(ray: ModuleType, claim: Claim) -> str:
    """Text on what each worker needs and what the cluster has."""
    return (
        f"Each worker needs {claim}; the cluster has {_resources(ray.cluster_resources())} in total and "
        f"{_resources(ray.available_resources())} free"
    )


def ask_head(ray: ModuleType) -> None:
    """Raise an exception of Ray if the head node of the cluster does not answer, or if another cluster's does.

    Without this, Ray's questions about nodes wait for a head node, and end this process when that of another cluster
    answers. Ray has no public function for this. If a version of Ray lacks this one, they are asked without it.
    """
    with contextlib.suppress(AttributeError):
        ray._private.worker.global_worker.gcs_client.check_alive([], timeout=HEAD_S)


def _room(resources: dict[str, float], claim: Claim) -> int:
    """Number of workers for which a node with these resources has room."""
    by_cpu = int(resources.get("CPU", 0.0) / claim.cpus)
    # Ray does not divide the share of one worker between two GPUs.
    by_gpu = int(resources.get("GPU", 0.0)) * int(1 / claim.gpus) if 0 < claim.gpus < 1 else by_cpu
    if claim.gpus >= 1:
        by_gpu = int(resources.get("GPU", 0.0) / claim.gpus)
    return min(by_cpu, by_gpu)


def _resources(amounts: dict[str, float]) -> str:
    """Text with the numbers of CPUs and GPUs."""
    return ", ".join(f"{amounts.get(name, 0.0):g} {name}" for name in ("CPU", "GPU"))


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
