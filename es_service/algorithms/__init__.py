"""Search algorithms: a name -> a factory. One method, one short file; shared steps are functions.

An algorithm is a handful of pure functions on its `SearchState`; it never evaluates anything itself. Each generation
the driver asks it what to perturb (`plan`), how to weigh the noise (`weights`), and where that leads (`step`).
"""

from __future__ import annotations

from collections.abc import Callable

from es_service.algorithms.base import Algorithm
from es_service.algorithms.es import es
from es_service.config.model import SearchConfig

ALGORITHMS: dict[str, Callable[[SearchConfig], Algorithm]] = {"es": es}
