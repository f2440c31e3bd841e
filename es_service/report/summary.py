"""A run in words and numbers: what was run, with which settings, what came of it, and which faults it survived."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from es_service.config.keys import search_fields
from es_service.config.loading import Known, read
from es_service.config.model import flat, nested
from es_service.config.search import SearchConfig
from es_service.config.tasks import ROLLOUTS
from es_service.config.text import in_line
from es_service.errors import counted
from es_service.protocol.machine import CODE, code_text
from es_service.protocol.messages import TaskSpec
from es_service.protocol.sources import in_words, is_hash
from es_service.report.data import RunData
from es_service.report.series import phase_seconds
from es_service.runs.certified import Certified, failed_sentence, measure_of, pairs_sentence, tries_sentence
from es_service.runs.checked_config import code_changes
from es_service.runs.run_status import invalid_members, objectives, population_size, state, weights
from es_service.runs.selection import RankedBy
from es_service.search.algorithms import known_settings
from es_service.search.maps.behaviour_map import projected


class Fault(NamedTuple):
    """A generation in which workers were lost or chunks sent again."""

    generation: int
    lost_workers: int
    retries: int


def verdict(data: RunData) -> str:
    """What came of the run, in one or two sentences."""
    if data.best is None or not data.history["generation"].size:
        return "No generation is finished yet, so there is nothing to show."
    generation, fitness = data.best
    where = "before any update" if generation == 0 else f"in generation {generation:,}"
    if fitness == -np.inf:
        return "The best centre is not known yet: with the settings of this fork, no centre has been evaluated."
    # A run of generation 0 alone has evaluated random weights and has not searched.
    alone = "" if data.last("generation") else "Only the initial centres were evaluated so far. "
    episodes = data.constants["search.evaluation_episodes"]
    clause = f"The best {data.evaluated[0]}, found {where}, has a mean fitness of {number(fitness)}"
    sentence = f"{alone}{clause} over {counted(episodes, 'evaluation episode')} (selected, not certified)"
    target = data.status.limits.get("target_fitness")
    if target is not None:
        reached = "reaches" if fitness >= target else "does not reach"
        sentence += f", which {reached} the target of {number(target)}"
    if "goal_distance_min" in data.history and np.isfinite(data.history["goal_distance_min"]).any():
        least = float(np.nanmin(data.history["goal_distance_min"]))
        sentence += f"; the nearest that an evaluated episode came to the goal is {number(least)}"
    if data.map is not None:
        map_ = projected(data.map)
        whose = "" if map_ is data.map else "the grid of "
        cells, size = map_.size, map_.geometry.size
        sentence += f"; {cells:,} of {size:,} cells of {whose}the behaviour map are filled ({100 * cells / size:.1f} %)"
    return f"{_certified(data)}{_elsewhere(data)}{sentence}."


def _elsewhere(data: RunData) -> str:
    """The values of certified policies in other tasks, a sentence for each that others follow."""
    measure = measure_of(data.constants["task.fitness"])
    return "".join(
        f"In {task}, the certified policy {policy.title} has a mean {measure.replace('_', ' ')} of "
        f"{elsewhere_text(policy, measure)}. "
        for task, policy in data.certified_elsewhere.items()
    )


def elsewhere_text(policy: Certified, measure: RankedBy) -> str:
    """The value of a certified policy in another task, and its gap to that in the run's task, in words."""
    row = policy.row()
    value, gap = (
        "{} ({} to {})".format(*(number(row[f"{prefix}_{measure}_{end}"]) for end in ("mean", "low", "high")))
        for prefix in ("elsewhere", "gap")
    )
    episodes, starts = counted(row["elsewhere_episodes"], "episode"), pairs_sentence(paired=row["elsewhere_paired"])
    return f"{value} in {episodes}, a gap of {gap} to the run's task, {starts}"


def _certified(data: RunData) -> str:
    """The value of the certified policy, as a sentence that others follow; empty if there is none."""
    if data.certified is None:
        return ""
    row, measure = data.certified.row(), measure_of(data.constants["task.fitness"])
    what = measure.replace("_", " ")
    value = "{} ({} to {})".format(*(number(row[f"{measure}_{end}"]) for end in ("mean", "low", "high")))
    success = "" if row["successes"] is None else f" and succeeds in {row['successes']:,} of them"
    tries = f" It passed in {tries_sentence(row['tries'])}." if row["tries"] else ""
    return (
        f"The certified policy, {data.certified.title}, has a mean {what} of {value} in "
        f"{counted(row['episodes'], 'episode')} that no choice has seen{success}.{tries} "
    )


def what_was_run(data: RunData) -> list[tuple[str, str]]:
    """Task, search, state and budget, as (label, text)."""
    constants, limits = data.constants, data.status.limits
    fields = [
        ("task", f"{constants['task.environment']}, {counted(constants['task.episode_steps'], 'step')} an episode"),
        ("search", f"{constants['search.algorithm']}, {population_size(constants)}, seed {constants['seed']}"),
        ("state", state(data.status)),
    ]
    if data.history["generation"].size:
        of = {key: f" of {limit:,.0f}" for key, limit in limits.items()}
        fields += [
            ("generations", f"{data.last('generation'):,.0f}{of.get('generations', '')}"),
            (
                "environment steps",
                f"{data.last('env_steps'):,.0f}{of.get('env_steps', '')} in {data.last('episodes'):,.0f} episodes",
            ),
            *_objectives(data),
            *_invalid(data),
            *_target(data),
            ("time", f"{duration(data.last('wall_clock_s'))} on {counted(int(data.last('workers')), 'worker')}"),
        ]
    if data.meta.parent:
        parent = data.meta.parent
        fields.append(("started from", f"{parent['folder']}, generation {parent['generation']}"))
    return fields


def _objectives(data: RunData) -> list[tuple[str, str]]:
    """How many centres have explored, as (label, text), where each either explores or exploits."""
    counts = objectives(weights(data.centres)[1])
    if not counts.are_separate:
        return []
    exploring, exploiting = (f"{100 * part / counts.centres:.1f} %" for part in (counts.exploring, counts.exploiting))
    return [("centres", f"{exploring} of {counts.centres:,} explored, {exploiting} exploited")]


def _invalid(data: RunData) -> list[tuple[str, str]]:
    """How many members of the newest generations were invalid, as (label, text), if any was."""
    is_newest_N = data.centres["generation"] == data.last("generation")
    moved = int(np.isfinite(data.centres["update_norm"][is_newest_N]).sum())
    invalid = invalid_members(data.constants, data.history["invalid_members"].tolist(), moved, int(is_newest_N.sum()))
    return [("invalid members", invalid)] if invalid else []


def _target(data: RunData) -> list[tuple[str, str]]:
    """The certified target with the tries that did not reach it, as (label, text), if there is one."""
    target = data.status.target_certified
    if target is None:
        return []
    return [("certified target", "; ".join(filter(None, [f"{target:g}", failed_sentence(data.status.tries)])))]


def provenance(data: RunData) -> list[tuple[str, str]]:
    """Versions, machine, digest and identity, as (label, text)."""
    fields, before = [], {}
    for at, platform in data.platforms:
        since = f" since generation {at:,}" if len(data.platforms) > 1 else ""
        fields += [
            (f"machine{since}", str(platform.get("cpu", "?"))),
            (f"versions{since}", _versions(platform)),
        ]
        for other in platform.get("workers", ()):
            fields.append((f"workers{since}", f"{other.get('cpu', '?')}; {_versions(other)}"))
        if CODE in platform:
            changed = code_changes(before, platform)
            fields.append(
                (f"code{since}", code_text(platform[CODE]) + (f"; {in_words(changed)} changed" if changed else ""))
            )
        before = platform
    digest = data.digest or ("not computed while a driver is writing" if data.status.driver else "not available")
    return [
        *fields,
        ("digest", f"{digest}{', mixed: computed on several platforms' if data.mixed else ''}"),
        ("run", data.meta.run_id),
        ("created", data.meta.created),
        ("folder", str(data.folder)),
    ]


def faults(data: RunData) -> list[Fault]:
    """Generations with lost workers or repeated chunks, in order."""
    lost_G, retries_G = np.nan_to_num(data.history["lost_workers"]), np.nan_to_num(data.history["retries"])
    return [
        Fault(int(data.history["generation"][row]), int(lost_G[row]), int(retries_G[row]))
        for row in np.flatnonzero((lost_G > 0) | (retries_G > 0))
    ]


def fault_sentence(faults: list[Fault]) -> str:
    if not faults:
        return "No worker was lost and no chunk had to be sent again."
    lost, retries = sum(fault.lost_workers for fault in faults), sum(fault.retries for fault in faults)
    were, sent = ("was" if total == 1 else "were" for total in (lost, retries))
    return (
        f"{counted(lost, 'worker')} {were} lost and replaced, and {counted(retries, 'chunk')} {sent} sent again, in "
        f"{counted(len(faults), 'generation')}. No result depends on it."
    )


def time_sentence(data: RunData) -> str:
    seconds = phase_seconds(data.history)
    total = sum(seconds.values())
    if not total:
        return "No time was recorded."
    shares = ", ".join(f"{label} {100 * value / total:.1f} %" for label, value in seconds.items())
    rate = data.last("env_steps") / data.last("wall_clock_s") if data.last("wall_clock_s") else math.nan
    return f"Of {duration(total)}: {shares}. Overall {rate:,.0f} environment steps a second."


def number(value: float) -> str:
    """A number with three digits or more, such as -24.31, 68,959 or 1.30e-05."""
    if not math.isfinite(value):
        return "none" if math.isnan(value) else f"{value:g}"
    size = abs(value)
    if size >= 1000:
        return f"{value:,.0f}"
    if size and size < 1e-3:
        return f"{value:.2e}"
    return f"{value:.{1 if size >= 100 else 2 if size >= 1 else 3}f}"


def qd_score(value: float) -> str:
    """A QD-score in whole numbers, or as `number` if it is small."""
    return number(value) if 0.0 < abs(value) < 10.0 else f"{value:z,.0f}"


def duration(seconds: float) -> str:
    """A duration, such as 34.5 s, 12 min 3 s or 5 h 20 min."""
    if not math.isfinite(seconds):
        return "an unknown time"
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _versions(platform: Mapping[str, Any]) -> str:
    """Versions of Python, of its packages, and of the library that defines the task or the search."""
    code = platform.get(CODE, {}).items()
    libraries = {name: text for name, text in code if not is_hash(text)}  # in the place of hashes
    packages = {name: text for name, text in platform.items() if name not in ("cpu", "workers", CODE)}
    return ", ".join(f"{name} {text}" for name, text in (packages | libraries).items())


# The settings of a run that differ from the defaults of its task, its algorithm and its preset.

SHOWN_ELSEWHERE = ("task.environment", "search.algorithm", "seed", "budget.", "compute.workers", "compute.engine")
"""Keys, or beginnings of keys, that a report shows in any case."""
_NONE = object()
"""No default."""


class _Keys(NamedTuple):
    """A method of which only the keys are known."""

    settings: type[SearchConfig]


class Setting(NamedTuple):
    """A setting as text in YAML."""

    key: str
    value: str
    default: str
    """The default; empty if it is not known."""


def changed_settings(config: Mapping[str, Any], task: TaskSpec) -> list[Setting]:
    """Settings that would have another value if the config did not give them.

    A value that follows from others, such as `compute.chunk_pairs` from `search.pairs`, is its default. If the defaults
    cannot be found, because the config is of another version, all settings are returned.

    Args:
        config: resolved config of a run, as its store has it.
        task: the task as the run knows it, so that the task's package need not be installed.
    """
    values = flat(config)
    shown = {key: value for key, value in values.items() if not key.startswith(SHOWN_ELSEWHERE)}
    environment, algorithm = values["task.environment"], values["search.algorithm"]
    method = _Keys(known_settings(algorithm))
    is_unknown = {key: key.startswith("search.") and key not in search_fields(method.settings) for key in shown}
    known = {key: value for key, value in values.items() if ":" not in algorithm or not is_unknown.get(key)}
    reading = read(nested(known), {}, Known({environment: task}, {algorithm: method}, ROLLOUTS), new=False)
    changed = []
    for key, value in shown.items():
        others = {name: other for name, other in reading.values.given.items() if name != key}
        default = _NONE if reading.problems else reading.values.of(others).get(key, _NONE)
        if default is _NONE:
            if value is not None:
                changed.append(Setting(key, in_line(value), ""))
        elif _plain(default) != _plain(value) and not (key == "map.bounds" and default is None):  # which have none
            changed.append(Setting(key, in_line(value), in_line(default)))
    return changed


def _plain(value: Any) -> Any:
    """A value with lists in place of tuples, as JSON has it."""
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
