"""Steps that the search algorithms share; each algorithm's own file says which it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import NoveltyConfig, RunConfig, SearchConfig
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import (
    NO_CELL,
    NO_ENTRY,
    Algorithm,
    FitnessWeight,
    Judgement,
    Member,
    Plan,
    SearchState,
)
from es_service.search.maps.behaviour_map import BehaviourMap, insert, with_score
from es_service.search.novelty import empty_archive, extended, novelty
from es_service.search.optimizer import adam_ascent, fresh_adam
from es_service.search.shaping import centred_ranks, pair_weights

MEMBER_CHOICE = 0
"""Last id of the streams of Domain.SELECTION: which member to update."""

AdaptWeight = Callable[[FitnessWeight, Judgement], FitnessWeight]


def novelty_search(config: RunConfig, fitness_weight: float, adapt: AdaptWeight | None = None) -> Algorithm:
    """A member of the family of Conti et al. 2018: ES on (1 - w) * rank(novelty) + w * rank(fitness).

    Args:
        fitness_weight: w, at the start.
        adapt: how an evaluated centre (not an initial one) changes w; None if nothing does.
    """

    def plan(state: SearchState, generation: int) -> Plan:
        member = choose_member(state, generation, config)
        return Plan(member, state.members[member].centre_D, state.weight.value)

    def weights(state: SearchState, plan: Plan, population: EpisodesResult) -> NDArray[np.float32]:
        return pair_weights(mixed_utilities(state, plan.fitness_weight, population, config.novelty))

    def step(state: SearchState, plan: Plan, gradient_D: FloatArray) -> SearchState:
        return moved(state, plan, gradient_D, config.search)

    def absorb(state: SearchState, judgement: Judgement) -> SearchState:
        weight = state.weight
        if adapt is not None and judgement.generation > 0:
            weight = adapt(weight, judgement)
        return replace(mapped(archived(state, judgement), judgement), weight=weight)

    return Algorithm(plan, weights, step, absorb, fitness_weight)


def first_state(
    centres: Sequence[FloatArray], dimensions: int, fitness_weight: float, map_: BehaviourMap | None = None
) -> SearchState:
    """The state before any evaluation: initial centres, fresh optimisers, an empty archive, an empty map or none."""
    members = tuple(Member(centre_D, fresh_adam(centre_D.size)) for centre_D in centres)
    return SearchState(members, empty_archive(dimensions), FitnessWeight(fitness_weight), map_)


def choose_member(state: SearchState, generation: int, config: RunConfig) -> int:
    """Index of the member to update in a generation.

    novelty: with probability proportional to its novelty among all centres ever evaluated, judged now, a member none of
    whose centres was valid counting as the most novel one; uniform if all are 0. uniform: each with the same
    probability. round_robin: in turn, member 0 in generation 1.
    """
    count, how = len(state.members), config.search.member_choice
    if count == 1:
        return 0
    if how == "round_robin":
        return (generation - 1) % count
    share_M = np.ones(count)
    if how == "novelty":
        novelty_M = member_novelty(state, config.novelty)
        # Or it would be a centre fewer for good, for one bad episode at the start.
        novelty_M[[member.entry == NO_ENTRY for member in state.members]] = novelty_M.max()
        share_M = novelty_M if novelty_M.any() else share_M
    key = stream_keys(config.seed, Domain.SELECTION, generation, MEMBER_CHOICE)
    drawn = float(uniforms(key, np.zeros(1, np.uint32))[0])
    cumulative_M = np.add.accumulate(share_M)
    return int(np.searchsorted(cumulative_M, drawn * cumulative_M[-1], side="right"))


def member_novelty(state: SearchState, settings: NoveltyConfig) -> NDArray[np.float64]:
    """Novelty of each member's newest valid centre in the archive without that entry; 0 for a member without one."""
    novelty_M = np.zeros(len(state.members))
    entry_M = np.array([member.entry for member in state.members])
    known_M = np.flatnonzero(entry_M != NO_ENTRY)
    novelty_M[known_M] = novelty(
        state.archive,
        state.archive.descriptor_N_B[entry_M[known_M]],
        neighbours=settings.neighbours,
        distance=settings.distance,
        exclude_Q=entry_M[known_M],
    )
    return novelty_M


def mixed_utilities(
    state: SearchState, w: float, population: EpisodesResult, settings: NoveltyConfig
) -> NDArray[np.float64]:
    """(1 - w) * rank(novelty) + w * rank(fitness) per member of the population, axes [P, S].

    Ranks are taken per objective and then mixed, so that the scales of fitness and novelty do not matter. Novelty is
    judged in the archive as it was before the generation. An invalid member (fitness NaN) is last in both.
    """
    utility_P_S = np.zeros(population.fitness.shape)
    if w > 0.0:
        utility_P_S += w * centred_ranks(population.fitness)
    if w < 1.0:
        novelty_P_S = novelty(
            state.archive, population.descriptor, neighbours=settings.neighbours, distance=settings.distance
        )
        novelty_P_S[np.isnan(population.fitness)] = np.nan
        utility_P_S += (1.0 - w) * centred_ranks(novelty_P_S)
    return utility_P_S


def moved(state: SearchState, plan: Plan, gradient_D: FloatArray, search: SearchConfig) -> SearchState:
    """The state with the planned member one step up the gradient estimate, by its own Adam; the others untouched."""
    member = state.members[plan.member]
    adam, centre_D = adam_ascent(
        member.adam, member.centre_D, gradient_D, learning_rate=search.learning_rate, l2=search.l2
    )
    return _with_member(state, plan.member, replace(member, centre_D=centre_D, adam=adam))


def archived(state: SearchState, judgement: Judgement) -> SearchState:
    """The state with a valid centre in the archive, as the newest entry of its member."""
    if not judgement.valid:
        return state
    archive = extended(state.archive, judgement.descriptor_B, judgement.generation, judgement.member)
    member = replace(state.members[judgement.member], entry=archive.size - 1)
    return replace(_with_member(state, judgement.member, member), archive=archive)


def mapped(state: SearchState, judgement: Judgement) -> SearchState:
    """The state with a valid centre offered to the map; the member then knows of which cell it is the elite, if any.

    A member whose centre was an elite first hands that cell the score of the population it led.
    """
    member, map_ = state.members[judgement.member], state.map
    if map_ is None:
        return state
    if member.cell != NO_CELL and np.isfinite(judgement.population_max):
        map_ = with_score(map_, member.cell, judgement.member, judgement.population_max)
    cell = NO_CELL
    if judgement.valid:
        map_, offered, entered = insert(
            map_,
            judgement.descriptor_B,
            judgement.fitness,
            judgement.generation,
            judgement.member,
            judgement.population_max,
        )
        cell = offered if entered else NO_CELL
    return replace(_with_member(state, judgement.member, replace(member, cell=cell)), map=map_)


def _with_member(state: SearchState, index: int, member: Member) -> SearchState:
    return replace(state, members=(*state.members[:index], member, *state.members[index + 1 :]))
