"""The main loop of a run. A generation is: propose, roll out, step, evaluate, tell, finish.

The loop is independent of Ray, JAX, files and any single method; everything that it works with is an argument. A
generation depends only on (config, seed, state), and is stored while the rollouts of the next one are computed, with
those that have ended shortly before. It is a generator: `results = yield work`. Whoever drives it computes the work, or
has it computed.
Generation 0 proposes the initial centres, without populations around them, so that it has no gradient and takes no
step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from es_service.config.search import PopulationConfig
from es_service.config.sections import BudgetConfig
from es_service.logs import in_generation
from es_service.loop import budget as budgets
from es_service.loop.blocks import state_of
from es_service.loop.budget import Clock
from es_service.loop.checks import (
    invalidate,
    require_asks,
    require_finite,
    require_some_finite,
    require_start_cells,
    require_state,
    require_weights,
)
from es_service.loop.contents import Named, StatePolicies, as_population
from es_service.loop.evaluated import correct, policies_asked, told_of_asks, told_of_initial
from es_service.loop.finished import Finished, Members, finish, reachable_in, rows
from es_service.loop.generation import (
    estimate_gradients,
    evaluate_centres,
    evaluate_populations,
    halves,
    initial_state,
    make_centre,
    tell,
    with_archive,
)
from es_service.loop.history import HistoryRow
from es_service.loop.state import Generation, RunState, Search, Stop, Store, Stored
from es_service.protocol.content import Arrays
from es_service.protocol.episodes import DispatchCounts, Evaluator, OverlappedRequests, Requests, Value
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.search.algorithms.base import Ask, CentreEvaluations, PolicyAsk, SearchState


def run(
    search: Search,
    store: Store,
    state: RunState | None,
    report: Callable[[HistoryRow], object],
    failed: Callable[[Sequence[str]], object] = lambda failures: None,
    counts: Callable[[], DispatchCounts] = DispatchCounts,
    commit_interval_s: float = 0.0,
    is_last: Callable[[RunState], bool] = lambda state: False,
) -> OverlappedRequests[tuple[RunState, str]]:
    """Run generations until the budget is spent or `report` returns a `Stop`. While the rollouts of one are computed,
    those before it are stored.

    Args:
        state: the newest state in `store`, from which to continue; None to begin a run, with an empty store.
        report: called with each history row after `store` has taken it. A `Stop` that it returns ends the session, and
            any other value has no effect.
        failed: called before that with texts that name the generation's failed episodes, if there are any of which
            the rollouts know more.
        counts: returns the numbers of workers and of faults so far.
        commit_interval_s: seconds after the end of a generation in which it is stored, in one transaction with those
            that end meanwhile. A `Stop` ends the session with the last generation of a transaction, and only with 0
            with that of its row in any case.
        is_last: whether a generation, whose state this is, must be the last of its transaction, since `report` may
            return a `Stop` for it.

    Returns:
        The last state and the reason for ending, in words.

    Raises:
        EvaluationError, StoreError: the run cannot continue; nothing committed is lost.
    """
    clock = Clock(state.wall_clock_s if state is not None else 0.0)
    state = begun = state or initial_state(search)
    reachable = reachable_in(search, state)
    waiting: list[Finished] = []
    """Generations that are not stored, in their order."""
    due_s = math.inf  # when they are to be stored

    def content(name: bytes) -> Arrays:
        return next((one.contents[name] for one in waiting if name in one.contents), None) or store.content(name)

    def so_far() -> DispatchCounts:
        """The numbers of this session, to which the times of earlier sessions are added."""
        now = counts()
        return replace(now, rollout_s=begun.rollout_s + now.rollout_s, cpu_s=begun.cpu_s + now.cpu_s)

    def record() -> str | None:
        """Store and report the generations that wait. Returns the reason to stop, if there is one."""
        if not waiting:
            return None
        since, together = clock.now(), [*waiting]
        waiting.clear()
        for one in together:
            in_generation(one.state.generation)
            if one.failures:
                failed(one.failures)
        taken: list[Generation] = []
        wrong = None
        try:
            for one in together:
                found = rows(search, one, reachable)
                taken.append(Generation(one.state.generation, one.parts, *found, one.contents))
        # Nobody has a policy that it names, or a metric of the search cannot be computed; those before it are stored.
        except Exception as error:
            wrong = error
        since = clock.meanwhile("seconds_driver", since)
        if taken:
            store.commit(taken)
        since = clock.meanwhile("seconds_store", since)
        answers: list[object] = []
        for one in taken:
            in_generation(one.number)
            answers.append(report(one.history))
        in_generation(together[-1].state.generation + 1)
        clock.meanwhile("seconds_driver", since)
        if wrong is not None:
            raise wrong
        return next((answer.reason for answer in answers if isinstance(answer, Stop)), None)

    policies = StatePolicies(content)
    while (reason := spent(search.config.budget, state)) is None:
        in_generation(state.generation + 1)
        requests = generation(search, policies, clock, state, so_far)
        results: Any = None
        try:
            while True:
                try:
                    work = requests.send(results)
                except StopIteration as end:
                    newest: Finished = end.value
                    break
                yield work
                results = None
                while results is None:
                    if waiting and time.perf_counter() >= due_s and (reason := record()) is not None:
                        return state, reason
                    results = yield due_s - time.perf_counter() if waiting else math.inf
        except BaseException:
            record()  # this generation is lost, and not those before it
            raise
        state = newest.state
        if is_last(state):
            due_s = time.perf_counter()
        elif not waiting:
            due_s = time.perf_counter() + commit_interval_s
        waiting.append(newest)
    return state, record() or reason


def drive(session: OverlappedRequests[Value], evaluator: Evaluator) -> Value:
    """What a session returns, whose work an evaluator computes.

    Raises:
        EvaluationError: the work cannot be computed. Interrupted: a signal asked the run to stop.
    """
    with closing(session):
        results: Any = None
        while True:
            try:
                work = session.send(results)
                assert isinstance(work, Sequence)
                wait, results = evaluator.begin(work), None
                while results is None:
                    most_s = next(session)
                    assert isinstance(most_s, float)
                    results = wait(most_s)
            except StopIteration as end:
                return end.value


def stored_state(store: Stored) -> RunState | None:
    """The newest state in the store; None before the first generation."""
    if store.generation is None:
        return None
    rows = store.newest_history(budgets.MOST_DURATIONS)
    seconds = {name: float(rows[-1].get(name) or 0.0) if rows else 0.0 for name in ("wall_clock_s", *budgets.SECONDS)}
    state = state_of(store.load(), store.generation, seconds.pop("wall_clock_s"))
    return replace(state, durations=budgets.durations(rows), **seconds)


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
        "rollout_s": state.rollout_s,
        "cpu_s": state.cpu_s,
        "best_fitness": state.best.fitness,
    }


def generation(
    search: Search,
    policies: StatePolicies,
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
    since, number = counts() if state.generation >= 0 else DispatchCounts(), state.generation + 1
    if number == 0:
        start_cells, members, stepped = {}, Members(), state.search
        told, named = yield from _initial(search, state, clock)
        archive = None
    else:
        begun, start_cells, asked = propose(search, policies, state)
        clock.lap("seconds_driver")
        members, stepped, (told, named) = yield from _asked(search, state, begun, asked, clock)
        archive = stepped.archive
    learned = tell(search.algorithm, stepped, told)
    policies.add(named.contents, named.origins)
    clock.lap("seconds_driver")
    correction = yield from correct(search, policies.policies, learned, number)
    clock.lap("seconds_evaluation")
    now = counts()
    faults: HistoryRow = {
        "retries": now.retries - since.retries,
        "lost_workers": now.lost_workers - since.lost_workers,
        "workers": now.workers,
    }
    computed = start_cells, members, told, named, archive
    finished = finish(state, learned, *computed, correction, faults, search, clock)
    return replace(finished, state=replace(finished.state, rollout_s=now.rollout_s, cpu_s=now.cpu_s))


def propose(
    search: Search, policies: StatePolicies, state: RunState
) -> tuple[SearchState, Mapping[int, int], Sequence[Ask | PolicyAsk]]:
    """What the next generation asks for: (the state in which centres have restarted from elites, the cells of these
    elites by index of the centre, the asks)."""
    algorithm, begun, number = search.algorithm, state.search, state.generation + 1
    size = begun.centres[0].centre_D.size
    start_cells = require_start_cells(algorithm.start_cells(begun, number), begun, number)
    for index, cell in start_cells.items():
        begun = algorithm.restart(begun, index, cell, policies.policy(_policy_of(begun, cell), search.spec))
        require_state(begun, "restart", number, index, size)
    asked: Any = policies.completed(algorithm.ask(begun, number), number)
    require_asks(asked, begun, search.config.compute.chunk_pairs, search.task.observation_size, number)
    return begun, start_cells, asked


def _policy_of(state: SearchState, cell: int) -> bytes:
    assert state.map is not None
    return state.map.policy_N[state.map.row_of(cell)].tobytes()


def _initial(search: Search, state: RunState, clock: Clock) -> Requests[tuple[CentreEvaluations, Named]]:
    """Evaluate the initial centres, around which there are no populations."""
    config = search.config
    centres = [make_centre(config, 0, centre.centre_D, state.observations, centre) for centre in state.search.centres]
    clock.lap("seconds_driver")
    results = yield from evaluate_centres(centres, config.search.evaluation_episodes, resets="by_chunk")
    clock.lap("seconds_evaluation")
    require_some_finite(results, config.task.environment, allow_infeasible=config.search.allow_infeasible)
    return told_of_initial(centres, results, config, state.search.weight.value, search.spec)


def _asked(
    search: Search, state: RunState, begun: SearchState, asked: Sequence[Ask | PolicyAsk], clock: Clock
) -> Requests[tuple[Members, SearchState, tuple[CentreEvaluations, Named]]]:
    """Roll out what was asked for, step, and evaluate the new centres: (the members, the state after the steps, what
    the search is told)."""
    config, number = search.config, state.generation + 1
    asks = [ask for ask in asked if isinstance(ask, Ask)]
    centres = [
        make_centre(config, number, ask.centre_D, state.observations, begun.centres[ask.centre], ask.sigma)
        for ask in asks
    ]
    centres = with_archive(centres, asks, begun.archive, config.novelty)
    policies = policies_asked(config, search.task, number, asked)
    pairs = [ask.pairs for ask in asks]
    results, observed, of_policies = yield from evaluate_populations(
        centres, pairs, config.compute.chunk_pairs, policies
    )
    clock.lap("seconds_rollout")
    valid, infeasible = invalidate([*results, *map(as_population, of_policies)], config.search, number)
    populations = valid[: len(asks)]
    gradients = yield from _gradients(search, begun, asks, populations, number, clock)
    stepped = begun
    for ask, gradient_D in gradients:
        stepped = search.algorithm.step(stepped, ask, gradient_D)
        require_state(stepped, "step", number, ask.centre, gradient_D.size)
    # New centres are evaluated with the observation statistics of the generation's start.
    new_centres = [
        replace(centre, parameters_D=stepped.centres[ask.centre].centre_D, archive=None)
        for ask, centre in zip(asks, centres, strict=True)
    ]
    require_finite(new_centres, config.search, number)
    clock.lap("seconds_driver")
    evaluations = yield from evaluate_centres(new_centres, config.search.evaluation_episodes)
    clock.lap("seconds_evaluation")
    told = told_of_asks(
        number,
        asked,
        zip(new_centres, evaluations, populations, strict=True),
        zip(policies, of_policies, strict=True),
        seed=config.seed,
        centres=len(begun.centres),
        fitness_weight=begun.weight.value,
        spec=search.spec,
    )
    return Members(valid, observed, infeasible, 2 * sum(pairs)), stepped, told


def _gradients(
    search: Search,
    begun: SearchState,
    asks: Sequence[Ask],
    populations: Sequence[EpisodesResult],
    number: int,
    clock: Clock,
) -> Requests[list[tuple[Ask, FloatArray]]]:
    """Weigh the noise of each population, and estimate its gradient [D]."""
    config = search.config
    weights: list[FloatArray] = []
    for ask, population in zip(asks, populations, strict=True):
        weights.append(search.algorithm.weights(begun, ask, population))
        require_weights(weights[-1], ask, number)
    clock.lap("seconds_driver")
    block_pairs = config.compute.gradient_block_pairs
    if isinstance(config.search, PopulationConfig) and config.search.step_gate:
        gradients, agreements = yield from halves(number, weights, block_pairs)
        asks = [replace(ask, rate=ask.rate * agreement) for ask, agreement in zip(asks, agreements, strict=True)]
    else:
        gradients = yield from estimate_gradients(number, weights, block_pairs)
    clock.lap("seconds_gradient")
    return list(zip(asks, gradients, strict=True))
