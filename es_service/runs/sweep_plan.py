"""Which runs a sweep has: one for each combination of settings and each seed, with its name, folder and config."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from es_service.config.given import Overrides, Source, parse_overrides
from es_service.config.keys import FIELDS, all_search_fields
from es_service.config.loading import read
from es_service.config.model import Kept, RunConfig
from es_service.config.text import in_line, one_of, plain, show
from es_service.errors import ConfigError, Problem, StoreError, counted
from es_service.runs.checked_config import KNOWN, accepted, changes_from
from es_service.runs.view import open_run
from es_service.search.algorithms import ALGORITHMS
from es_service.store.folder import holds_run

# How settings of compared runs are named in pages and figures.

ALGORITHM = "search.algorithm"


def settings_words(settings: Mapping[str, Any]) -> str:
    """Some settings in words: "sigma = 0.1, newest = no limit". The method has its name alone.

    A key has its section only if another one of these keys ends in the same name.
    """
    leaves = [key.rpartition(".")[2] for key in settings]
    words = []
    for leaf, (key, value) in zip(leaves, settings.items(), strict=True):
        text = _meaning_of_null(key) if value is None else in_line(value)
        name = leaf if leaves.count(leaf) == 1 else key
        words.append(text if key == ALGORITHM else f"{name} = {text}")
    return ", ".join(words)


@cache
def _meaning_of_null(key: str) -> str:
    """What the description of a key says of null; "none" if it says nothing short."""
    field = FIELDS.get(key) or all_search_fields(ALGORITHMS).get(key)
    found = re.search(r"\bnull`?: ([^,;]{1,40}?)(?:[,;]|\.(?=\s|$))", (field and field.description) or "")
    return found[1].replace("`", "") if found else "none"


SEED, ENVIRONMENT = "seed", "task.environment"
ValuesOfKeys = Mapping[str, Sequence[Any]]
"""Key of the config -> its values; a sweep has every combination of them."""
_MOST_CHARACTERS = 60
"""Longest part of a run's name that is made of one value, since the name of a folder has at most 255 characters."""


class Labelled(NamedTuple):
    """A config of a sweep of several, each of which is a group that is compared with the others."""

    label: str
    """Name of the group, which several configs may have: one for each task."""
    source: Source


@dataclass(frozen=True)
class PlannedRun:
    name: str
    """Its settings in the sweep, such as "sigma=0.05_seed=0"."""
    folder: Path
    overrides: Mapping[str, Any]
    """Every key of the config that the sweep sets."""
    config: RunConfig
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Keys that the sweep sets for other runs only -> the method, or kind of a part, of this run that lacks the key."""
    source: Source = ""
    """What its config was made from."""
    group: str = ""
    """Name of the runs with which it is compared as one group; empty if the sweep has no other."""


def left_out_notes(planned: Sequence[PlannedRun]) -> list[str]:
    """A sentence for each method, or kind of a part, that names the keys which the sweep leaves out for it."""
    keys: dict[str, dict[str, None]] = {}
    for run in planned:
        for key, lacks in run.left_out.items():
            keys.setdefault(lacks, {})[key] = None
    return [
        f"left out {', '.join(names)} with {lacks}, since that would have no effect" for lacks, names in keys.items()
    ]


def plan(
    source: Source | Sequence[Labelled],
    out: Path,
    grid: ValuesOfKeys = MappingProxyType({}),
    seeds: Iterable[int] | None = None,
    overrides: Overrides = (),
    *,
    here: bool = True,
) -> list[PlannedRun]:
    """The runs of a sweep, the seed changing fastest, then the last key of the grid.

    The name of a run depends only on its own settings, so a sweep with more values or seeds has the same runs and more.
    A key that only some of the methods (or kinds of a part) of the grid have is left out for the others, which have one
    run for all of its values.

    Args:
        source: a config, or several with labels; each of these has all runs of the grid and the seeds.
        out: folder in which each run has a folder.
        seeds: None: the seed of the config.
        overrides: settings of all runs.
        here: whether `out` is a folder on this machine; if not, nothing is looked for there.

    Raises:
        ConfigError: a config, the grid or the seeds are wrong (all problems are listed), or the folder of a run holds
            a run with other settings, or `out` is a run itself. So is a value of the config that only one of several
            methods (or kinds of a part) of the grid was given it for, where others have another default: `grid` or
            `overrides` must have its key.
    """
    if here and holds_run(out):
        raise ConfigError(f"{out} is the folder of a run; choose another folder for the sweep", field="out", run=out)
    common, problems = parse_overrides(overrides)
    by_seed = {} if seeds is None else {SEED: plain(list(seeds))}
    axes = {key: plain(list(values)) for key, values in grid.items()} | by_seed
    problems += _axis_problems(axes, SEED in grid, common)
    alone = isinstance(source, str | os.PathLike | Mapping)
    configs = [Labelled("", source)] if alone else list(source)
    which = ", ".join(_title(config.source) for config in configs)
    if problems:
        raise _refused(which, problems)
    combinations = [
        (at, dict(zip(axes, values, strict=True))) for at in range(len(configs)) for values in product(*axes.values())
    ]
    idle = [read(configs[at].source, {**common, **own}, KNOWN, new=False).idle for at, own in combinations]
    used = {
        key
        for (_, own), without in zip(combinations, idle, strict=True)
        for key in {**common, **own}
        if key not in without
    }
    runs: dict[tuple[int, str], _Settings] = {}  # by config and settings, since some may now be equal
    for (at, settings), without in zip(combinations, idle, strict=True):
        gone = {key: lacks for key, lacks in without.items() if key in used}
        own = {key: value for key, value in settings.items() if key not in gone}
        runs.setdefault((at, in_line(own)), _Settings(configs[at], own, gone))
    prefixes = _prefixes(configs)
    named = {prefixes[at] + _name(one.own): one for (at, _), one in runs.items()}
    if len(named) < len(runs):
        what = "two combinations of these values give folders with the same name; use a sweep for each"
        raise _refused(which, [Problem(f"{', '.join(axes)}: {what}")])
    compared = [key for key, values in axes.items() if len(values) > 1 and key not in (SEED, ENVIRONMENT)]
    planned: list[PlannedRun] = []
    wrong: dict[str, Problem] = {}  # by sentence, since most problems are those of several runs
    stays: dict[str, list[Kept]] = {}
    for name, (config, own, gone) in named.items():
        wanted = {key: value for key, value in common.items() if key not in gone} | own
        folder = out / name
        reading = read(config.source, wanted, KNOWN, new=here and not holds_run(folder))
        for key, value in reading.kept.items():
            if len(grid.get(value.replaced, ())) > 1:
                stays.setdefault(key, []).append(value)
        group = ", ".join(
            filter(None, [config.label, settings_words({key: own[key] for key in compared if key in own})])
        )
        try:
            planned.append(PlannedRun(name, folder, wanted, accepted(reading.config()), gone, config.source, group))
        except ConfigError as error:
            whole = Problem(error.sentence, error.field, error.value, error.allowed, error.suggestion)
            wrong |= {problem.sentence: problem for problem in error.problems or (whole,)}
    named_already = {problem.field for problem in wrong.values()}
    wrong |= {key: _kept_problem(key, values) for key, values in stays.items() if key not in named_already}
    if wrong:
        raise _refused(which, list(wrong.values()))
    for run in planned if here else ():
        _require_same_constants(run)
    return planned


class _Settings(NamedTuple):
    config: Labelled
    own: dict[str, Any]
    """The keys of the grid, and the seed."""
    gone: dict[str, str]
    """See `PlannedRun.left_out`."""


def _title(source: Source) -> str:
    return "config" if isinstance(source, Mapping) else str(source)


def _prefixes(configs: Sequence[Labelled]) -> list[str]:
    """What the names of the runs of each config begin with: its label, and the name of its file if several have the
    same label."""
    labels = [config.label for config in configs]
    texts = [
        f"{label}_{Path(_title(config.source)).stem}" if labels.count(label) > 1 else label
        for label, config in zip(labels, configs, strict=True)
    ]
    return [f"{_in_name(text)}_" if text else "" for text in texts]


def _refused(which: str, problems: Sequence[Problem]) -> ConfigError:
    return ConfigError.listing(f"{which}: {counted(len(problems), 'problem')}", problems)


def _axis_problems(axes: Mapping[str, Sequence[Any]], has_seed: bool, common: Mapping[str, Any]) -> list[Problem]:
    """Problems of the keys and numbers of values; values themselves are checked with the config that they are in."""
    problems = []
    if has_seed:
        problems.append(Problem("the grid cannot have the key seed; give the seeds separately, such as 0:5", SEED))
    for key, values in axes.items():
        if not values:
            problems.append(Problem(f"{key}: there is no value; give at least one", key))
        texts = [in_line(value) for value in values]
        twice = dict.fromkeys(text for text in texts if texts.count(text) > 1)
        problems += [Problem(f"{key}: {text} is there twice; give each value once", key, text) for text in twice]
        if key in common:
            what = f"it has values in the sweep, and {show(common[key])} for all runs; leave one out"
            problems.append(Problem(f"{key}: {what}", key, common[key]))
    return problems


def _kept_problem(key: str, kept: Sequence[Kept]) -> Problem:
    """The problem of a value of the config that other methods, or kinds of a part, would have in the place of their
    own defaults."""
    value, methods = kept[0].value, {}
    for one in kept:
        methods.setdefault(show(one.default), {})[one.by] = None
    defaults = one_of([f"{default} with {one_of(names, 'and')}" for default, names in methods.items()], "and")
    what = f"the config has {show(value)} for another {kept[0].replaced}, and the default is {defaults}"
    hint = f"set it for all runs of the sweep, such as {key}={in_line(value)}"
    return Problem(f"{key}: {what}; {hint}", key, value, suggestion=value)


def _name(settings: Mapping[str, Any]) -> str:
    """Name of a run: each key without its section, and its value."""
    return "_".join(f"{key.rpartition('.')[2]}={_in_name(value)}" for key, value in settings.items()) or "run"


def _in_name(value: Any) -> str:
    """A value as part of a folder's name, without characters that mean something to a shell, `scp` or a file system."""
    text = in_line(value).replace(", ", ",").strip("[]{}'\"")
    return re.sub(r"[^\w.,+-]+", "-", text)[:_MOST_CHARACTERS]


def _require_same_constants(run: PlannedRun) -> None:
    """Raise ConfigError if the folder holds a run with other constants than the planned one."""
    if not holds_run(run.folder):
        return
    try:
        there = open_run(run.folder).constants
    except StoreError:
        return  # it may be repaired when the run is resumed, which also compares the constants
    if changes := changes_from(there, run.config):
        problems = [
            Problem(f"{key}: {show(old)} -> {show(new)}", key, new, show(old), old) for key, old, new in changes
        ]
        raise ConfigError.listing(
            f"{run.folder} holds a run with other settings, which cannot be changed:",
            problems,
            "choose another folder for this sweep, or give the settings that the run has",
            run=run.folder,
        )
