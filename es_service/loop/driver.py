"""The main loop of a run. A generation is: propose, evaluate, update, record.

The loop is independent of Ray, JAX, files and any single method; everything that it works with is an argument. At any
time the store has the last finished generation, and the next one depends only on (config, seed, state). Generation 0
proposes the initial centres, without populations around them, so that it has no gradient and takes no step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import BudgetConfig
from es_service.config.search import PopulationConfig
from es_service.loop import budget as budgets
from es_service.loop.changes import changed_parts
from es_service.loop.checks import (
    invalidate,
    require_asks,
    require_finite,
    require_some_finite,
    require_state,
    require_weights,
)
from es_service.loop.clock import Clock
from es_service.loop.correction import Correction, correct
from es_service.loop.evaluated import (
    Evaluations,
    Proposal,
    Update,
    evaluated_table,
    in_ask_order,
    initial_centres,
    policies_asked,
    told_of,
)
from es_service.loop.generation import (
    better,
    entered,
    estimate_gradients,
    evaluate_centres,
    evaluate_populations,
    fittest,
    halves,
    initial_state,
    make_centre,
    tell,
)
from es_service.loop.history import (
    HistoryRow,
    evaluation_columns,
    fault_columns,
    map_columns,
    norm,
    or_none,
    population_columns,
    search_columns,
)
from es_service.loop.interfaces import Search, Stop, Store, Stored
from es_service.loop.parts import ELITE_PREFIX, elite_from_arrays, elite_part, state_from_parts
from es_service.loop.policies import as_population
from es_service.loop.state import RunState
from es_service.protocol.evaluator import DispatchCounts, Evaluator
from es_service.protocol.messages import Centre, EpisodesResult, FloatArray, TaskSpec
from es_service.search.algorithms.base import Ask, SearchState
from es_service.search.maps.behaviour_map import EMPTY, Elite
from es_service.search.maps.geometry import reachable_cells
from es_service.search.novelty import novelty
from es_service.search.observation_statistics import merge_moments

Reachable = NDArray[np.bool_] | None
"""Whether each cell of the map can be reached, [cells]; None if this is unknown."""


def run(
    search: Search,
    evaluator: Evaluator,
    store: Store,
    state: RunState | None,
    report: Callable[[HistoryRow], object],
    failed: Callable[[Sequence[str]], object] = lambda failures: None,
) -> tuple[RunState, str]:
    """Run generations until the budget is spent or `report` returns a `Stop`.

    Args:
        state: the newest state in `store`, from which to continue; None to begin a run, with an empty store.
        report: called with each history row after it has been committed. A `Stop` that it returns ends the session, and
            any other value has no effect.
        failed: called before that with texts that name the generation's failed episodes, if there are any of which
            the rollouts know more.

    Returns:
        The last state and the reason for ending, in words.

    Raises:
        EvaluationError, StoreError: the run cannot continue; nothing committed is lost.
        Interrupted: a signal asked the run to stop.
    """
    clock = Clock(state.wall_clock_s if state is not None else 0.0)
    state, answer = state or initial_state(search), None
    reachable = None if state.search.map is None else reachable_cells(state.search.map.geometry, search.task)
    while (reason := answer.reason if isinstance(answer, Stop) else spent(search.config.budget, state)) is None:
        state, row = _generation(search, evaluator, store, clock, state, reachable, failed)
        answer = report(row)
    return state, reason


def stored_state(store: Stored, task: TaskSpec) -> RunState | None:
    """The newest state in the store, without the elites' policies; None before the first generation."""
    if store.generation is None:
        return None
    seconds = float((store.last_history() or {}).get("wall_clock_s") or 0.0)
    parts = store.load(without=ELITE_PREFIX)
    return state_from_parts(parts, store.generation, seconds, len(task.descriptor_names))


def spent(budget: BudgetConfig, state: RunState) -> str | None:
    """Why the run is over, or None if it is not."""
    reached = {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "wall_clock_s": state.wall_clock_s,
        "best_fitness": state.best.fitness,
    }
    return next(iter(budgets.spent(budgets.limits_of(budget), reached).values()), None)


def _generation(
    search: Search,
    evaluator: Evaluator,
    store: Store,
    clock: Clock,
    state: RunState,
    reachable: Reachable,
    failed: Callable[[Sequence[str]], object],
) -> tuple[RunState, HistoryRow]:
    """One generation: a pure function of (search, state, elites in the store) but for its timings.

    It may ask for several populations, and for policies. Each step computes all of them side by side; results are taken
    in ask order.
    """
    since = evaluator.counts if state.generation >= 0 else DispatchCounts()
    proposal = propose(search, store, state)
    clock.lap("seconds_driver")
    evaluations = evaluate(search, evaluator, proposal, clock)
    updated = update(search, evaluator, proposal, evaluations, clock)
    clock.lap("seconds_driver")
    correction = correct(search, evaluator, store, state, updated)
    clock.lap("seconds_evaluation")
    faults = fault_columns(evaluator.counts, since=since)
    results = [*evaluations.members, updated.evaluated.evaluation]  # policies are in both
    if failures := list(dict.fromkeys(text for one in results for text in one.failures)):
        failed(failures)
    return record(search, store, state, proposal, evaluations, updated, correction, reachable, faults, clock)


def propose(search: Search, store: Store, state: RunState) -> Proposal:
    """What the next generation evaluates: centres restart from elites, and the search asks."""
    config, algorithm, generation = search.config, search.algorithm, state.generation + 1
    begun = state.search
    if generation == 0:
        points = [make_centre(config, 0, one.centre_D, state.observations, one) for one in begun.centres]
        return Proposal(0, begun, {}, (), points, ())
    start_cells = algorithm.start_cells(begun, generation)
    for index, cell in start_cells.items():
        begun = algorithm.restart(begun, index, cell, _elite(store, cell))
    parents = {cell: _elite(store, cell) for cell in algorithm.parents(begun, generation)}
    asked = algorithm.ask(replace(begun, elites=parents), generation)
    require_asks(asked, begun, config.compute.chunk_pairs, search.task.observation_size, generation)
    points = [
        make_centre(config, generation, ask.centre_D, state.observations, begun.centres[ask.centre], ask.sigma)
        for ask in asked
        if isinstance(ask, Ask)
    ]
    policies = policies_asked(config, search.task, generation, asked)
    return Proposal(generation, begun, start_cells, asked, points, policies)


def evaluate(search: Search, evaluator: Evaluator, proposal: Proposal, clock: Clock) -> Evaluations:
    """Roll out the populations and the policies."""
    config, asks = search.config, proposal.asks
    if not proposal.asked:
        return Evaluations((), (), (), ())
    pairs = [ask.pairs for ask in asks]
    populations, observed, policies = evaluate_populations(
        evaluator, proposal.centres, pairs, config.compute.chunk_pairs, proposal.policies
    )
    clock.lap("seconds_rollout")
    members = [*populations, *map(as_population, policies)]
    members = invalidate(members, config.search.max_invalid_fraction, proposal.generation)
    return Evaluations(members[: len(asks)], policies, members, observed)


def update(search: Search, evaluator: Evaluator, proposal: Proposal, evaluations: Evaluations, clock: Clock) -> Update:
    """Weigh the noise, estimate gradients, step, evaluate the new centres, and tell the search."""
    config, algorithm, generation = search.config, search.algorithm, proposal.generation
    moved, new_centres = proposal.search, proposal.centres
    if proposal.asked:
        moved, new_centres = _step(search, evaluator, proposal, evaluations.populations, clock)
    resets = "by_ask" if proposal.asked else "by_chunk"
    results = evaluate_centres(evaluator, new_centres, config.search.evaluation_episodes, resets=resets)
    clock.lap("seconds_evaluation")
    if not proposal.asked:
        require_some_finite(results, config.task.environment)
        evaluated = initial_centres(new_centres, results, config, moved.weight.value)
    else:
        evaluated = in_ask_order(
            proposal.asked,
            zip(new_centres, results, evaluations.populations, strict=True),
            zip(proposal.policies, evaluations.policies, strict=True),
            seed=config.seed,
            centres=len(proposal.search.centres),
            fitness_weight=proposal.search.weight.value,
        )
    told = told_of(evaluated, generation)
    learned = tell(algorithm, moved, told)
    nearest, novelty_N = config.novelty, np.full(len(told), np.nan)
    if proposal.asked:
        how = {"neighbours": nearest.neighbours, "distance": nearest.distance, "newest": nearest.newest}
        novelty_N = novelty(moved.archive, told.descriptor_N_B, **how)
    return Update(learned, evaluated, told, novelty_N)


def _step(
    search: Search, evaluator: Evaluator, proposal: Proposal, populations: Sequence[EpisodesResult], clock: Clock
) -> tuple[SearchState, list[Centre]]:
    """The state after the step of each centre, and the new centres as they are sent to the workers."""
    config, algorithm, generation, asks = search.config, search.algorithm, proposal.generation, proposal.asks
    weights: list[FloatArray] = []
    for ask, population in zip(asks, populations, strict=True):
        weights.append(algorithm.weights(proposal.search, ask, population))
        require_weights(weights[-1], ask, generation)
    clock.lap("seconds_driver")
    block_pairs = config.compute.gradient_block_pairs
    if isinstance(config.search, PopulationConfig) and config.search.step_gate:
        gradients, agreements = halves(evaluator, generation, weights, block_pairs)
        asks = [replace(ask, rate=ask.rate * one) for ask, one in zip(asks, agreements, strict=True)]
    else:
        gradients = estimate_gradients(evaluator, generation, weights, block_pairs)
    clock.lap("seconds_gradient")
    moved = proposal.search
    for ask, gradient_D in zip(asks, gradients, strict=True):
        moved = algorithm.step(moved, ask, gradient_D)
        require_state(moved, "step", generation)
    # New centres are evaluated with the observation statistics of the generation's start.
    new_centres = [
        replace(centre, parameters_D=moved.centres[ask.centre].centre_D)
        for ask, centre in zip(asks, proposal.centres, strict=True)
    ]
    require_finite(new_centres, config.search, generation)
    clock.lap("seconds_driver")
    return moved, new_centres


def record(
    search: Search,
    store: Store,
    before: RunState,
    proposal: Proposal,
    evaluations: Evaluations,
    updated: Update,
    correction: Correction,
    reachable: Reachable,
    faults: HistoryRow,
    clock: Clock,
) -> tuple[RunState, HistoryRow]:
    """Commit the generation: the state after it, its row of the history, and those of what it has evaluated."""
    config, generation, learned = search.config, proposal.generation, updated.search
    evaluated, told, results = updated.evaluated, updated.told, updated.evaluated.evaluation
    episodes = sum(one.fitness.size for one in evaluations.populations) * config.task.episodes_per_member
    cell_N = None if learned.map is None else learned.map.cells_with(generation, evaluated.index_N)
    state = RunState(
        generation=generation,
        search=replace(learned, elites={}),
        observations=merge_moments(before.observations, evaluations.observed),
        best=better(before.best, told, evaluated.point),
        env_steps=before.env_steps + int(evaluated.env_steps_N.sum()) + correction.env_steps,
        episodes=before.episodes + episodes + results.fitness.size + correction.episodes,
        wall_clock_s=clock.total(),
        elites=entered(learned, cell_N, evaluated.points, results.trace_T_B),
    )
    table = evaluated_table(evaluated, search.task, cell_N, proposal.start_cells, updated.novelty_N)
    at = fittest(told)  # the history's row is about this one
    shown = int(evaluated.index_N[at])
    row: HistoryRow = {
        "generation": generation,
        "env_steps": state.env_steps,
        "episodes": state.episodes,
        "best_fitness": state.best.fitness,
        **search_columns(
            shown, float(evaluated.fitness_weight_N[at]), or_none(updated.novelty_N[at]), learned.archive.size
        ),
        **map_columns(
            learned.map,
            config.map.qd_offset,
            reachable,
            cell=None if cell_N is None or cell_N[at] == EMPTY else int(cell_N[at]),
            start_cell=proposal.start_cells.get(shown),
        ),
        **correction.columns,
        "update_norm": or_none(evaluated.update_norm_N[at]),
        "parameter_norm": norm(evaluated.point(at).parameters_D),
        **population_columns(evaluations.members),
        **evaluation_columns(table, results, at, search.task),
        **faults,
        "wall_clock_s": state.wall_clock_s,
    }
    clock.lap("seconds_driver")
    seconds, laps = clock.finish_generation()
    row |= {"steps_per_second": (state.env_steps - before.env_steps) / seconds, **laps}
    parts = changed_parts(state, before if before.generation >= 0 else None, store.part)
    store.commit(generation, parts, row, table)
    clock.lap("seconds_store")
    return state, row


def _elite(store: Store, cell: int) -> Elite:
    return elite_from_arrays(store.part(elite_part(cell)))
