"""What can be found out about a Ray cluster before a run: software, open ports, a shared folder.

A task on each node collects the facts of that node (`node_probe`), and the driver calls Ray's ports without a token
(`ray_ports`). Each step has a time limit. `cluster_findings` judges the facts.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from es_service.dispatch import node_probe
from es_service.dispatch.ray_cluster import connect, disconnect, require_node
from es_service.dispatch.ray_faults import error_text
from es_service.dispatch.ray_head import HEAD_CALL, grpc_module, uses_tls
from es_service.dispatch.ray_ports import NODE_CALL, open_ports
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.sources import Sources

NODE_S = 60.0
"""Longest wait for the facts of all nodes, in seconds; a node first starts a process for the task."""
HTTP_PORTS = {"DashboardAgentListenPort": "agent", "RuntimeEnvAgentPort": "runtime env agent"}
"""HTTP servers of each node, as Ray names their ports; not that of the metrics, which everybody may read."""
HEAD = "node:__internal_head__"
"""Resource that only the head has."""


@dataclass(frozen=True)
class NodeFacts:
    """Facts about one node, or about the host of the driver."""

    name: str
    """Host name and address, for messages."""
    versions: Mapping[str, str]
    """Name -> version of Ray and of what `platform_info` has."""
    sources: Sources
    """`worker_sources` of a shipped task."""
    problem: str = ""
    """Why es-service cannot be imported there; empty if it can."""
    called: tuple[str, ...] = ()
    """What was called without a token, such as `dashboard 8265`."""
    open_ports: tuple[str, ...] = ()
    """What of it answered."""
    public: tuple[str, ...] = ()
    """Public addresses, with ports, on which Ray listens."""
    not_shared: str = ""
    """Why the file that the driver wrote is not there; empty if it is, or if none was written."""


@dataclass(frozen=True)
class ClusterFacts:
    """Facts about a cluster."""

    driver: NodeFacts
    nodes: tuple[NodeFacts, ...]
    silent: Mapping[str, str]
    """Name of each node that gave no facts -> why."""
    encrypted: bool
    """Whether Ray's processes use TLS."""
    shared: str | None = None
    """Folder that the nodes should share, if one was given."""


@dataclass(frozen=True)
class _Node:
    """What Ray says about a node."""

    id: str
    name: str
    ports: tuple[int, ...]
    """Ports on which Ray listens there."""
    grpc_calls: tuple[tuple[str, str, str], ...]
    """Name, HOST:PORT and a call of each gRPC server that is called without a token."""
    http_calls: tuple[tuple[str, str, int], ...]
    """Name, host and port of each HTTP server that is called without a token."""


def cluster_facts(address: str, shared: Path | None = None) -> ClusterFacts:
    """Join a cluster and collect facts about it and about each of its nodes.

    Args:
        address: "HOST:PORT", or "auto" for the cluster on this machine.
        shared: a folder that the nodes should share; a file is there for a moment.

    Raises:
        EvaluationError: the connection failed, or a package is missing.
        ConfigError: the folder does not exist, or this process cannot write there.
    """
    grpc_module()  # needed for the ports; `connect` works without it, but may wait for a minute
    with _file_in(shared) as file:
        try:
            require_node(address)
            ray = connect(address, gpus=False, cpus=1)
        except EvaluationError as error:  # its ways out are those of a run
            raise EvaluationError(" ".join(error.sentence.split()), field="cluster", value=address) from error
        try:
            nodes = _nodes(ray)
            answers, silent = _ask(ray, nodes, file)
        finally:
            disconnect(ray)
    calls = [call for node in nodes for call in node.grpc_calls]
    is_open = dict(zip(calls, open_ports([call[1:] for call in calls]), strict=True))
    return ClusterFacts(
        driver=NodeFacts("this host", **node_probe.software()),
        nodes=tuple(
            NodeFacts(
                node.name,
                **answer["software"],
                called=tuple(name for name, *_ in (*node.grpc_calls, *node.http_calls)),
                open_ports=(*(call[0] for call in node.grpc_calls if is_open[call]), *answer["open"]),
                public=public_sockets(answer["listening"], answer["addresses"]),
                not_shared=answer["not_shared"],
            )
            for node in nodes
            if (answer := answers.get(node.id))
        ),
        silent={node.name: silent[node.id] for node in nodes if node.id in silent},
        encrypted=uses_tls(),
        shared=None if shared is None else os.path.abspath(shared),
    )


def public_sockets(listening: Iterable[tuple[str, int]], addresses: Iterable[str]) -> tuple[str, ...]:
    """Sockets that can be reached at a public address, as `address:port`.

    Args:
        listening: address and port of each socket; 0.0.0.0 stands for all IPv4 addresses, :: for all addresses.
        addresses: the addresses of the host.
    """
    own = [ipaddress.ip_address(address) for address in addresses]
    found = set()
    for address, port in listening:
        bound = ipaddress.ip_address(address)
        bound = getattr(bound, "ipv4_mapped", None) or bound  # a socket of IPv6 that listens on an address of IPv4
        reached = [one for one in own if one.version <= bound.version] if bound.is_unspecified else [bound]
        found |= {(str(one), port) for one in reached if one.is_global}
    return tuple(_joined(host, port) for host, port in sorted(found))


def _nodes(ray: ModuleType) -> list[_Node]:
    """The nodes of the cluster, the head first."""
    head = ray.get_runtime_context().gcs_address
    dashboard = _dashboard(ray)
    found = []
    for node in ray.nodes():
        if not node["Alive"]:
            continue
        host, port, is_head = node["NodeManagerAddress"], node["NodeManagerPort"], HEAD in node["Resources"]
        ports = [value for name, value in node.items() if name.endswith("Port")]
        grpc_calls = [(f"raylet {port}", _joined(host, port), NODE_CALL)]
        http_calls = [(f"{name} {node[key]}", host, node[key]) for key, name in HTTP_PORTS.items() if node.get(key)]
        if is_head:
            head_port = int(head.rpartition(":")[2])
            ports.append(head_port)
            grpc_calls.insert(0, (f"head {head_port}", head, HEAD_CALL))
        if is_head and dashboard:
            ports.append(dashboard[1])
            http_calls.append((f"dashboard {dashboard[1]}", *dashboard))
        name = f"{node['NodeManagerHostname']} {host}"
        found.append((not is_head, name, _Node(node["NodeID"], name, (*ports,), (*grpc_calls,), (*http_calls,))))
    return [node for *_, node in sorted(found, key=lambda one: one[:2])]


def _ask(
    ray: ModuleType, nodes: Iterable[_Node], file: tuple[str, str] | None
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Node id -> its facts, for each node that gave them, and node id -> why, for each that did not."""
    affinity = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    ray.cloudpickle.register_pickle_by_value(node_probe)
    try:
        probe = ray.remote(num_cpus=0, max_retries=0)(node_probe.facts)
        asked = {
            probe.options(scheduling_strategy=affinity(node.id, soft=False)).remote(
                node.ports, node.http_calls, file
            ): node.id
            for node in nodes
        }
    finally:
        ray.cloudpickle.unregister_pickle_by_value(node_probe)
    ready, late = ray.wait(list(asked), num_returns=len(asked), timeout=NODE_S)
    answers, silent = {}, {asked[ref]: f"nothing within {NODE_S:g} s" for ref in late}
    for ref in ready:
        try:
            answers[asked[ref]] = ray.get(ref)
        except ray.exceptions.RayError as error:
            silent[asked[ref]] = error_text(error).strip().rpartition("\n")[2]
    return answers, silent


def _dashboard(ray: ModuleType) -> tuple[str, int] | None:
    """Host and port of the dashboard; None if there is none.

    Ray has no public function for this. If a version of Ray lacks this one, the dashboard is not checked.
    """
    with contextlib.suppress(AttributeError):
        host, _, port = (ray._private.worker.get_dashboard_url() or "").rpartition(":")
        if host:
            return host.strip("[]"), int(port)
    return None


@contextlib.contextmanager
def _file_in(folder: Path | None) -> Iterator[tuple[str, str] | None]:
    """Path and content of a new file in a folder, which is removed afterwards; None without a folder."""
    if folder is None:
        yield None
        return
    content = secrets.token_hex(16)
    file = Path(os.path.abspath(folder)) / f".es-service-doctor-{content}"
    try:
        file.write_text(content)
    except OSError as error:
        raise ConfigError(
            f"the shared folder {folder} must exist, and this process must be able to write there ({error.strerror})",
            field="shared",
            value=str(folder),
        ) from error
    try:
        yield str(file), content
    finally:
        file.unlink(missing_ok=True)


def _joined(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
