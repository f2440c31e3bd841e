"""Search algorithms: a name -> a factory. One method, one short file; shared steps are functions.

An algorithm is a handful of pure functions on a `SearchState`; it never evaluates anything itself. Each generation the
driver asks it whether to start afresh from an elite (`start_cell`), what to perturb (`ask`), how to weigh the noise
(`weights`) and where that leads (`step`), and lets it learn from the new centre's evaluation (`tell`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from es_service.config.model import RunConfig
from es_service.search.algorithms.base import Algorithm
from es_service.search.algorithms.es import es
from es_service.search.algorithms.me_es import me_es
from es_service.search.algorithms.ns_es import ns_es
from es_service.search.algorithms.nsr_es import nsr_es
from es_service.search.algorithms.nsra_es import nsra_es
from es_service.search.algorithms.own import import_factory, make_own

Factory = Callable[[RunConfig], Algorithm]
OURS: dict[str, Factory] = {"es": es, "ns_es": ns_es, "nsr_es": nsr_es, "nsra_es": nsra_es, "me_es": me_es}


class Algorithms(Mapping[str, Factory]):
    """Iterates over our own algorithms; looks up any, `package.module:function` too."""

    def __getitem__(self, name: str) -> Factory:
        """Raises KeyError for a plain name that is none of ours, ConfigError for a function that cannot be had."""
        if ":" not in name:
            return OURS[name]
        import_factory(name)
        return partial(make_own, name)

    def __iter__(self) -> Iterator[str]:
        return iter(OURS)

    def __len__(self) -> int:
        return len(OURS)


ALGORITHMS = Algorithms()
