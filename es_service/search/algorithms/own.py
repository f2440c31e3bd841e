"""A search of the user's own: `package.module:function`.

    def function(config: RunConfig) -> Algorithm: ...

`es_service.search.algorithms.base` has what an Algorithm is made of, `steps` what ours share: most searches are one of
ours with one function replaced. What it remembers between generations is a `SearchState`, which the run store keeps; a
value kept anywhere else is lost with the process. It runs in the driver; a docstring's first line says what it is.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable

from es_service.config.model import RunConfig
from es_service.errors import ConfigError
from es_service.search.algorithms.base import Algorithm


def import_factory(path: str) -> Callable[[RunConfig], object]:
    """The user's function. Raises ConfigError if it cannot be had."""
    module, _, name = path.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a console script does not look where it was started
    try:
        found = getattr(importlib.import_module(module), name, None)
    except Exception as error:  # the user's code can raise anything
        kind = type(error).__name__
        raise ConfigError(
            f"cannot import {module} ({kind}: {error}); start in the folder that contains it, or install it"
        ) from error
    if not callable(found):
        raise ConfigError(f"{module} has no function {name!r}; es_service/search/algorithms/own.py says what is needed")
    return found


def make_own(path: str, config: RunConfig) -> Algorithm:
    """The search that a user's function makes for a run. Raises ConfigError if it raises, or makes something else."""
    factory = import_factory(path)
    try:
        made = factory(config)
    except Exception as error:  # the user's code can raise anything
        raise ConfigError(f"search.algorithm: {path} raised {type(error).__name__}: {error}") from error
    if not isinstance(made, Algorithm):
        raise ConfigError(
            f"search.algorithm: {path} returned {made!r}, which is no es_service.search.algorithms.base.Algorithm"
        )
    return made
