"""Search algorithms by name. A method, or a family that differs in a constant, is a file of its own: its settings, its
state and its functions.

An algorithm is a few pure functions of a `SearchState`; it does not run episodes itself. In each generation the driver
asks it which centres restart from elites (`start_cells`), which elites it needs (`parents`) and which centres to
perturb or policies to evaluate (`ask`), then for each of these centres how to weight the noise (`weights`) and what the
new centre is (`step`), and tells it the evaluations of the new centres and of the policies (`tell`).
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping

from es_service.config.search import PopulationConfig, SearchConfig
from es_service.search.algorithms import evosax
from es_service.search.algorithms.method import Method, user_method
from es_service.search.algorithms.settings import UndeclaredSettings


def _shipped() -> Iterator[Method]:
    """The methods that files of this folder have under their own names."""
    for file in pkgutil.iter_modules(__path__):
        for name, value in vars(importlib.import_module(f"{__name__}.{file.name}")).items():
            if isinstance(value, Method) and value.name == name:
                yield value


def _by_simplicity(method: Method) -> tuple[int, str]:
    """Number of keys that other gradient methods lack, or have with another default; and the name."""
    common, settings = PopulationConfig.model_fields, method.settings
    fields = settings.model_fields.items()
    extra = [name for name, key in fields if name not in common or key.default != common[name].default]
    return len(extra) + len(settings.presets), method.name


OURS: dict[str, Method] = {method.name: method for method in sorted(_shipped(), key=_by_simplicity)}
"""The shipped methods, the simplest first: a config that no search uses may leave `search.algorithm` out."""


class Algorithms(Mapping[str, Method]):
    """Methods by name. Iteration yields the shipped ones; lookup also finds `package.module:function`, and the
    optimisers of a library by `evosax:NAME`."""

    def __getitem__(self, name: str) -> Method:
        """Raises KeyError for a plain name that is not shipped, ConfigError for what cannot be used."""
        kind, colon, rest = name.partition(":")
        if kind == evosax.LIBRARY and colon:
            return evosax.named(rest)
        return user_method(name) if colon else OURS[name]

    def __iter__(self) -> Iterator[str]:
        return iter(OURS)

    def __len__(self) -> int:
        return len(OURS)


ALGORITHMS = Algorithms()


def known_settings(name: str) -> type[SearchConfig]:
    """The settings of a method as far as they are known without importing what is none of ours."""
    if name.startswith(f"{evosax.LIBRARY}:"):
        return evosax.EvosaxSettings
    return OURS[name].settings if name in OURS else UndeclaredSettings
