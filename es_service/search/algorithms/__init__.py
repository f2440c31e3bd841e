"""Search algorithms by name. Each method is a file of its own: its settings, its state and its functions.

An algorithm is a few pure functions of a `SearchState`; it does not run episodes itself. In each generation the driver
asks it which centres restart from elites (`start_cells`), which elites it needs (`parents`) and which centres to
perturb or policies to evaluate (`ask`), then for each of these centres how to weight the noise (`weights`) and what the
new centre is (`step`), and tells it the evaluations of the new centres and of the policies (`tell`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from es_service.search.algorithms.ars import ars
from es_service.search.algorithms.es import es
from es_service.search.algorithms.jedi import jedi
from es_service.search.algorithms.map_elites import map_elites
from es_service.search.algorithms.me_es import me_es
from es_service.search.algorithms.memes import memes
from es_service.search.algorithms.method import Method
from es_service.search.algorithms.ns_es import ns_es
from es_service.search.algorithms.nsr_es import nsr_es
from es_service.search.algorithms.nsra_es import nsra_es
from es_service.search.algorithms.own import own_method
from es_service.search.algorithms.polish import polish

OURS: dict[str, Method] = {
    one.name: one for one in (es, ns_es, nsr_es, nsra_es, me_es, memes, map_elites, ars, polish, jedi)
}
"""The shipped methods, the simplest first: a config that no search uses may leave `search.algorithm` out."""


class Algorithms(Mapping[str, Method]):
    """Methods by name. Iteration yields the shipped ones; lookup also finds `package.module:function`."""

    def __getitem__(self, name: str) -> Method:
        """Raises KeyError for a plain name that is not shipped, ConfigError for a function that cannot be used."""
        return own_method(name) if ":" in name else OURS[name]

    def __iter__(self) -> Iterator[str]:
        return iter(OURS)

    def __len__(self) -> int:
        return len(OURS)


ALGORITHMS = Algorithms()
