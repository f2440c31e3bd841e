"""The checks of `es-service doctor --cluster`: whether a Ray cluster is safe, and computes what this host would."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from es_service.cli.data import print_json
from es_service.cli.options import print_finding
from es_service.dispatch.cluster_facts import cluster_facts
from es_service.dispatch.cluster_findings import findings


def examine_cluster(address: str, shared: Path | None, *, as_json: bool = False) -> bool:
    """Print what was checked and found, one line each, or as JSON, and return whether nothing is wrong."""
    found = findings(cluster_facts(address, shared))
    if as_json:
        print_json([{**asdict(one), "text": one.text} for one in found])
    else:
        for one in found:
            print_finding(one.level, one.text)
    return all(one.level != "FAIL" for one in found)
