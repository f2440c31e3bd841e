"""The smallest config, and tasks to load one for; words that try a reader of YAML."""

from __future__ import annotations

import string

from hypothesis import strategies as st

from es_service.config import changes
from es_service.config.loading import Known, read
from es_service.config.model import RunConfig
from es_service.search.algorithms import ALGORITHMS
from workers import environments
from workers.rollouts import BACKENDS

POINT_MAZE = environments.SHIPPED["point_maze"]
TASKS = {"point_maze": POINT_MAZE}
MINIMAL = {"task": {"environment": "point_maze"}, "search": {"algorithm": "es"}, "budget": {"generations": 3}}
MINIMAL_TEXT = "task: {environment: point_maze}\nsearch: {algorithm: es}\nbudget: {generations: 3}\n"
WORDS = st.text(string.ascii_letters + string.digits + " .:#'\"-_+~/&*!%[]{}", max_size=12)


def load_config(source, overrides=(), *, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS, **how) -> RunConfig:
    return read(source, overrides, Known(tasks, algorithms, rollouts), **how).config()


def left_out(source, overrides, **known) -> dict[str, str]:
    """Keys of a config that overrides make useless, each with the reason."""
    return dict(
        read(
            source, overrides, Known(**({"tasks": TASKS, "algorithms": ALGORITHMS, "rollouts": BACKENDS} | known))
        ).left_out
    )


def changed_config(source, overrides=(), *, tasks=TASKS, algorithms=ALGORITHMS, rollouts=BACKENDS, **how) -> RunConfig:
    return changes.changed_config(source, overrides, Known(tasks, algorithms, rollouts), **how)


def load(source=MINIMAL, *overrides: str) -> RunConfig:
    return load_config(source, overrides)
