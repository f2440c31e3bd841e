"""A search method: a function that makes an `Algorithm` for a run, with the class of its settings.

class MySettings(PopulationConfig):
    reach: float = Field(0.5, ge=0.0, description="...")     # a key of the config, `search.reach`

@method(MySettings)
def my_search(config: RunConfig) -> Algorithm:
    reach = settings_of(config, MySettings).reach
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from es_service.config.model import RunConfig
from es_service.config.search import SearchConfig
from es_service.search.algorithms.base import Algorithm


@dataclass(frozen=True)
class Method:
    """What makes the algorithm of a run from its config."""

    make: Callable[[RunConfig], Algorithm]
    settings: type[SearchConfig]
    """Its keys, and what it declares; see `es_service/config/search.py`."""
    name: str
    """Value of `search.algorithm`."""
    summary: str
    """What it does, in one sentence."""

    def __call__(self, config: RunConfig) -> Algorithm:
        """The algorithm of a run."""
        return self.make(config)


def method(settings: type[SearchConfig]) -> Callable[[Callable[[RunConfig], Algorithm]], Method]:
    """Decorator that makes a method with these settings of a function, which has its name."""

    def declare(make: Callable[[RunConfig], Algorithm]) -> Method:
        summary = (make.__doc__ or "").strip().partition("\n")[0]
        return Method(make, settings, make.__name__, summary)

    return declare
