"""The resolved, frozen config of a run, and the part of it that can never change once the run exists.

A `RunConfig` contains no `auto` that would affect results. It is made by `loading.read` and not by hand: that fills in
presets, defaults and shapes and checks the sections against each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import Field, PrivateAttr, SerializeAsAny

from es_service.config.parts import (
    TASK_OPTIONS,
    Section,
    Seed,
)
from es_service.config.search import SearchConfig
from es_service.config.sections import (
    BudgetConfig,
    ComputeConfig,
    MapConfig,
    NoveltyConfig,
    PolicyConfig,
    StoreConfig,
    TaskConfig,
)
from es_service.config.text import dump_yaml
from es_service.protocol.messages import TaskSpec

COMPUTE_CONSTANTS = ("rollout", "chunk_pairs", "rollout_block_pairs", "gradient_block_pairs")
"""Keys of `compute` that affect floating-point results and are therefore constants of the run."""
RECYCLING = "task.recycle_after_episodes"
"""The key of `task` that changes no result."""
ENGINE_IMPLIES: dict[str, dict[str, Any]] = {
    "inline": {"compute.address": None, "compute.worker_resources.cpu": "auto"},
    "ray": {"compute.inline_workers": "processes"},
}
"""Engine -> settings that only the other engine uses, with the values that they must have with this one."""


def implied_by(engine: str | None, address: str | None) -> dict[str, Any]:
    """Settings that a choice of the engine or of a cluster's address implies; None: no choice."""
    if address is None:
        return ENGINE_IMPLIES.get(engine or "", {})
    return ENGINE_IMPLIES["ray"] | ({} if engine else {"compute.engine": "ray"})  # only a Ray cluster can be joined


@dataclass(frozen=True)
class Kept:
    """A value that a config gives to a key, although what it was written for has been replaced."""

    value: Any
    default: Any
    """What the key would have without it."""
    replaced: str
    """The key that overrides have changed: `search.algorithm`, or the kind of a part."""
    by: str
    """The value of that key now."""

    @property
    def why(self) -> str:
        """What is replaced, as a clause."""
        return replaces(self.replaced, self.by)


def replaces(key: str, value: Any) -> str:
    """A clause that says which value replaces that of a config file."""
    return f"{value} replaces its {'algorithm' if key == 'search.algorithm' else key}"


@dataclass(frozen=True)
class ConfigOrigin:
    """What a config was made from."""

    task: TaskSpec
    """The task from which values that were left open were resolved, with the descriptor that its options choose."""
    given: Mapping[str, Any] = field(compare=False)
    """What was given, by dotted key."""
    left_out: Mapping[str, str] = field(compare=False)
    """Keys of the file that go with the task, the method or the kind of a part that overrides have replaced, or whose
    values the new task or method does not allow; each with a clause that says so."""
    kept: Mapping[str, Kept] = field(compare=False)
    """Keys of the file that keep their values although overrides replace the method, or the kind of a part, for which
    they were written, and the new one has another default."""


class RunConfig(Section):
    """The config of a whole run. Equal configs give equal results, wherever and however often they run."""

    task: TaskConfig
    policy: PolicyConfig
    search: SerializeAsAny[SearchConfig]
    novelty: NoveltyConfig
    map: MapConfig
    budget: BudgetConfig
    compute: ComputeConfig
    store: StoreConfig
    seed: Seed = Field(
        0,
        description="Seed of all random numbers of the run. The same seed and settings give the same run, bit for bit.",
    )
    _made: ConfigOrigin | None = PrivateAttr(None)

    def made_of(self, made: ConfigOrigin) -> RunConfig:
        """The same config, which knows what it was made from."""
        config = self.model_copy()
        config._made = made
        return config

    @property
    def made(self) -> ConfigOrigin:
        """What the config was made from."""
        if self._made is None:
            raise ValueError("this config was not loaded; load it with load_config")
        return self._made

    def resolved_yaml(self) -> str:
        """The text of the run folder's `config.yaml`, with every value. Loading it gives an equal config."""
        return dump_yaml(self.model_dump(mode="json"))

    def given_yaml(self, changes: Mapping[str, Any]) -> str:
        """The text of a config file that gives what this config was given, with some values changed by dotted key. This
        version makes the same config of it on this machine."""
        return dump_yaml(nested({**self.made.given, **changes}))

    def constants(self) -> dict[str, Any]:
        """Values that resume must not change: dotted key -> plain JSON value, in the order of the config."""
        return {key: value for key, value in flat(self.model_dump(mode="json")).items() if is_constant(key)}


def is_constant(key: str) -> bool:
    """Whether resume must not change the value of a key."""
    section, _, name = key.partition(".")
    if key == RECYCLING:
        return False
    return section not in ("budget", "store") and (section != "compute" or name in COMPUTE_CONSTANTS)


def flat(sections: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings: {"search": {"sigma": 0.02}} -> {"search.sigma": 0.02}. An option that is a mapping is a
    value."""
    values: dict[str, Any] = {}
    for key, value in sections.items():
        is_group = isinstance(value, Mapping) and prefix != TASK_OPTIONS
        values |= flat(value, f"{prefix}{key}.") if is_group else {f"{prefix}{key}": value}
    return values


def nested(values: Mapping[str, Any], sections: Iterable[str] = ()) -> dict[str, Any]:
    """Nested mappings from dotted keys, the inverse of `flat`; with these sections, even if they are empty."""
    whole: dict[str, Any] = {section: {} for section in sections}
    for name, value in values.items():
        *path, leaf = name.split(".")
        target = whole
        for group in path:
            target = target.setdefault(group, {})
        target[leaf] = value
    return whole
