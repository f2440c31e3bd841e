"""Elites that are measured again: what methods with `search.elites` share. `maps/kept.py` has the container.

Each generation draws kept policies by their ranks and asks for them beside what is new. What was drawn is taken out
and, with its new sample, put back where all of its samples say, so that luck falls, moves to another cell or leaves. A
policy whose new sample is invalid leaves. A sample is the mean of `search.evaluation_episodes` episodes; the resets of
the samples of a policy are all different.

The kept policies are part of the search's own state: their values, the policies and, where the estimate is the median,
their newest samples. If the map was emptied, as by a fork whose fitness means something else, nothing is kept.

Axes: K kept policies, N new policies, S samples of each, R policies that are measured again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.config.parts import Measured, MeasuredNewcomers
from es_service.config.search import PopulationConfig
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.protocol.recipes import unvaried
from es_service.search.algorithms.base import (
    NO_CELL,
    Algorithm,
    CentreEvaluation,
    CentreEvaluations,
    PolicyAsk,
    SearchState,
    in_columns,
)
from es_service.search.algorithms.common import add_to_archive, add_to_archive_and_map
from es_service.search.algorithms.settings import EmittersSettings, settings_of
from es_service.search.maps.behaviour_map import EMPTY, BehaviourMap, Elite, make_elite, rows_in
from es_service.search.maps.kept import (
    COLUMNS,
    KeptPolicies,
    at_rows,
    drawn_again,
    empty_kept,
    kept_from_arrays,
    kept_to_arrays,
    put,
    top_layer,
    with_means,
    with_values,
)
from es_service.search.state_parts import Arrays, ByCell, Whole, read_only

AGAIN_CHOICE, PLACE_CHOICE, LAYER_CHOICE = 6, 7, 8
"""Last ids of the random streams of Domain.SELECTION: for the policies that are measured again, for the residents that
new ones replace, and for the parents among the policies of a cell."""
KEPT, POLICIES, SAMPLES = "kept", "policies", "samples"
"""Names of the search's own values: those of `KeptPolicies`; and by the number of a policy the policy itself, and its
newest samples if the estimate is the median."""
MOST_SAMPLES = 500
"""Samples of a policy of which the median is taken, the newest. Source: the code of Extract-QD."""
NONE = np.zeros(0, np.int64)


def extra_of(config: RunConfig, settings: Measured) -> dict[str, Any]:
    """`Algorithm.extra` of a search that keeps policies."""
    extra: dict[str, Any] = {KEPT: Whole(kept_to_arrays(empty_kept(len(config.map.bounds)))), POLICIES: ByCell()}
    return extra | ({SAMPLES: ByCell()} if settings.estimate == "median" else {})


def kept_of(state: SearchState) -> KeptPolicies:
    """The values of the policies that a search keeps."""
    kept = kept_from_arrays(state.extra[KEPT].arrays)
    return kept if state.map is not None and state.map.size else at_rows(kept, NONE)


def parameters_of(state: SearchState, serials: Sequence[int]) -> list[NDArray[np.float32]]:
    """Parameters of kept policies, by their numbers."""
    entries = state.extra[POLICIES].entries
    return [entries[serial]["centre_D"] for serial in serials]


def drawn_rows(config: RunConfig, settings: Measured, kept: KeptPolicies, generation: int, episodes: int) -> NDArray:
    """Indices of the kept policies that a generation measures again.

    Args:
        episodes: samples that a generation has for this, unless it measures all.
    """
    count = kept.size if settings.again == "all" else episodes
    key = stream_keys(config.seed, Domain.SELECTION, generation, AGAIN_CHOICE)
    return drawn_again(kept, count, settings.draw, uniforms(key, np.arange(kept.size, dtype=np.uint32)))


def asked_again(state: SearchState, kept: KeptPolicies, rows: NDArray[np.int64]) -> tuple[PolicyAsk, ...]:
    """The ask for the policies of some rows; nothing for none.

    They are recipes without noise: workers that know a policy, as a parent of others perhaps, need not be sent it.
    """
    if not rows.size:
        return ()
    entries = state.extra[POLICIES].entries
    policies = [entries[serial] for serial in kept.serial_K[rows].tolist()]

    statistics = (
        np.stack([policy[name] for policy in policies]) for name in ("observation_mean_O", "observation_std_O")
    )
    return (PolicyAsk(unvaried([policy["centre_D"] for policy in policies]), *statistics),)


def told_of_samples(
    config: RunConfig,
    settings: Measured,
    state: SearchState,
    told: CentreEvaluations,
    new_N_S: NDArray[np.int64],
    rows_R: NDArray[np.int64] = NONE,
    again_R: NDArray[np.int64] = NONE,
) -> SearchState:
    """The state with new policies and new samples in its container, and with the map that follows.

    Args:
        told: the evaluations of a generation.
        new_N_S: indices in it of each new policy's samples.
        rows_R: indices on axis K of the policies that were measured again.
        again_R: indices in `told` of their samples.
    """
    assert state.map is not None, "a search that keeps policies has a map"
    kept, extra = kept_of(state), dict(state.extra)
    known = set(kept.serial_K.tolist())
    samples: dict[int, Arrays] | None = None
    if SAMPLES in extra:
        samples = {
            serial: policy_samples for serial, policy_samples in extra[SAMPLES].entries.items() if serial in known
        }
    is_valid_R = told.valid_N[again_R]
    kept = _with_new_samples(kept, told, rows_R[is_valid_R], again_R[is_valid_R], samples)
    comes_K = np.zeros(kept.size, bool)
    comes_K[rows_R[is_valid_R]] = True
    comes_K &= state.map.geometry.cells_of(kept.descriptor_K_B) != kept.cell_K
    stays_K = ~comes_K
    stays_K[rows_R[~is_valid_R]] = False
    new_N_S = new_N_S[told.valid_N[new_N_S].all(axis=1)]
    new = _newcomers(settings, told, new_N_S, 1 + kept.serial_K.max(initial=-1))
    moves = at_rows(kept, comes_K)
    coming = KeptPolicies(**{name: np.concatenate([getattr(moves, name), getattr(new, name)]) for name in COLUMNS})
    resident = at_rows(kept, stays_K)
    how = settings.replaces if isinstance(settings, MeasuredNewcomers) else "worst"
    key = stream_keys(config.seed, Domain.SELECTION, told.generation, PLACE_CHOICE)
    uniform_K = uniforms(key, np.arange(resident.size, dtype=np.uint32)) if how == "any" else None
    kept = put(resident, coming, state.map.geometry, settings.depth, how, uniform_K)
    entered = np.flatnonzero(np.isin(new.serial_K, kept.serial_K))
    extra[KEPT] = Whole(kept_to_arrays(kept))
    extra[POLICIES] = _policies(extra[POLICIES].entries, known, kept, new.serial_K[entered], told, new_N_S[entered, 0])
    if samples is not None:
        for n in entered.tolist():
            rows_S = new_N_S[n]
            samples[int(new.serial_K[n])] = _samples(told.fitness_N[rows_S], told.descriptor_N_B[rows_S])
        extra[SAMPLES] = ByCell({serial: samples[serial] for serial in kept.serial_K.tolist()})
    map_ = top_layer(kept, state.map)
    elites = _elites(map_, state.map, kept, extra[POLICIES], told.generation)
    return replace(state, map=map_, extra=read_only(extra), elites=elites)


def _with_new_samples(
    kept: KeptPolicies,
    told: CentreEvaluations,
    rows_R: NDArray[np.int64],
    again_R: NDArray[np.int64],
    samples: dict[int, Arrays] | None,
) -> KeptPolicies:
    """The policies with one new valid sample for some of them; `samples`, if there are any, get these, too."""
    fitness_R, descriptor_R_B = told.fitness_N[again_R], told.descriptor_N_B[again_R]
    if samples is None:
        return with_means(kept, rows_R, fitness_R, descriptor_R_B)
    for row, fitness, descriptor_B in zip(rows_R.tolist(), fitness_R, descriptor_R_B, strict=True):
        serial = int(kept.serial_K[row])
        before = samples[serial]
        samples[serial] = _samples(
            np.append(before["fitness_S"], fitness), np.concatenate([before["descriptor_S_B"], descriptor_B[None]])
        )
    newest = [samples[int(serial)] for serial in kept.serial_K[rows_R]]
    median_R = np.array([np.median(policy_samples["fitness_S"]) for policy_samples in newest])
    median_R_B = np.array([np.median(policy_samples["descriptor_S_B"], axis=0) for policy_samples in newest])
    return with_values(kept, rows_R, median_R, median_R_B.reshape(descriptor_R_B.shape))


def _samples(fitness_S: NDArray[np.float64], descriptor_S_B: NDArray[np.float64]) -> Arrays:
    return read_only(
        {"fitness_S": fitness_S[-MOST_SAMPLES:].copy(), "descriptor_S_B": descriptor_S_B[-MOST_SAMPLES:].copy()}
    )


def _newcomers(
    settings: Measured, told: CentreEvaluations, new_N_S: NDArray[np.int64], first_serial: int
) -> KeptPolicies:
    """New policies, whose samples are all valid. Their cells are not known yet."""
    estimate = np.median if settings.estimate == "median" else np.mean
    count, samples = new_N_S.shape
    return KeptPolicies(
        first_serial + np.arange(count),
        np.full(count, EMPTY),
        estimate(told.fitness_N[new_N_S], axis=1),
        estimate(told.descriptor_N_B[new_N_S], axis=1),
        np.full(count, samples),
        np.full(count, told.generation),
        told.centre_N[new_N_S[:, 0]].astype(np.int64),
        told.population_max_N[new_N_S[:, 0]],
    )


def _policies(
    before: Mapping[int, Arrays],
    known: set[int],
    kept: KeptPolicies,
    serials: NDArray[np.int64],
    told: CentreEvaluations,
    rows: NDArray[np.int64],
) -> ByCell:
    """The policies that are kept now.

    Args:
        before: those before, of which `known` count.
        serials: numbers of the new ones that are kept.
        rows: indices of their first samples in `told`.
    """
    if told.points is None or told.results is None or told.results.trace_T_B is None:
        raise TypeError("elites that are measured again need the evaluations as the loop tells them, with `points`")
    policies = {serial: before[serial] for serial in kept.serial_K.tolist() if serial in known}
    points = told.points(rows.tolist())
    for serial, row, point in zip(serials.tolist(), rows.tolist(), points, strict=True):
        policies[serial] = read_only(vars(make_elite(point, told.results.trace_T_B[row].copy())))
    return ByCell(policies)


def _elites(
    map_: BehaviourMap, before: BehaviourMap, kept: KeptPolicies, policies: ByCell, generation: int
) -> dict[int, Elite]:
    """By cell, the elites that are others than before and were not first evaluated in this generation: those that rose
    from below, or came from another cell."""
    is_same_N, row_N = rows_in(map_, before)
    for name in ("generation_N", "centre_N"):
        is_same_N = is_same_N & (getattr(map_, name) == np.append(getattr(before, name), EMPTY)[row_N])
    cells = map_.cell_N[~is_same_N & (map_.generation_N != generation)]
    top = at_rows(kept, kept.top_rows)
    serials = top.serial_K[np.searchsorted(top.cell_K, cells)]
    return {int(cell): Elite(**policies.entries[int(serial)]) for cell, serial in zip(cells, serials, strict=True)}


# Searches that move centres


def offering(config: RunConfig) -> Callable[[SearchState, Sequence[CentreEvaluation]], SearchState]:
    """What becomes of evaluated centres: they enter the novelty archive, and the map as `search.elites` says."""
    settings = settings_of(config, EmittersSettings).elites
    if not isinstance(settings, Measured):
        return add_to_archive_and_map
    elites: Measured = settings

    def offered(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        told = in_columns(evaluations)
        is_centre = told.centre_N < len(state.centres)
        rows = NONE
        if told.generation > 0:
            rows = drawn_rows(config, elites, kept_of(state), told.generation, _again(config, elites))
        new, again = np.flatnonzero(is_centre), np.flatnonzero(~is_centre)
        for row in new.tolist():
            state = add_to_archive(state, told[row])
        state = _scored(state, told, new)
        before = state.map
        state = told_of_samples(config, elites, state, told, new[:, None], rows, again)
        assert before is not None
        assert state.map is not None
        origins = [None if centre.cell == NO_CELL else before.row_of(centre.cell) for centre in state.centres]
        cells: list[int | None] = [
            None if row is None else state.map.cell_of(int(before.generation_N[row]), int(before.centre_N[row]))
            for row in origins
        ]
        for index in told.centre_N[new].tolist():
            cells[index] = state.map.cell_of(told.generation, index)
        centres = [
            replace(centre, cell=NO_CELL if cell is None else cell)
            for centre, cell in zip(state.centres, cells, strict=True)
        ]
        return replace(state, centres=tuple(centres))

    return offered


def measuring(config: RunConfig, algorithm: Algorithm) -> Algorithm:
    """A search whose `tell` uses `offering`, with the asks for what it measures again; itself if it does not."""
    settings = settings_of(config, EmittersSettings).elites
    if not isinstance(settings, Measured):
        return algorithm
    elites: Measured = settings

    def ask(state: SearchState, generation: int) -> tuple[Any, ...]:
        kept = kept_of(state)
        rows = drawn_rows(config, elites, kept, generation, _again(config, elites))
        return (*algorithm.ask(state, generation), *asked_again(state, kept, rows))

    return replace(algorithm, ask=ask, extra={**algorithm.extra, **extra_of(config, elites)}, counts_samples=True)


def _again(config: RunConfig, settings: Measured) -> int:
    """Policies that a generation with populations measures again, so that their episodes have the wanted share."""
    if settings.again == "all" or settings.again == 0.0:
        return 0
    search = settings_of(config, PopulationConfig)
    others = search.populations() * (2 * search.pairs * config.task.episodes_per_member + search.evaluation_episodes)
    return max(1, round(settings.again / (1.0 - settings.again) * others / search.evaluation_episodes))


def _scored(state: SearchState, told: CentreEvaluations, rows: NDArray[np.int64]) -> SearchState:
    """The state in which an elite around which a population was has its score: that population's highest fitness."""
    kept = kept_of(state)
    top = kept.top_rows
    score_K = kept.score_K.copy()
    for row in rows.tolist():
        cell, score = state.centres[int(told.centre_N[row])].cell, told.population_max_N[row]
        at = top[kept.cell_K[top] == cell]
        if cell != NO_CELL and np.isfinite(score) and at.size:
            score_K[at] = score
    arrays = {**kept_to_arrays(kept), "score_K": score_K}
    return replace(state, extra=read_only({**state.extra, KEPT: Whole(arrays)}))


# Searches whose newcomers are measured several times


def shares(settings: MeasuredNewcomers, batch: int, kept: int) -> tuple[int, int]:
    """(new policies, policies measured again) of a generation with `batch` samples, of which at least those of one new
    policy are left; all kept ones are measured besides."""
    if settings.again == "all":
        return max(1, batch // settings.first_samples), kept
    again = min(kept, round(settings.again * batch))
    return max(1, (batch - again) // settings.first_samples), again
