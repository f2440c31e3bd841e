"""What a new run takes from another one: everything (a fork), or a centre (`search.init_from`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from es_service.config.changes import START_KEYS, changed_constants, does_not_fit, start_afresh
from es_service.config.keys import Overrides, parse_overrides
from es_service.config.model import RunConfig, policy_shape
from es_service.config.start import start_of
from es_service.config.tasks import task_of
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, Problem
from es_service.loop.parts import (
    BEST,
    CELL_PREFIX,
    CENTRE_PREFIX,
    ELITE_PREFIX,
    OBSERVATIONS,
    WEIGHT,
    Arrays,
    Parts,
    moments_from_arrays,
    moments_to_arrays,
    weight_from_arrays,
    weight_to_arrays,
)
from es_service.protocol.messages import Moments
from es_service.runs.checked_config import changed_config
from es_service.runs.view import Run, is_no_elite, open_run
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import NO_CELL, FitnessWeight
from es_service.search.observation_statistics import no_observations
from es_service.store import reader
from es_service.store.beginning import Beginning
from es_service.store.codec import Part
from es_service.store.digest import digest_at

NORMALISED = "policy.observation_normalization"
OBSERVED = ("policy.observation_clip", NORMALISED)
"""What a policy does with its observations."""
LUCK = ("task.episodes_per_member", "search.pairs", "search.sigma", "policy.action_noise")
"""What the highest fitness of a population depends on, besides what an evaluation means."""
ROWS_AT_ONCE = 4096
"""Of a history, in memory."""


def fork_config(parent: str | os.PathLike[str], overrides: Overrides = ()) -> RunConfig:
    """The config of a fork: the one that the parent would go on with, with overrides.

    Raises:
        ConfigError: as `load_config`, the parent's state does not fit the changes, or a key would change nothing.
    """
    origin = open_run(parent)
    if not isinstance(overrides, str | Mapping):
        overrides = list(overrides)  # it is gone through twice
    wanted = parse_overrides(overrides)[0]
    searched = origin.constants["search.algorithm"]
    begins_anew = {"search.fitness_weight_start"} if wanted.get("search.algorithm", searched) != searched else set()
    if idle := [key for key in START_KEYS if key in wanted and key not in begins_anew]:
        raise _refused(
            origin,
            "a fork has its state and all its settings, so these would change nothing",
            [Problem(key, key, wanted[key]) for key in idle],
            "instead of a preset, set the keys that it stands for",
        )
    present = origin.present_config
    mapping = present | {"search": present["search"] | {"init_from": None}}  # it has the parent's state instead
    config = changed_config(mapping, overrides)
    changes = changed_constants(origin.constants, config.constants())
    unfit = [_unfit(name, old, new, name) for name, old, new in changes if does_not_fit(name, old, new)]
    names = task_of(config).descriptor_names
    if not unfit and list(names) != origin.descriptor_names:  # a task of the user's that is not what it was
        what = f"the descriptor of {config.task.environment}"
        unfit = [_unfit(what, origin.descriptor_names, list(names), "task.environment")]
    if not unfit and origin.policy_shape != (shape := policy_shape(config, task_of(config))):
        old, new = list(origin.policy_shape.widths), list(shape.widths)
        unfit = [_unfit("the network's layers", old, new, "policy.hidden")]
    if unfit:
        raise _refused(origin, "its state does not fit these changes", unfit)
    return config


def _unfit(what: str, old: Any, new: Any, field: str) -> Problem:
    return Problem(f"{what}: {show(old)} -> {show(new)}", field, new, show(old), old)


def _refused(origin: Run, why: str, problems: Sequence[Problem], note: str = "") -> ConfigError:
    """The error for a fork that cannot be made with some settings; a new run could be, from the origin's centre."""
    ways_out = [start_afresh(origin.folder)]
    return ConfigError.listing(f"{origin.folder}: {why}:", problems, note, run=origin.folder, ways_out=ways_out)


def forked(origin: Run, config: RunConfig, generation: int | None) -> tuple[dict[str, Any], Beginning]:
    """What a fork of `origin` records of it, and begins with: all of it up to a generation, None for the newest.

    Raises:
        StoreError: the state of that generation is not kept.
    """
    at, parts = origin.parts(generation)
    changed = {name for name, _, _ in changed_constants(origin.constants, config.constants())}
    if any(name in OBSERVED or name.startswith("task.") for name in changed.difference(LUCK)):
        parts = _without_fitness(parts)
    elif changed.intersection(LUCK):
        parts = _without_scores(parts)
    if "search.algorithm" in changed:
        weight = FitnessWeight(ALGORITHMS[config.search.algorithm](config).fitness_weight)
        parts = {**parts, WEIGHT: weight_to_arrays(weight)}
    if "search.parent_statistics" in changed and config.search.parent_statistics == "global":
        parts = _without_own_statistics(parts)
    platforms = [(first, platform) for first, platform in reader.read_platforms(origin.folder) if first <= at]
    return _lineage(origin, at), Beginning(_history(origin, at), parts, platforms, newest=at)


def _history(origin: Run, newest: int) -> Iterator[dict[str, int | float]]:
    """Rows up to a generation, some at a time: all of a long run's do not fit into memory, and a driver at work cannot
    end its log while it is being read."""
    for first in range(0, newest + 1, ROWS_AT_ONCE):
        yield from reader.read_history(origin.folder, first, min(ROWS_AT_ONCE, newest + 1 - first))


def _without_fitness(parts: Parts) -> dict[str, Arrays]:
    """The parts of a state in which no fitness seen so far counts: no best centre, an empty map, no record to beat."""
    kept = {name: dict(part) for name, part in parts.items() if not name.startswith((CELL_PREFIX, ELITE_PREFIX))}
    for name, part in kept.items():
        if name.startswith(CENTRE_PREFIX):
            part["cell"] = np.asarray(NO_CELL, np.int64)
    kept[BEST]["fitness"] = np.asarray(-np.inf)
    kept[WEIGHT] = weight_to_arrays(FitnessWeight(weight_from_arrays(parts[WEIGHT]).value))
    return kept


def _without_scores(parts: Parts) -> dict[str, Arrays]:
    """The parts of a state in which no elite has a score: the luckiest of a population of another size, or whose
    fitness came about otherwise, is none to compare with."""
    nothing = {"score": np.asarray(np.nan)}
    return {name: {**part, **nothing} if name.startswith(CELL_PREFIX) else dict(part) for name, part in parts.items()}


def _without_own_statistics(parts: Mapping[str, Part]) -> dict[str, Part]:
    """The parts of a state whose centres run with the whole run's observation statistics, also those in a block that
    began with an elite's."""
    own = ("own_mean_O", "own_std_O")
    return {name: {key: values for key, values in part.items() if key not in own} for name, part in parts.items()}


def started(config: RunConfig, init_from: str, tell: Callable[[str], None]) -> tuple[dict[str, Any], Beginning]:
    """What a run that starts from a policy of another run records of that, and begins with: from its newest centre, its
    best one, or the elite of a cell, with the statistics that it runs with.

    Args:
        init_from: RUN, RUN:best or RUN:3,17.
        tell: called with a notice where the policy will see other observations than it did.

    Raises:
        ConfigError: the policy is of another network. NotInRunError: there is no such cell, or nothing in it.
    """
    folder, which = start_of(init_from)
    origin, shape = open_run(folder), policy_shape(config, task_of(config))
    if origin.policy_shape != shape:
        raise ConfigError(
            f"search.init_from: the policy of {origin.folder} has layers {list(origin.policy_shape.widths)}, "
            f"this run's has {list(shape.widths)}; use the same task and policy.hidden",
            field="search.init_from",
            value=init_from,
            run=origin.folder,
        )
    moment = origin.at(wanted=is_no_elite)
    moments, own = moments_from_arrays(moment.parts[OBSERVATIONS]), None
    if which == "centre":
        centre = moment.newest_centre
        centre_D = centre.centre_D
        if centre.own_mean_O is not None and centre.own_std_O is not None:
            own = centre.own_mean_O, centre.own_std_O
    else:
        kept = moment.best if isinstance(which, str) else origin.elite(which)
        centre_D, own = kept.centre_D, (kept.observation_mean_O, kept.observation_std_O)
    if not origin.constants[NORMALISED]:
        moments = no_observations(shape.widths[0])  # its policy was never given any, though they were gathered
    elif own is not None:
        # Those that its policy runs with, as if that many observations had given them.
        mean_O, std_O = (values.astype(np.float64) for values in own)
        moments = Moments(moments.count, mean_O, moments.count * np.square(std_O))
    if other := _seen_otherwise(origin, config):
        tell(
            f"search.init_from: the policy of {origin.folder} acted on other observations than this run gives it "
            f"({other}), so it may act otherwise from generation 0 on"
        )
    start = {"centre_D": centre_D, **moments_to_arrays(moments)}
    return _lineage(origin, moment.generation), Beginning(start=start)


def _seen_otherwise(origin: Run, config: RunConfig) -> str:
    """Which settings make the origin's policy another one; empty if none. Normalisation that begins does not: it begins
    with no statistics."""
    new = config.constants()
    changed = [name for name in OBSERVED if origin.constants[name] != new[name]]
    if new[NORMALISED] and NORMALISED in changed:
        changed.remove(NORMALISED)
    return ", ".join(f"{name}: {show(origin.constants[name])} -> {show(new[name])}" for name in changed)


def _lineage(origin: Run, generation: int) -> dict[str, Any]:
    """Which run, and which state of it; no digest of a state that a driver at work has meanwhile replaced."""
    return {
        "run_id": origin.run_id,
        "folder": str(origin.folder.absolute()),
        "generation": generation,
        "digest": digest_at(origin.folder, generation),
    }
