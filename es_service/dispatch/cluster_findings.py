"""What is wrong with a Ray cluster, judged from its facts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

from es_service.dispatch.cluster_facts import ClusterFacts, NodeFacts
from es_service.protocol.sources import in_words, other_files

SAME = "install the same on every node, as constraints.txt names it"


@dataclass(frozen=True)
class Finding:
    """One thing that was checked, with what is wrong or worth knowing."""

    level: Literal["ok", "note", "FAIL"]
    what: str
    where: str = ""
    """The nodes, by name; empty if it is about all of them."""
    meaning: str = ""
    """What may happen because of it; empty for "ok"."""
    way_out: str = ""
    """What to do about it; empty for "ok"."""

    @property
    def text(self) -> str:
        """The finding in one line."""
        place = f"{self.where}: " if self.where else ""
        return place + "; ".join(filter(None, (self.what, self.meaning, self.way_out)))


def findings(facts: ClusterFacts) -> list[Finding]:
    """What was checked, security first: for each check either "ok" or what is wrong, then what is worth knowing. Nodes
    with the same problem are in one finding."""
    nodes, here = facts.nodes, facts.driver.versions
    called = Counter(name.rpartition(" ")[0] for node in nodes for name in node.called)
    servers = ", ".join(f"{count} {name}{'s' * (count > 1)}" for name, count in called.items())
    ours = ", ".join(f"{name} {here[name]}" for name in ("ray", "python", "es-service") if name in here)
    checks = [
        (f"none of these servers of Ray answers without a token: {servers}", _all(_open, nodes)),
        ("Ray listens on no public address of these nodes", _all(_public, nodes)),
        (f"these nodes have {ours} and the packages of this host", _all(_versions, nodes, facts.driver)),
        ("these nodes have the code of this host", _all(_code, nodes, facts.driver)),
    ]
    if facts.shared:
        checks.append((f"these nodes share {facts.shared} with this host", _all(_disk, nodes, facts.shared)))
    total = len(nodes) + len(facts.silent)
    names = ", ".join(node.name for node in nodes)
    found = [Finding("ok", f"{len(nodes)} of {total} nodes answer: {names}")] if nodes else []
    for sound, problems in checks if nodes else ():
        found += _merged(problems) or [Finding("ok", sound)]
    silent = _merged(_silence(name, why) for name, why in facts.silent.items())
    return [*found, *silent, *_merged(_all(_processor, nodes, facts.driver)), *_wire(facts)]


def _all(check: Callable[..., Iterator[Finding]], nodes: Iterable[NodeFacts], *arguments: object) -> list[Finding]:
    return [found for node in nodes for found in check(node, *arguments)]


def _merged(found: Iterable[Finding]) -> list[Finding]:
    """Findings that are equal but for the nodes as one each."""
    merged: dict[Finding, list[str]] = {}
    for one in found:
        merged.setdefault(replace(one, where=""), []).append(one.where)
    return [replace(one, where=", ".join(where)) for one, where in merged.items()]


def _open(node: NodeFacts) -> Iterator[Finding]:
    if node.open_ports:
        yield Finding(
            "FAIL",
            "Ray answers without a token",
            f"{node.name} ({', '.join(node.open_ports)})",
            "whoever can reach these ports can run programs there",
            "start Ray again on every node, with RAY_AUTH_MODE=token and the same RAY_AUTH_TOKEN",
        )


def _public(node: NodeFacts) -> Iterator[Finding]:
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
        f"the node does not answer a task ({why})",
        name,
        "workers there would not start either",
        "read Ray's logs on it, in /tmp/ray/session_latest/logs, or remove it from the cluster",
    )


def _versions(node: NodeFacts, driver: NodeFacts) -> Iterator[Finding]:
    names = sorted(driver.versions.keys() & node.versions.keys() - {"cpu"})
    pairs = [(name, node.versions[name], driver.versions[name]) for name in names]
    if other := [f"{name} {theirs} (here {ours})" for name, theirs, ours in pairs if theirs != ours]:
        yield Finding(
            "FAIL",
            f"other versions: {', '.join(other)}",
            node.name,
            "a run may fail there, and its digest is marked mixed",
            SAME,
        )


def _code(node: NodeFacts, driver: NodeFacts) -> Iterator[Finding]:
    if node.problem:
        yield Finding(
            "FAIL", f"es-service cannot be used ({node.problem})", node.name, "workers there do not start", SAME
        )
    elif files := other_files(driver.sources, node.sources):
        yield Finding(
            "FAIL",
            f"other code than here in {in_words(files)}",
            node.name,
            "this node computes nothing for a driver on this host",
            "give every node the same files",
        )


def _processor(node: NodeFacts, driver: NodeFacts) -> Iterator[Finding]:
    if (cpu := node.versions.get("cpu")) != (ours := driver.versions.get("cpu")) and cpu and ours:
        yield Finding(
            "note",
            f"its processor is {cpu}, here {ours}",
            node.name,
            "the digest of a run on both is marked mixed, and with xla its last bits may differ",
            "use nodes of one kind for a run that must repeat bit for bit",
        )


def _disk(node: NodeFacts, shared: str) -> Iterator[Finding]:
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
            meaning="whoever can read the traffic of this network can read the token and use it",
            way_out="use a private network, or TLS (docker/README.md, Tokens)",
        )
