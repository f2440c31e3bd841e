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
from es_service.dispatch.ray_cluster import connect, disconnect
from es_service.dispatch.ray_faults import error_text
from es_service.dispatch.ray_ports import HEAD_CALL, NODE_CALL, open_ports, require_answer, uses_tls
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.sources import Sources

NODE_S = 60.0
"""Longest wait for the facts of all nodes, in seconds; a node first starts a process for the task."""
NODE_PORTS = ("NodeManagerPort", "ObjectManagerPort", "MetricsExportPort")
"""Ports of each node, as Ray names them."""
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
    open_ports: tuple[str, ...] = ()
    """What answers without a token, such as `dashboard 8265`."""
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


def cluster_facts(address: str, shared: Path | None = None) -> ClusterFacts:
    """Join a cluster and collect facts about it and about each of its nodes.

    Args:
        address: "HOST:PORT", or "auto" for the cluster on this machine.
        shared: a folder that the nodes should share; a file is there for a moment.

    Raises:
        EvaluationError: the connection failed, or a package is missing.
        ConfigError: the folder does not exist, or this process cannot write there.
    """
    with _file_in(shared) as file:
        if address != "auto":
            require_answer(address)
        try:
            ray = connect(address, gpus=False, cpus=1)
        except EvaluationError as error:  # with ways out for a run, which do not help here
            raise EvaluationError(error.sentence, field="cluster", value=address) from error
        try:
            nodes = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
            head = ray.get_runtime_context().gcs_address
            dashboard = _dashboard(ray)
            answers, silent = _ask(ray, nodes, _port(head), dashboard, file)
        finally:
            disconnect(ray)
    answering = _answering(nodes, head)
    for node, answer in answers.items():
        if dashboard and answer["dashboard_is_open"]:
            answering[node].append(f"dashboard {dashboard[1]}")
    return ClusterFacts(
        driver=NodeFacts("this host", **node_probe.software()),
        nodes=tuple(
            NodeFacts(
                _name(nodes[node]),
                **answer["software"],
                open_ports=tuple(answering[node]),
                public=public_sockets(answer["listening"], answer["addresses"]),
                not_shared=answer["not_shared"],
            )
            for node, answer in answers.items()
        ),
        silent={_name(nodes[node]): why for node, why in silent.items()},
        encrypted=uses_tls(),
        shared=None if shared is None else str(shared),
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
        reached = [one for one in own if one.version <= bound.version] if bound.is_unspecified else [bound]
        found |= {(str(one), port) for one in reached if (getattr(one, "ipv4_mapped", None) or one).is_global}
    return tuple(_joined(host, port) for host, port in sorted(found))


def _ask(
    ray: ModuleType,
    nodes: Mapping[str, dict[str, Any]],
    head_port: int,
    dashboard: tuple[str, int] | None,
    file: tuple[str, str] | None,
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Node id -> its facts, for each node that gave them, and node id -> why, for each that did not."""
    affinity = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    ray.cloudpickle.register_pickle_by_value(node_probe)
    try:
        probe = ray.remote(num_cpus=0, max_retries=0)(node_probe.facts)
        asked = {}
        for node_id, node in nodes.items():
            is_head = HEAD in node["Resources"]
            ports = [node[name] for name in NODE_PORTS]
            if is_head:
                ports += [head_port, *([dashboard[1]] if dashboard else [])]
            at = probe.options(scheduling_strategy=affinity(node_id, soft=False))
            asked[at.remote(ports, dashboard if is_head else None, file)] = node_id
    finally:
        ray.cloudpickle.unregister_pickle_by_value(node_probe)
    ready, late = ray.wait(list(asked), num_returns=len(asked), timeout=NODE_S)
    answers, silent = {}, {asked[ref]: f"no answer within {NODE_S:g} s" for ref in late}
    for ref in ready:
        try:
            answers[asked[ref]] = ray.get(ref)
        except ray.exceptions.RayError as error:
            silent[asked[ref]] = error_text(error).strip().rpartition("\n")[2]
    return answers, silent


def _answering(nodes: Mapping[str, dict[str, Any]], head: str) -> dict[str, list[str]]:
    """Node id -> which of its gRPC ports answer without a token."""
    calls = []
    for node_id, node in nodes.items():
        if HEAD in node["Resources"]:
            calls.append((node_id, f"head {_port(head)}", head, HEAD_CALL))
        port = node["NodeManagerPort"]
        calls.append((node_id, f"raylet {port}", _joined(node["NodeManagerAddress"], port), NODE_CALL))
    found: dict[str, list[str]] = {node_id: [] for node_id in nodes}
    for (node_id, name, *_), is_open in zip(calls, open_ports([call[2:] for call in calls]), strict=True):
        if is_open:
            found[node_id].append(name)
    return found


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


def _name(node: Mapping[str, Any]) -> str:
    return f"{node['NodeManagerHostname']} {node['NodeManagerAddress']}"


def _port(address: str) -> int:
    return int(address.rpartition(":")[2])


def _joined(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
