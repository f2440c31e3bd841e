"""The checks of `es-service doctor --cluster`: whether a Ray cluster is safe, and computes what this host would."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from es_service.cli.data import print_json
from es_service.cli.options import print_finding
from es_service.dispatch.cluster_facts import ClusterFacts, cluster_facts
from es_service.dispatch.cluster_findings import findings


def examine_cluster(address: str, shared: Path | None, *, as_json: bool = False) -> bool:
    """Print what was found, one line each, or as JSON, and return whether nothing is wrong."""
    facts = cluster_facts(address, shared)
    found = findings(facts)
    is_sound = all(one.level != "FAIL" for one in found)
    if as_json:
        print_json([{"level": "ok", "text": _summary(facts)}, *({**asdict(one), "text": one.text} for one in found)])
        return is_sound
    print_finding("ok", _summary(facts))
    for one in found:
        print_finding(one.level, one.text)
    return is_sound


def _summary(facts: ClusterFacts) -> str:
    versions = facts.driver.versions
    names = ", ".join(node.name for node in facts.nodes)
    disk = f", and whether {facts.shared} is shared" if facts.shared else ""
    return (
        f"{len(facts.nodes)} of {len(facts.nodes) + len(facts.silent)} nodes answered: {names}; compared with ray "
        f"{versions['ray']}, python {versions['python']}, es-service {versions['es-service']} and its code on this "
        f"host{disk}"
    )
