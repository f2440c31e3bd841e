"""The main loop of a run. A generation is: propose, evaluate, update, finish.

The loop is independent of Ray, JAX, files and any single method; everything that it works with is an argument. A
generation depends only on (config, seed, state), and is stored while the rollouts of the next one are computed. It is a
generator: `results = yield work`. Whoever drives it computes the work, or has it computed.
Generation 0 proposes the initial centres, without populations around them, so that it has no gradient and takes no
step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np

from es_service.config.model import BudgetConfig
from es_service.config.search import PopulationConfig
from es_service.config.workload import policy_spec
from es_service.loop import budget as budgets
from es_service.loop.arrays import state_of
from es_service.loop.checks import (
    invalidate,
    require_asks,
    require_finite,
    require_some_finite,
    require_start_cells,
    require_state,
    require_weights,
)
from es_service.loop.clock import Clock
from es_service.loop.contents import Contents, Named
from es_service.loop.correction import correct
from es_service.loop.evaluated import (
    Evaluations,
    Proposal,
    Update,
    in_ask_order,
    initial_centres,
    policies_asked,
    told_of,
)
from es_service.loop.finished import Finished, finish, reachable_in, rows
from es_service.loop.generation import (
    estimate_gradients,
    evaluate_centres,
    evaluate_populations,
    halves,
    initial_state,
    make_centre,
    tell,
)
from es_service.loop.history import HistoryRow
from es_service.loop.interfaces import Search, Stop, Store, Stored
from es_service.loop.policies import as_population
from es_service.loop.state import RunState
from es_service.protocol.evaluator import DispatchCounts, Evaluator, Requests, Session, Value
from es_service.protocol.messages import Centre, EpisodesResult, FloatArray
from es_service.search.algorithms.base import Ask, SearchState
from es_service.search.novelty import novelty


def run(
    search: Search,
    store: Store,
    state: RunState | None,
    report: Callable[[HistoryRow], object],
    failed: Callable[[Sequence[str]], object] = lambda failures: None,
    counts: Callable[[], DispatchCounts] = DispatchCounts,
) -> Session[tuple[RunState, str]]:
    """Run generations until the budget is spent or `report` returns a `Stop`. While the rollouts of one are computed,
    the one before is stored.

    Args:
        state: the newest state in `store`, from which to continue; None to begin a run, with an empty store.
        report: called with each history row after `store` has taken it. A `Stop` that it returns ends the session, and
            any other value has no effect.
        failed: called before that with texts that name the generation's failed episodes, if there are any of which
            the rollouts know more.
        counts: returns the numbers of workers and of faults so far.

    Returns:
        The last state and the reason for ending, in words.

    Raises:
        EvaluationError, StoreError: the run cannot continue; nothing committed is lost.
    """
    clock = Clock(state.wall_clock_s if state is not None else 0.0)
    state = state or initial_state(search)
    reachable = reachable_in(search, state)
    policies = Contents(store.content)
    finished: list[Finished] = []

    def record() -> str | None:
        """Store and report the generation that is finished, if there is one that is not stored. Returns the reason to
        stop, if there is one."""
        if not finished:
            return None
        clock.lap("seconds_rollout")  # of the next generation, whose work has been sent
        newest = finished.pop()
        if newest.failures:
            failed(newest.failures)
        row, table = rows(search, newest, reachable)
        clock.lap("seconds_driver")
        store.commit(newest.state.generation, newest.parts, row, table, newest.contents)
        clock.lap("seconds_store")
        answer = report(row)
        clock.lap("seconds_driver")
        return answer.reason if isinstance(answer, Stop) else None

    while (reason := spent(search.config.budget, state)) is None:
        requests = generation(search, policies, clock, state, counts)
        results: Any = None
        try:
            while True:
                try:
                    work = requests.send(results)
                except StopIteration as end:
                    finished.append(end.value)
                    break
                yield work
                if (reason := record()) is not None:
                    return state, reason
                results = yield None
        except BaseException:
            record()  # if this generation has failed before it was sent
            raise
        state = finished[0].state
    return state, record() or reason


def drive(session: Session[Value], evaluator: Evaluator) -> Value:
    """What a session returns, whose work an evaluator computes.

    Raises:
        EvaluationError: the work cannot be computed. Interrupted: a signal asked the run to stop.
    """
    with closing(session):
        results: Any = None
        while True:
            try:
                work = session.send(results)
                assert work is not None
                wait = evaluator.begin(work)
                next(session)
            except StopIteration as end:
                return end.value
            results = wait()


def stored_state(store: Stored) -> RunState | None:
    """The newest state in the store; None before the first generation."""
    if store.generation is None:
        return None
    rows = store.newest_history(budgets.MOST_DURATIONS)
    seconds = float(rows[-1]["wall_clock_s"] or 0.0) if rows else 0.0
    return replace(state_of(store.load(), store.generation, seconds), durations=budgets.durations(rows))


def spent(budget: BudgetConfig, state: RunState) -> str | None:
    """Why the run is over, or None if it is not."""
    return next(iter(budgets.spent(budgets.limits_of(budget), _reached(state), state.durations).values()), None)


def is_finished(budget: BudgetConfig, state: RunState) -> bool:
    """Whether the run is over, and more than starting took place."""
    return spent(budget, state) is not None and not budgets.only_started(budgets.limits_of(budget), _reached(state))


def _reached(state: RunState) -> dict[str, float]:
    """The columns of the history that a budget limits."""
    return {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "wall_clock_s": state.wall_clock_s,
        "best_fitness": state.best.fitness,
    }


def generation(
    search: Search,
    policies: Contents,
    clock: Clock,
    state: RunState,
    counts: Callable[[], DispatchCounts] = DispatchCounts,
) -> Requests[Finished]:
    """One generation, which asks for what it needs computed: a pure function of (search, state, stored policies,
    results) but for its timings.

    It may ask for several populations, and for policies. Each request has all of them side by side; results are taken
    in ask order.

    Args:
        policies: those that `state` names; gets those of this generation.
        state: the state before it.
        counts: as in `run`.
    """
    since = counts() if state.generation >= 0 else DispatchCounts()
    proposal = propose(search, policies, state)
    clock.lap("seconds_driver")
    evaluations = yield from evaluate(search, proposal)
    clock.lap("seconds_rollout")
    updated = yield from update(search, proposal, evaluations, clock)
    policies.add(updated.contents)
    clock.lap("seconds_driver")
    correction = yield from correct(search, policies.policies, updated)
    clock.lap("seconds_evaluation")
    now = counts()
    faults: HistoryRow = {
        "retries": now.retries - since.retries,
        "lost_workers": now.lost_workers - since.lost_workers,
        "workers": now.workers,
    }
    return finish(state, proposal, evaluations, updated, correction, faults, search, clock)


def propose(search: Search, policies: Contents, state: RunState) -> Proposal:
    """What the next generation evaluates: centres restart from elites, and the search asks."""
    config, algorithm, generation = search.config, search.algorithm, state.generation + 1
    begun = state.search
    if generation == 0:
        points = [make_centre(config, 0, centre.centre_D, state.observations, centre) for centre in begun.centres]
        return Proposal(0, begun, {}, (), points, ())
    size = begun.centres[0].centre_D.size
    start_cells = require_start_cells(algorithm.start_cells(begun, generation), begun, generation)
    for index, cell in start_cells.items():
        begun = algorithm.restart(begun, index, cell, policies.elite(_policy_of(begun, cell)))
        require_state(begun, "restart", generation, index, size)
    asked: Any = policies.completed(algorithm.ask(begun, generation), generation)
    require_asks(asked, begun, config.compute.chunk_pairs, search.task.observation_size, generation)
    points = [
        make_centre(config, generation, ask.centre_D, state.observations, begun.centres[ask.centre], ask.sigma)
        for ask in asked
        if isinstance(ask, Ask)
    ]
    work = policies_asked(config, search.task, generation, asked)
    return Proposal(generation, begun, start_cells, asked, points, work)


def _policy_of(state: SearchState, cell: int) -> bytes:
    """Name of the policy of a filled cell."""
    assert state.map is not None
    return state.map.policy_N[state.map.row_of(cell)].tobytes()


def evaluate(search: Search, proposal: Proposal) -> Requests[Evaluations]:
    """Roll out the populations and the policies."""
    config, asks = search.config, proposal.asks
    if not proposal.asked:
        return Evaluations((), (), (), ())
    pairs = [ask.pairs for ask in asks]
    populations, observed, policies = yield from evaluate_populations(
        proposal.centres, pairs, config.compute.chunk_pairs, proposal.policies
    )
    members = [*populations, *map(as_population, policies)]
    members, infeasible = invalidate(members, config.search, proposal.generation)
    return Evaluations(members[: len(asks)], policies, members, observed, infeasible)


def update(search: Search, proposal: Proposal, evaluations: Evaluations, clock: Clock) -> Requests[Update]:
    """Weigh the noise, estimate gradients, step, evaluate the new centres, and tell the search."""
    config, algorithm, generation = search.config, search.algorithm, proposal.generation
    stepped, new_centres = proposal.search, proposal.centres
    if proposal.asked:
        stepped, new_centres = yield from _step(search, proposal, evaluations.populations, clock)
    resets = "by_ask" if proposal.asked else "by_chunk"
    results = yield from evaluate_centres(new_centres, config.search.evaluation_episodes, resets=resets)
    clock.lap("seconds_evaluation")
    if not proposal.asked:
        allow_infeasible = config.search.allow_infeasible
        require_some_finite(results, config.task.environment, allow_infeasible=allow_infeasible)
        evaluated = initial_centres(new_centres, results, config, stepped.weight.value)
    else:
        evaluated = in_ask_order(
            proposal.asked,
            zip(new_centres, results, evaluations.populations, strict=True),
            zip(proposal.policies, evaluations.policies, strict=True),
            seed=config.seed,
            centres=len(proposal.search.centres),
            fitness_weight=proposal.search.weight.value,
        )
    named = Named(evaluated, policy_spec(config, search.task))
    told = told_of(evaluated, generation, named.names)
    learned = tell(algorithm, stepped, told)
    novelty_N = np.full(len(told), np.nan)
    if proposal.asked:
        novelty_N = novelty(stepped.archive, told.descriptor_N_B, **dict(config.novelty))
    return Update(learned, evaluated, told, novelty_N, named.contents)


def _step(
    search: Search, proposal: Proposal, populations: Sequence[EpisodesResult], clock: Clock
) -> Requests[tuple[SearchState, list[Centre]]]:
    """The state after the step of each centre, and the new centres as they are sent to the workers."""
    config, algorithm, generation, asks = search.config, search.algorithm, proposal.generation, proposal.asks
    weights: list[FloatArray] = []
    for ask, population in zip(asks, populations, strict=True):
        weights.append(algorithm.weights(proposal.search, ask, population))
        require_weights(weights[-1], ask, generation)
    clock.lap("seconds_driver")
    block_pairs = config.compute.gradient_block_pairs
    if isinstance(config.search, PopulationConfig) and config.search.step_gate:
        gradients, agreements = yield from halves(generation, weights, block_pairs)
        asks = [replace(ask, rate=ask.rate * agreement) for ask, agreement in zip(asks, agreements, strict=True)]
    else:
        gradients = yield from estimate_gradients(generation, weights, block_pairs)
    clock.lap("seconds_gradient")
    stepped = proposal.search
    for ask, gradient_D in zip(asks, gradients, strict=True):
        stepped = algorithm.step(stepped, ask, gradient_D)
        require_state(stepped, "step", generation, ask.centre, gradient_D.size)
    # New centres are evaluated with the observation statistics of the generation's start.
    new_centres = [
        replace(centre, parameters_D=stepped.centres[ask.centre].centre_D)
        for ask, centre in zip(asks, proposal.centres, strict=True)
    ]
    require_finite(new_centres, config.search, generation)
    clock.lap("seconds_driver")
    return stepped, new_centres
