"""What is wrong with a Ray cluster, judged from its facts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from es_service.dispatch.cluster_facts import ClusterFacts, NodeFacts
from es_service.protocol.sources import in_words, other_files


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a cluster, or worth knowing."""

    level: Literal["FAIL", "note"]
    what: str
    where: str
    """The nodes, by name."""
    meaning: str
    """What may happen because of it."""
    way_out: str

    @property
    def text(self) -> str:
        """The finding in one line."""
        return f"{self.where}: {self.what}; {self.meaning}; {self.way_out}"


def findings(facts: ClusterFacts) -> list[Finding]:
    """Everything that is wrong, security first; nodes with the same problem are in one finding."""
    found = [
        *(one for node in facts.nodes for one in _exposure(node)),
        *(_silence(name, why) for name, why in facts.silent.items()),
        *(one for node in facts.nodes for one in _software(node, facts.driver)),
        *(one for node in facts.nodes for one in _disk(node, facts.shared)),
        *_wire(facts),
    ]
    merged: dict[Finding, list[str]] = {}
    for one in found:
        merged.setdefault(replace(one, where=""), []).append(one.where)
    return [replace(one, where=", ".join(where)) for one, where in merged.items()]


def _exposure(node: NodeFacts) -> Iterator[Finding]:
    if node.open_ports:
        yield Finding(
            "FAIL",
            "Ray answers without a token",
            f"{node.name} ({', '.join(node.open_ports)})",
            "whoever can reach these ports can run programs there",
            "start Ray again on every node, with RAY_AUTH_MODE=token and the same RAY_AUTH_TOKEN",
        )
    if node.public:
        yield Finding(
            "FAIL",
            "Ray listens on a public address",
            f"{node.name} ({', '.join(node.public)})",
            "unless a firewall prevents it, anyone can try to connect, and whoever reads the traffic sees the token",
            "close these ports in a firewall, or use machines that have only private addresses",
        )


def _silence(name: str, why: str) -> Finding:
    return Finding(
        "FAIL",
        f"the node gives no answer ({why})",
        name,
        "workers there would not start either",
        "read Ray's logs on it, in /tmp/ray/session_latest/logs, or remove it from the cluster",
    )


def _software(node: NodeFacts, driver: NodeFacts) -> Iterator[Finding]:
    same = "install the same on every node, as constraints.txt names it"
    names = sorted(driver.versions.keys() & node.versions.keys() - {"cpu"})
    pairs = [(name, node.versions[name], driver.versions[name]) for name in names]
    if other := [f"{name} {theirs} (here {ours})" for name, theirs, ours in pairs if theirs != ours]:
        yield Finding(
            "FAIL",
            f"other versions: {', '.join(other)}",
            node.name,
            "a run may fail there, and its digest is marked mixed",
            same,
        )
    if node.problem:
        yield Finding(
            "FAIL", f"es-service cannot be used ({node.problem})", node.name, "workers there do not start", same
        )
    elif files := other_files(driver.sources, node.sources):
        yield Finding(
            "FAIL",
            f"other code than here in {in_words(files)}",
            node.name,
            "this node computes nothing for a driver on this host",
            "give every node the same files",
        )
    if (cpu := node.versions.get("cpu")) != (ours := driver.versions.get("cpu")) and cpu and ours:
        yield Finding(
            "note",
            f"its processor is {cpu}, here {ours}",
            node.name,
            "the digest of a run on both is marked mixed, and with xla its last bits may differ",
            "use nodes of one kind for a run that must repeat bit for bit",
        )


def _disk(node: NodeFacts, shared: str | None) -> Iterator[Finding]:
    if node.not_shared:
        yield Finding(
            "FAIL",
            f"{shared} is not shared ({node.not_shared})",
            node.name,
            "what this host writes there is not on that node, and a run that continues there does not find its folder",
            "mount the same disk at the same path, readable by the user of Ray",
        )


def _wire(facts: ClusterFacts) -> Iterator[Finding]:
    if len(facts.nodes) > 1 and not facts.encrypted:
        yield Finding(
            "note",
            "messages between nodes are not encrypted",
            "all nodes",
            "whoever can read the traffic of this network can read the token and use it",
            "use a private network, or TLS (docker/README.md, Tokens)",
        )
