"""Elites that are measured again: what methods with `search.elites` share. `maps/kept.py` has the container.

Each generation draws kept policies by their ranks and asks for them beside what is new. What was drawn is taken out
and, with its new sample, put back where all of its samples say, so that luck falls, moves to another cell or leaves. A
policy whose new sample is invalid leaves. A sample is the mean of `search.evaluation_episodes` episodes; the resets of
the samples of a policy are all different.

Of Extract-ME's released code, two details differ: it measures at most 2,048 policies again, which is less than a
quarter of the batch from 8,192 on; and its linear weights count from the depth, not from the deepest rank that there
is.

The kept policies are part of the search's own state: their values and names and, where the estimate is the median,
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
from es_service.protocol.content import NAME
from es_service.protocol.noise import Domain, stream_keys, uniforms
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
from es_service.search.arrays import read_only
from es_service.search.maps.behaviour_map import EMPTY
from es_service.search.maps.geometry import tessellation
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

AGAIN_CHOICE, PLACE_CHOICE, LAYER_CHOICE = 6, 7, 8
"""Last ids of the random streams of Domain.SELECTION: for the policies that are measured again, for the residents that
new ones replace, and for the parents among the policies of a cell."""
KEPT, SAMPLES = "kept", "samples"
"""Names of the search's own values: the arrays of `KeptPolicies`; and if the estimate is the median, the newest samples
of all of them, one policy after another: `fitness` and `descriptor_B`, whose first axis they share."""
FITNESS, DESCRIPTORS = "fitness", "descriptor_B"
Samples = tuple[NDArray[np.float64], NDArray[np.float64]]
"""The newest samples of a policy: fitness [S] and descriptors [S, B]."""
MOST_SAMPLES = 500
"""Samples of a policy of which the median is taken, the newest. Source: the code of Extract-QD."""
NONE = np.zeros(0, np.int64)


def extra_of(config: RunConfig, settings: Measured) -> dict[str, Any]:
    """`Algorithm.extra` of a search that keeps policies."""
    dimensions = len(config.map.bounds)
    extra: dict[str, Any] = {KEPT: kept_to_arrays(empty_kept(dimensions))}
    return extra | ({SAMPLES: _in_one([], dimensions)} if settings.estimate == "median" else {})


def kept_of(state: SearchState) -> KeptPolicies:
    kept = kept_from_arrays(state.extra[KEPT])
    return kept if state.map is not None and state.map.size else at_rows(kept, NONE)


def without_scores(state: SearchState) -> SearchState:
    """The state in which no elite has a score, and no kept policy, as after a fork whose populations are others."""
    if state.map is None:
        return state
    extra = state.extra
    if KEPT in extra:
        unknown = np.full(extra[KEPT]["score_K"].shape, np.nan)
        extra = read_only({**extra, KEPT: {**extra[KEPT], "score_K": unknown}})
    return replace(state, map=replace(state.map, score_N=np.full(state.map.size, np.nan)), extra=extra)


def drawn_rows(config: RunConfig, settings: Measured, kept: KeptPolicies, generation: int, episodes: int) -> NDArray:
    """Indices of the kept policies that a generation measures again.

    Args:
        episodes: samples that a generation has for this, unless it measures all.
    """
    count = kept.size if settings.again == "all" else episodes
    key = stream_keys(config.seed, Domain.SELECTION, generation, AGAIN_CHOICE)
    return drawn_again(kept, count, settings.draw, uniforms(key, np.arange(kept.size, dtype=np.uint32)))


def asked_again(kept: KeptPolicies, rows: NDArray[np.int64]) -> tuple[PolicyAsk, ...]:
    """The ask for the policies of some rows; nothing for none."""
    return (PolicyAsk(kept.policy_K[rows]),) if rows.size else ()


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
    if told.names is None:
        raise TypeError("elites that are measured again need the evaluations as the loop tells them, with `names`")
    kept, extra = kept_of(state), dict(state.extra)
    samples = _by_serial(kept, extra[SAMPLES]) if SAMPLES in extra else None
    is_valid_R = told.valid_N[again_R]
    kept = _with_new_samples(kept, told, rows_R[is_valid_R], again_R[is_valid_R], samples)
    comes_K = np.zeros(kept.size, bool)
    comes_K[rows_R[is_valid_R]] = True
    cells = tessellation(state.map.geometry)
    comes_K &= cells.cells_of(kept.descriptor_K_B) != kept.cell_K
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
    kept = put(resident, coming, cells, settings.depth, how, uniform_K)
    entered = np.flatnonzero(np.isin(new.serial_K, kept.serial_K))
    at_new = np.isin(kept.serial_K, new.serial_K)
    first_N = new_N_S[np.searchsorted(new.serial_K, kept.serial_K[at_new]), 0]
    for column, named in zip((kept.policy_K, kept.trace_K), told.names(first_N.tolist()), strict=True):
        column[at_new] = named  # `put` has made these arrays
    extra[KEPT] = kept_to_arrays(kept)
    if samples is not None:
        for n in entered.tolist():
            rows_S = new_N_S[n]
            samples[int(new.serial_K[n])] = _samples(told.fitness_N[rows_S], told.descriptor_N_B[rows_S])
        extra[SAMPLES] = _in_one([samples[serial] for serial in kept.serial_K.tolist()], kept.descriptor_K_B.shape[1])
    return replace(state, map=top_layer(kept, state.map), extra=read_only(extra))


def _with_new_samples(
    kept: KeptPolicies,
    told: CentreEvaluations,
    rows_R: NDArray[np.int64],
    again_R: NDArray[np.int64],
    samples: dict[int, Samples] | None,
) -> KeptPolicies:
    """The policies with one new valid sample for some of them; `samples`, if there are any, get these, too."""
    fitness_R, descriptor_R_B = told.fitness_N[again_R], told.descriptor_N_B[again_R]
    if samples is None:
        return with_means(kept, rows_R, fitness_R, descriptor_R_B)
    for row, fitness, descriptor_B in zip(rows_R.tolist(), fitness_R, descriptor_R_B, strict=True):
        serial = int(kept.serial_K[row])
        before = samples[serial]
        samples[serial] = _samples(np.append(before[0], fitness), np.concatenate([before[1], descriptor_B[None]]))
    newest = [samples[int(serial)] for serial in kept.serial_K[rows_R]]
    median_R = np.array([np.median(fitness_S) for fitness_S, _ in newest])
    median_R_B = np.array([np.median(descriptor_S_B, axis=0) for _, descriptor_S_B in newest])
    return with_values(kept, rows_R, median_R, median_R_B.reshape(descriptor_R_B.shape))


def _samples(fitness_S: NDArray[np.float64], descriptor_S_B: NDArray[np.float64]) -> Samples:
    return fitness_S[-MOST_SAMPLES:], descriptor_S_B[-MOST_SAMPLES:]


def _by_serial(kept: KeptPolicies, arrays: Mapping[str, NDArray[np.float64]]) -> dict[int, Samples]:
    """The newest samples of each kept policy, by its number; inverse of `_in_one`."""
    ends = np.cumsum(np.minimum(kept.samples_K, MOST_SAMPLES))[:-1]
    fitness, descriptors = (np.split(arrays[name], ends) for name in (FITNESS, DESCRIPTORS))
    return dict(zip(kept.serial_K.tolist(), zip(fitness, descriptors, strict=True), strict=False))


def _in_one(samples: Sequence[Samples], dimensions: int) -> dict[str, NDArray[np.float64]]:
    fitness, descriptors = zip(*samples, strict=True) if samples else ((), ())
    return {
        FITNESS: np.concatenate([np.zeros(0), *fitness]),
        DESCRIPTORS: np.concatenate([np.zeros((0, dimensions)), *descriptors]),
    }


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
        np.zeros(count, NAME),
        np.zeros(count, NAME),
    )


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
        return (*algorithm.ask(state, generation), *asked_again(kept, rows))

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
    return replace(state, extra=read_only({**state.extra, KEPT: arrays}))


# Searches whose newcomers are measured several times


def shares(settings: MeasuredNewcomers, batch: int, kept: int) -> tuple[int, int]:
    """(new policies, policies measured again) of a generation with `batch` samples, of which at least those of one new
    policy are left; all kept ones are measured besides."""
    if settings.again == "all":
        return max(1, batch // settings.first_samples), kept
    again = min(kept, round(settings.again * batch))
    return max(1, (batch - again) // settings.first_samples), again
