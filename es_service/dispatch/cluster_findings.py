"""What is wrong with a Ray cluster: do its nodes answer with the software of this host, and does it ask for a token?

A task on each node tells of its software (`node_probe`). The head and the dashboard are called without a token.
"""

from __future__ import annotations

import contextlib
import http.client
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

from es_service.dispatch import node_probe
from es_service.dispatch.ray_calls import error_text
from es_service.dispatch.ray_cluster import connect, disconnect, require_node
from es_service.dispatch.ray_head import HEAD_CALL, grpc_module, status_code, uses_tls
from es_service.errors import EvaluationError
from es_service.protocol.sources import in_words, other_files

NODE_S = 60.0
"""Longest wait for the answers of all nodes, in seconds; a node first starts a process for the task."""
HTTP_S = 5.0
"""Longest wait for an answer of the dashboard, in seconds."""
SAME = "install the same on every node, as constraints.txt names it"
Finding = tuple[str, str]
"""Level ("ok", "note" or "FAIL") and text: what is wrong; what may happen because of it; what to do about it."""
Software = Mapping[str, Any]
"""What `node_probe.software` returns."""


def cluster_findings(address: str) -> list[Finding]:
    """Join a cluster and check it; each check is either "ok" or says what is wrong.

    Args:
        address: "HOST:PORT", or "auto" for the cluster on this machine.

    Raises:
        EvaluationError: the connection failed, or a package is missing.
    """
    grpc = grpc_module()  # `connect` works without it, but may wait for a minute
    try:
        require_node(address)
        ray = connect(address, gpus=False, cpus=1)
    except EvaluationError as error:  # its ways out are those of a run
        raise EvaluationError(" ".join(error.sentence.split()), field="cluster", value=address) from error
    try:
        answers, silent = _ask(ray)
        head, dashboard = ray.get_runtime_context().gcs_address, _dashboard(ray)
    finally:
        disconnect(ray)
    is_open = {f"head {head}": status_code(grpc, head, HEAD_CALL) is None}
    if dashboard:
        is_open[f"dashboard {dashboard}"] = answers_anyone(dashboard)
    of_access = access_findings(is_open, len(answers) + len(silent), encrypted=uses_tls())
    return [*node_findings(answers, silent, node_probe.software()), *of_access]


def node_findings(answers: Mapping[str, Software], silent: Mapping[str, str], here: Software) -> Iterator[Finding]:
    """Findings about the nodes; those with the same problem are in one.

    Args:
        answers: name of each node that answered -> its software.
        silent: name of each other node -> why it did not.
        here: the software of this host.
    """
    if answers:
        yield "ok", f"{len(answers)} of {len(answers) + len(silent)} nodes answer: {', '.join(answers)}"
    where: dict[Finding, list[str]] = {}
    for node, why in silent.items():
        what = f"the node does not answer a task ({why}); workers there would not start either"
        logs = "read Ray's logs on it, in /tmp/ray/session_latest/logs, or remove it from the cluster"
        where.setdefault(("FAIL", f"{what}; {logs}"), []).append(node)
    for node, theirs in answers.items():
        for finding in _differences(theirs, here):
            where.setdefault(finding, []).append(node)
    if not any(level == "FAIL" for level, _ in where):
        ours = ", ".join(f"{name} {here['versions'][name]}" for name in ("ray", "python", "es-service"))
        yield "ok", f"these nodes have {ours}, and the packages and the code of this host"
    for (level, text), nodes in where.items():
        yield level, f"{', '.join(nodes)}: {text}"


def access_findings(is_open: Mapping[str, bool], nodes: int, *, encrypted: bool) -> Iterator[Finding]:
    """Findings about who can use a cluster.

    Args:
        is_open: server of Ray -> whether it answers without a token.
        nodes: number of its nodes.
        encrypted: whether Ray's processes use TLS.
    """
    if servers := ", ".join(name for name, is_one in is_open.items() if is_one):
        meaning = "whoever can reach these ports can run programs on every node"
        way_out = "start Ray again on every node, with RAY_AUTH_MODE=token and the same RAY_AUTH_TOKEN"
        yield "FAIL", f"{servers}: Ray answers without a token; {meaning}; {way_out}"
    else:
        yield "ok", f"none of these servers of Ray answers without a token: {', '.join(is_open)}"
    if encrypted:
        yield "ok", "Ray's processes use TLS"
    elif nodes > 1:
        meaning = "whoever can read the traffic of this network can read the token and use it"
        way_out = "use a private network, or TLS (docker/README.md, Tokens)"
        yield "note", f"messages between nodes are not encrypted; {meaning}; {way_out}"


def answers_anyone(server: str) -> bool:
    """Whether an HTTP server, HOST:PORT, answers a request without a token, be it that it does not know the path."""
    connection = http.client.HTTPConnection(server, timeout=HTTP_S)
    try:
        connection.request("GET", "/api/version")  # its page needs no token
        return connection.getresponse().status not in (http.client.UNAUTHORIZED, http.client.FORBIDDEN)
    except (OSError, http.client.HTTPException):  # nothing answers there
        return False
    finally:
        connection.close()


def _differences(theirs: Software, here: Software) -> Iterator[Finding]:
    """What is wrong with the software of a node."""
    versions, ours = theirs["versions"], here["versions"]
    names = sorted(ours.keys() & versions.keys() - {"cpu"})
    if other := [f"{name} {versions[name]} (here {ours[name]})" for name in names if versions[name] != ours[name]]:
        meaning = "a run may fail there, and its digest is marked mixed"
        yield "FAIL", f"other versions: {', '.join(other)}; {meaning}; {SAME}"
    if theirs["problem"]:
        yield "FAIL", f"es-service cannot be used ({theirs['problem']}); workers there do not start; {SAME}"
    elif files := other_files(here["sources"], theirs["sources"]):
        meaning = "this node computes nothing for a driver on this host"
        yield "FAIL", f"other code than here in {in_words(files)}; {meaning}; give every node the same files"
    if (cpu := versions.get("cpu")) != ours.get("cpu") and cpu and ours.get("cpu"):
        meaning = "the digest of a run on both is marked mixed, and with xla its last bits may differ"
        way_out = "use nodes of one kind for a run that must repeat bit for bit"
        yield "note", f"its processor is {cpu}, here {ours['cpu']}; {meaning}; {way_out}"


def node_names(nodes: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Id of each living node -> its host and address; nodes that share both have the port of their raylet, too.

    Args:
        nodes: what `ray.nodes()` returns.
    """
    places = {
        node["NodeID"]: (f"{node['NodeManagerHostname']} {node['NodeManagerAddress']}", node["NodeManagerPort"])
        for node in nodes
        if node["Alive"]
    }
    shared = Counter(name for name, _ in places.values())
    return {node: f"{name}:{port}" if shared[name] > 1 else name for node, (name, port) in places.items()}


def _ask(ray: ModuleType) -> tuple[dict[str, Software], dict[str, str]]:
    """Name of each node -> its software, or why it gave no answer."""
    affinity = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    ray.cloudpickle.register_pickle_by_value(node_probe)
    try:
        probe = ray.remote(num_cpus=0, max_retries=0)(node_probe.software)
        asked = {
            probe.options(scheduling_strategy=affinity(node, soft=False)).remote(): name
            for node, name in node_names(ray.nodes()).items()
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
    return dict(sorted(answers.items())), dict(sorted(silent.items()))


def _dashboard(ray: ModuleType) -> str | None:
    """HOST:PORT of the dashboard; None if there is none.

    Ray has no public function for this. If a version of Ray lacks this one, the dashboard is not checked.
    """
    with contextlib.suppress(AttributeError):
        return ray._private.worker.get_dashboard_url() or None
    return None
