"""The systems by name: which class runs them, in which environment, and what the paper calls them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class System:
    """Where a system runs."""

    run: str
    """module:Class of its `run.Run`, beside this file."""
    environment: str
    """Name in `tests.learners.environment.ENVIRONMENTS`; empty for this project's own."""
    name: str
    """Its name in tables, which is that of the paper."""


def _ours(name: str) -> System:
    return System("our_run:OurRun", "", name)


SYSTEMS = {
    "td3": System("sbx_run:SbxRun", "learners", "TD3"),
    "sac": System("sbx_run:SbxRun", "learners", "SAC"),
    "rnd": System("sbx_run:SbxRun", "learners", "RND"),
    "diayn": System("diayn_run:DiaynRun", "qdax", "DIAYN"),
    "pga_me": System("map_run:MapRun", "qdax", "PGA-ME"),
    "qd_pg": System("map_run:MapRun", "qdax", "QD-PG"),
    "cem_rl": System("cem_run:CemRun", "qdax", "CEM-RL"),
    "es": _ours("ES"),
    "ns_es": _ours("NS-ES"),
    "nsr_es": _ours("NSR-ES"),
    "nsra_es": _ours("NSRA-ES"),
    "me_es": _ours("ME-ES"),
    "memes": _ours("MEMES"),
    "ars": _ours("ARS"),
    "map_elites": _ours("MAP-Elites"),
}
