"""Configs checked against all there is: every task and every search, those of the user's own too.

Nothing is made of a config that its search refuses: no folder, no worker.
"""

from __future__ import annotations

from es_service.config import loading
from es_service.config.keys import Overrides
from es_service.config.loading import Source
from es_service.config.model import RunConfig
from es_service.config.tasks import TASKS, no_vectors
from es_service.search.algorithms import ALGORITHMS


def load_config(source: Source, overrides: Overrides = (), *, new: bool = True) -> RunConfig:
    """Read a YAML file (or a mapping like one), apply overrides such as "search.sigma=0.05", resolve and check it all.

    Args:
        new: whether a run is to be started with it here and now, so that the run it starts from must be there.

    Raises:
        ConfigError: lists every problem found.
    """
    return _accepted(
        loading.load_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS, no_vectors=no_vectors(), new=new)
    )


def changed_config(source: Source, overrides: Overrides = ()) -> RunConfig:
    """The config of a run that exists, with some keys changed; see `loading.changed_config`.

    Raises:
        ConfigError: lists every problem found.
    """
    return _accepted(
        loading.changed_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS, no_vectors=no_vectors())
    )


def _accepted(config: RunConfig) -> RunConfig:
    """The config, unless its search, perhaps one of the user's own, refuses it."""
    ALGORITHMS[config.search.algorithm](config)
    return config
