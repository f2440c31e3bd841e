"""What a new run takes from another run: its state (a fork), one policy (`search.init_from`), or policies to polish."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from es_service.config.changes import START_KEYS, does_not_fit, start_afresh
from es_service.config.given import Overrides, parse_overrides, start_of
from es_service.config.model import RunConfig
from es_service.config.parts import TargetObjective
from es_service.config.search import CandidatesConfig
from es_service.config.tasks import task_of
from es_service.config.text import show
from es_service.config.workload import policy_spec
from es_service.errors import ConfigError, NotInRunError, Problem
from es_service.loop.blocks import ARCHIVE, BEST, CENTRES, MAP, OBSERVATIONS, names_of, state_of, stored, value_of
from es_service.loop.state import RunState, no_observations
from es_service.protocol.content import Policy
from es_service.protocol.episodes import METRICS
from es_service.protocol.messages import Moments
from es_service.runs.certification import TOP, certify_run, default_measure, different
from es_service.runs.certified import EPISODES, Certified, certified_policies
from es_service.runs.checked_config import changed_config, changes_from, load_config
from es_service.runs.evaluation import candidates
from es_service.runs.snapshot import Snapshot
from es_service.runs.view import Run, named_best, named_by_all, open_run
from es_service.search.algorithms import ALGORITHMS
from es_service.search.algorithms.base import NO_CELL, CentreState, FitnessWeight, SearchState
from es_service.search.algorithms.common import elite_novelty
from es_service.search.algorithms.measured import without_scores
from es_service.search.maps.behaviour_map import BehaviourMap, empty_map
from es_service.search.novelty import sound_archive
from es_service.search.steps import fresh_state
from es_service.store import reader
from es_service.store.create import SEVERAL, Beginning
from es_service.store.digest import digest_at
from es_service.store.records import CERTIFICATIONS

NORMALISED = "policy.observation_normalization"
OBSERVED = ("policy.observation_clip", NORMALISED)
"""Keys that determine how a policy processes its observations."""
SCORE_KEYS = ("task.episodes_per_member", "search.pairs", "search.sigma", "policy.action_noise")
"""Keys that change the highest fitness of a population, but not the meaning of an evaluation."""
RECORDED = ("task.metrics",)
"""Keys that change what is recorded of an episode, and no fitness, unless the search reads metrics."""
ROWS_AT_ONCE = 4096
"""History rows that are held in memory together."""


def fork_config(parent: str | os.PathLike[str], overrides: Overrides = ()) -> RunConfig:
    """The config of a fork: the parent's present config with overrides.

    Raises:
        ConfigError: as `load_config`, or the parent's state does not fit the changes, or a key would have no effect.
    """
    origin = open_run(parent)
    if not isinstance(overrides, str | Mapping):
        overrides = list(overrides)  # iterated twice
    wanted = parse_overrides(overrides)[0]
    searched = origin.constants["search.algorithm"]
    begins_anew = {"search.fitness_weight_start"} if wanted.get("search.algorithm", searched) != searched else set()
    if idle := [key for key in START_KEYS if key in wanted and key not in begins_anew]:
        raise _refused(
            origin,
            "a fork continues from its state and its settings, so these keys would have no effect",
            [Problem(key, key, wanted[key]) for key in idle],
            "instead of search.preset, set the keys that it fills in",
        )
    present = origin.present_config
    mapping = present | {"search": present["search"] | {"init_from": None}}  # a fork has the parent's state instead
    given = None if (given := origin.meta.given) is None else {**given, "search.init_from": None}
    config = changed_config(mapping, overrides, given=given, name=str(origin.config_file))
    changes = changes_from(origin.constants, config)
    problems = [
        _problem_of(name, old, new, name) for name, old, new in changes if does_not_fit(name, old, new, ALGORITHMS)
    ]
    names = task_of(config).descriptor_names
    if not problems and list(names) != origin.descriptor_names:  # a task of the user that was edited
        what = f"the descriptor of {config.task.environment}"
        problems = [_problem_of(what, origin.descriptor_names, list(names), "task.environment")]
    if not problems and origin.policy_spec != (spec := policy_spec(config, task_of(config))):
        old, new = list(origin.policy_spec.widths), list(spec.widths)
        problems = [_problem_of("the network's layers", old, new, "policy.hidden")]
    if problems:
        raise _refused(origin, "its state does not fit these changes", problems)
    return config


def _problem_of(what: str, old: Any, new: Any, field: str) -> Problem:
    return Problem(f"{what}: {show(old)} -> {show(new)}", field, new, show(old), old)


def _refused(origin: Run, why: str, problems: Sequence[Problem], note: str = "") -> ConfigError:
    """The error for a fork with settings that it cannot have. Way out: a new run from the origin's centre."""
    ways_out = [start_afresh(origin.folder)]
    return ConfigError.listing(f"{origin.folder}: {why}:", problems, note, run=origin.folder, ways_out=ways_out)


def forked(origin: Run, config: RunConfig, generation: int | None) -> tuple[dict[str, Any], Beginning]:
    """The parent record and the initial contents of a fork of `origin` at a generation; None for the newest.

    Raises:
        StoreError: the state of that generation is not kept.
    """
    snapshot = origin.at(generation, named=named_by_all)
    at, state = snapshot.generation, state_of(snapshot.nodes, snapshot.generation, 0.0)
    changed = {name for name, _, _ in changes_from(origin.constants, config)}
    harmless = {*SCORE_KEYS, *(() if METRICS in config.search.outputs() else RECORDED)}
    if any(name in OBSERVED or name.startswith("task.") for name in changed - harmless):
        state = _without_fitness(state)
    elif changed.intersection(SCORE_KEYS):
        # The highest fitness of a population is not comparable with that of a population of another size, or with
        # another noise in its fitness.
        state = replace(state, search=without_scores(state.search))
    search, algorithm = state.search, ALGORITHMS[config.search.algorithm](config)
    if "search.algorithm" in changed:
        search = replace(search, weight=FitnessWeight(algorithm.fitness_weight))
    if "search.step.kind" in changed:
        search = _with_centres(
            search, lambda centre: replace(centre, step=fresh_state(config.search, centre.centre_D.size))
        )
    if "search.parent_statistics" in changed and config.constants()["search.parent_statistics"] == "global":
        # Also in the middle of a block that began with the statistics of an elite.
        search = _with_centres(search, lambda centre: replace(centre, own_mean_O=None, own_std_O=None))
    # What only the changed settings need begins as in a new run.
    blocks = stored(replace(state, search=replace(search, extra={**algorithm.extra, **search.extra})))
    contents = {name: snapshot.contents[name] for name in names_of(blocks)}
    platforms = [(first, platform) for first, platform in reader.read_platforms(origin.folder) if first <= at]
    history, evaluations = (_in_pieces(read, origin, at) for read in (reader.read_history, reader.read_evaluations))
    metrics = reader.read_metrics(origin.folder, at)
    beginning = Beginning(history, blocks, contents, platforms, newest=at, metrics=metrics, evaluations=evaluations)
    return _lineage(origin, at), beginning


def _in_pieces(read: Callable[[Path, int, int], Sequence[Any]], origin: Run, newest: int) -> Iterator[Any]:
    """What `read` returns up to generation `newest`, in several transactions: a long history may not fit into memory,
    and a driver cannot shorten its write-ahead log while a transaction reads it."""
    for first in range(0, newest + 1, ROWS_AT_ONCE):
        yield from read(origin.folder, first, min(ROWS_AT_ONCE, newest + 1 - first))


def _without_fitness(state: RunState) -> RunState:
    """A state without any past fitness: no fitness of the best centre, an empty map, no record to beat."""
    search = _with_centres(state.search, lambda centre: replace(centre, cell=NO_CELL))
    map_ = search.map
    if map_ is not None:
        map_ = empty_map(map_.geometry, counts_samples=map_.samples_N is not None)
    search = replace(search, map=map_, weight=FitnessWeight(search.weight.value))
    return replace(state, search=search, best=replace(state.best, fitness=-math.inf))


def _with_centres(search: SearchState, change: Callable[[CentreState], CentreState]) -> SearchState:
    """The state with a function of each centre in its place."""
    return replace(search, centres=tuple(map(change, search.centres)))


def _arrays_of(moments: Moments) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in vars(moments).items()}


def started(config: RunConfig, init_from: str, tell: Callable[[str], None]) -> tuple[dict[str, Any], Beginning]:
    """The parent record and the initial contents of a run that starts from a policy of another run.

    Args:
        init_from: RUN for its newest centre, RUN:best for its best one, or RUN:3,17 for the elite of a cell; each with
            the observation statistics that it runs with.
        tell: called with a notice if the new run processes the policy's observations differently.

    Raises:
        ConfigError: the policy has another network. NotInRunError: the cell does not exist or is empty, or the run has
            no newest centre.
    """
    folder, which = start_of(init_from)
    origin, spec = open_run(folder), policy_spec(config, task_of(config))
    if origin.policy_spec != spec:
        mine, theirs = ({**vars(network), "widths": list(network.widths)} for network in (spec, origin.policy_spec))
        name = next(name for name in mine if mine[name] != theirs[name])
        word, key = ("layers", "hidden") if name == "widths" else (name, name)
        raise ConfigError(
            f"search.init_from: the policy of {origin.folder} has {word} {theirs[name]}, "
            f"this run's policy has {mine[name]}; use the same task and policy.{key}",
            field="search.init_from",
            value=init_from,
            run=origin.folder,
        )
    if isinstance(config.search, CandidatesConfig):
        return _several(origin, config, config.search, which, tell)
    snapshot = origin.at(wanted=[CENTRES, OBSERVATIONS, BEST], named=named_best)
    moments, own = value_of(Moments, snapshot.nodes, OBSERVATIONS), None
    if which == "centre":
        centre, _ = snapshot.require_newest_centre()
        centre_D = centre.centre_D
        if centre.own_mean_O is not None and centre.own_std_O is not None:
            own = centre.own_mean_O, centre.own_std_O
    else:
        policy = snapshot.policy("best") if isinstance(which, str) else origin.policy(which)
        centre_D, own = policy.parameters_D, (policy.observation_mean_O, policy.observation_std_O)
    if not origin.constants[NORMALISED]:
        moments = no_observations(spec.widths[0])  # they were gathered, but its policy did not use them
    elif own is not None:
        # The statistics that the policy runs with, weighted by the run's number of observations.
        mean_O, std_O = (values.astype(np.float64) for values in own)
        moments = Moments(moments.count, mean_O, moments.count * np.square(std_O))
    _tell_otherwise(origin, config, tell)
    start = {"centre_D": centre_D, **_arrays_of(moments)}
    return _lineage(origin, snapshot.generation), Beginning(start=start)


def _several(
    origin: Run, config: RunConfig, search: CandidatesConfig, which: object, tell: Callable[[str], None]
) -> tuple[dict[str, Any], Beginning]:
    """As `started`, for a search that starts from several policies: the best centre of another run, then elites."""
    if which != "centre":
        raise ConfigError(
            f"search.init_from: {search.init_from} names one policy, but {search.algorithm} chooses "
            f"{search.screened} of a run by itself; name the folder {origin.folder} alone",
            field="search.init_from",
            value=search.init_from,
            suggestion=str(origin.folder),
            run=origin.folder,
        )
    snapshot = origin.at(wanted=[BEST, MAP, ARCHIVE], named=named_by_all)
    policies: list[Policy] = [snapshot.policy("best")]
    if origin.constants["map.enabled"]:
        map_, elites = snapshot.elites()
        policies += [elites[int(map_.cell_N[row])] for row in _by_choice(snapshot, map_, config, search)]
    different: dict[bytes, Policy] = {}
    for policy in policies:  # the best centre is often an elite
        different.setdefault(policy.name, policy)
    chosen = list(different.values())[: search.screened]
    _tell_otherwise(origin, config, tell)
    start = {
        SEVERAL: np.stack([policy.parameters_D for policy in chosen]),
        "mean_K_O": np.stack([policy.observation_mean_O for policy in chosen]),
        "std_K_O": np.stack([policy.observation_std_O for policy in chosen]),
        **_arrays_of(no_observations(origin.policy_spec.widths[0])),
    }
    return _lineage(origin, snapshot.generation), Beginning(start=start)


def _by_choice(snapshot: Snapshot, map_: BehaviourMap, config: RunConfig, search: CandidatesConfig) -> list[int]:
    """Rows of the map in the order of `search.candidate_choice`, the older one of equal ones first."""
    if search.candidate_choice == "novelty":
        key_N = -elite_novelty(map_, sound_archive(snapshot.archive), config.novelty)
    elif search.candidate_choice == "place":
        middle = search.objective.descriptor if isinstance(search.objective, TargetObjective) else ()
        key_N = np.linalg.norm(map_.descriptor_N_B - np.asarray(middle), axis=1)
    else:
        key_N = -map_.fitness_N
    return np.argsort(key_N, kind="stable").tolist()


def _tell_otherwise(origin: Run, config: RunConfig, tell: Callable[[str], None]) -> None:
    """Tell of changed settings with which the origin's policy acts differently. Normalisation that is newly enabled is
    not among them: it starts without statistics."""
    old, new = origin.constants, config.constants()
    changed = [name for name in OBSERVED if old[name] != new[name] and not (name == NORMALISED and new[name])]
    if changed:
        other = ", ".join(f"{name}: {show(old[name])} -> {show(new[name])}" for name in changed)
        tell(
            f"search.init_from: this run processes observations differently from {origin.folder} ({other}), so the "
            "policy taken from there may act differently"
        )


def _lineage(origin: Run, generation: int) -> dict[str, Any]:
    """The parent record: a run and its generation, and the rollouts that have computed its generations so far. Its
    digest is None if a driver has replaced that state meanwhile."""
    earlier = (origin.meta.parent or {}).get("rollouts", ())
    return {
        "rollouts": sorted({*earlier, origin.constants["compute.rollout"]}),
        "run_id": origin.run_id,
        "folder": str(origin.folder.absolute()),
        "generation": generation,
        "digest": digest_at(origin.folder, generation),
        CERTIFICATIONS: reader.next_certification(origin.folder),
    }


# A run that polishes policies of another one: its config, and certified values before and after it.

LIMITS = ("generations", "env_steps", "wall_clock_s", "rollout_s", "cpu_s")
"""Limits of a budget that are reached in any case."""
METHOD = next(name for name, method in ALGORITHMS.items() if issubclass(method.settings, CandidatesConfig))
"""The method that starts from several policies of another run."""


def polish_config(parent: str | os.PathLike[str], overrides: Overrides = ()) -> RunConfig:
    """The config of a run that polishes policies of another one.

    It has the task, the policy and the map of that run, defaults for everything else, and unless `overrides` set a
    limit, the number of environment steps of that run as its budget.

    Args:
        parent: folder of the other run.
        overrides: changes, as for `load_config`.

    Raises:
        ConfigError: lists every problem found. NotInRunError: the run has no finished generation.
    """
    overrides = overrides if isinstance(overrides, str | Mapping) else tuple(overrides)
    run = open_run(parent)
    return load_config(polish_source(run, overrides), overrides, name=str(run.config_file))


def polish_source(run: Run, overrides: Overrides, share: int = 1) -> dict[str, Any]:
    """What `polish_config` loads, before the overrides.

    Args:
        share: number of runs that have the budget in equal shares.
    """
    if run.generation is None:
        raise NotInRunError(f"{run.folder} has no finished generation yet, and so no policies", run=run.folder)
    present = run.present_config
    sections = {name: present[name] for name in ("task", "policy", "map", "seed")}
    steps = int(run.history_rows(run.generation)[-1]["env_steps"])
    search = {"algorithm": METHOD, "init_from": str(run.folder)}
    is_limited = any(parse_overrides(overrides)[0].get(f"budget.{name}") is not None for name in LIMITS)
    return {**sections, "search": search, "budget": {} if is_limited else {"env_steps": -(-steps // share)}}


def certified_for(
    run: Run,
    config: RunConfig,
    on_notice: Callable[[str], None],
    on_output: Callable[[str], None] = lambda line: None,
    *,
    workers: int | None,
    centre: bool = False,
) -> list[Certified]:
    """Newest certified policies of a run as polishing compares them: with as many episodes as `certify_run` takes, of
    which none has decided that the run is over, and selected by the same measure before and after, from the run as it
    is now, among no fewer candidates than `certify_run` takes, or tried by the run itself. What is not certified so is
    certified now.

    Args:
        config: that of the run that polishes.
        centre: whether the newest centre is a candidate, too.

    Raises:
        RunLockedError: a driver writes to the run. Otherwise as `certify_run`.
    """
    by, steps = default_measure(config), int(run.history_rows(run.generation)[-1]["env_steps"])
    top = TOP if run.constants["map.enabled"] else 0
    least = len(different(candidates(run, best=True, centre=centre, cells=(), every=False, top=top)))
    certified = [
        one
        for one in certified_policies(run.folder)
        if (one.selected_by, one.env_steps) == (by, steps) and one.episodes.count >= EPISODES
        if one.tries or (one.candidates >= least and (one.candidates > 1 or one.name == "best"))
    ]
    if certified:
        newest = max(policy.number for policy in certified)
        return [policy for policy in certified if policy.number == newest]
    return certify_run(run.folder, centre=centre, by=by, workers=workers, on_notice=on_notice, on_output=on_output)
