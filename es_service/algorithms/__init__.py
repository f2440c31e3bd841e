"""Search algorithms: a name -> a factory. One method, one short file; shared steps are functions.

An algorithm is a handful of pure functions on a `SearchState`; it never evaluates anything itself. Each generation the
driver asks it whether to start afresh from an elite (`start_cell`), what to perturb (`plan`), how to weigh the noise
(`weights`) and where that leads (`step`), and lets it learn from the new centre's evaluation (`absorb`).
"""

from __future__ import annotations

from collections.abc import Callable

from es_service.algorithms.base import Algorithm
from es_service.algorithms.es import es
from es_service.algorithms.me_es import me_es
from es_service.algorithms.ns_es import ns_es
from es_service.algorithms.nsr_es import nsr_es
from es_service.algorithms.nsra_es import nsra_es
from es_service.config.model import RunConfig

ALGORITHMS: dict[str, Callable[[RunConfig], Algorithm]] = {
    "es": es,
    "ns_es": ns_es,
    "nsr_es": nsr_es,
    "nsra_es": nsra_es,
    "me_es": me_es,
}
