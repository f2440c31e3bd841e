"""Checks of what a generation asks for and gets; each raises an error that names the generation and the way out."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.config.search import PopulationConfig, SearchConfig
from es_service.config.text import one_of
from es_service.errors import EvaluationError, StoreError, WayOut
from es_service.loop.blocks import names_of, stored
from es_service.loop.state import RunState
from es_service.protocol.episodes import INFEASIBLE
from es_service.protocol.messages import Centre, EpisodesResult
from es_service.protocol.policies import Recipes
from es_service.search.algorithms.base import Ask, PolicyAsk, SearchState
from es_service.search.arrays import problem as problem_of_extra
from es_service.search.maps.behaviour_map import COLUMNS, BehaviourMap

LEARNING_RATE = "search.step.learning_rate"


def require_asks(asks: object, state: SearchState, chunk_pairs: int, observation_size: int, generation: int) -> None:
    """Raise an EvaluationError if what a search asks for, a user's perhaps, cannot be evaluated."""

    def wrong() -> str:
        if not isinstance(asks, tuple) or not asks or not all(isinstance(ask, Ask | PolicyAsk) for ask in asks):
            kinds = f" of {', '.join(type(ask).__name__ for ask in asks)}" if isinstance(asks, tuple) and asks else ""
            returned = "an empty tuple" if asks == () else type(asks).__name__ + kinds
            return f"`ask` returned {returned}; it must return a tuple of one or more Ask or PolicyAsk"
        indices = [ask.centre for ask in asks if isinstance(ask, Ask)]
        known = all(_is_index(index, len(state.centres)) for index in indices)
        if not known or len(set(indices)) < len(indices):
            return f"the asks are for the centres {indices}; each of the {len(state.centres)} may occur once"
        size = state.centres[0].centre_D.size
        for ask in asks:
            if isinstance(ask, PolicyAsk):
                if problem := _wrong_policies(ask, size, observation_size):
                    return problem
                continue
            if not (isinstance(ask.sigma, int | float | np.floating) and 0.0 < ask.sigma < math.inf):
                return f"the sigma of centre {ask.centre} is {ask.sigma}; it must be positive"
            if not isinstance(ask.pairs, int | np.integer) or ask.pairs < 1 or ask.pairs % chunk_pairs:
                return f"centre {ask.centre} has {ask.pairs} pairs; must be a multiple of chunk_pairs ({chunk_pairs})"
            if problem := _not_floats(ask.centre_D, (size,)):
                return f"the parameters of centre {ask.centre} {problem}"
        return ""

    if problem := wrong():
        raise EvaluationError(f"generation {generation}: {problem}", field="search.algorithm")


def require_start_cells(cells: object, state: SearchState, generation: int) -> dict[int, int]:
    """The cells from whose elites centres restart, by index of the centre.

    Raises:
        EvaluationError: a search, a user's perhaps, names a centre or an elite that there is not.
    """
    if not isinstance(cells, Mapping):
        what = f"returned {type(cells).__name__}; it must return a mapping from indices of centres to cells"
        raise _wrong("start_cells", what, generation)
    if not all(_is_index(index, len(state.centres)) for index in cells):
        what = f"names the centres {list(cells)}; the indices of centres are 0 to {len(state.centres) - 1}"
        raise _wrong("start_cells", what, generation)
    if not all(isinstance(cell, int | np.integer) and not isinstance(cell, bool) for cell in cells.values()):
        what = f"returned {list(cells.values())} as cells; it must return whole numbers, such as those of `map.cell_N`"
        raise _wrong("start_cells", what, generation)
    filled = state.map.cell_N if state.map is not None else np.zeros(0, np.int64)
    if missing := [int(cell) for cell in cells.values() if cell not in filled]:
        there = f"{filled.size} cells of the map have one" if state.map is not None else "the run has no map"
        named = ", ".join(map(str, missing))
        raise _wrong("start_cells", f"names the cells {named}, which have no elite; {there}", generation)
    return {int(index): int(cell) for index, cell in cells.items()}


def require_state(state: object, function: str, generation: int, centre: int | None = None, size: int = 0) -> None:
    """Raise an EvaluationError if a function of a search, a user's perhaps, has not returned a state.

    Args:
        centre: index of the centre that the function was to change, which must still be there.
        size: number of its parameters.
    """
    if not isinstance(state, SearchState):
        raise _wrong(function, f"returned {type(state).__name__}; it must return a SearchState", generation)
    if centre is None:
        return
    if not centre < len(state.centres):
        what = f"returned a state without centre {centre}, which it was called for; it has {len(state.centres)} centres"
        raise _wrong(function, what, generation)
    if problem := _not_floats(state.centres[centre].centre_D, (size,)):
        raise _wrong(function, f"returned a state in which the parameters of centre {centre} {problem}", generation)


def _wrong(function: str, what: str, generation: int) -> EvaluationError:
    """The error of what a function of a search, a user's perhaps, has returned."""
    return EvaluationError(f"generation {generation}: `{function}` {what}", field="search.algorithm")


def _is_index(index: object, count: int) -> bool:
    return isinstance(index, int | np.integer) and not isinstance(index, bool) and 0 <= int(index) < count


def require_weights(weights_P: object, asked: Ask, generation: int) -> None:
    """Raise an EvaluationError if the weights that a search, a user's perhaps, gives to noise make no gradient."""
    problem = _not_floats(weights_P, (int(asked.pairs),))
    if isinstance(weights_P, np.ndarray) and not problem and not np.isfinite(weights_P).all():
        problem = f"are not finite for {np.count_nonzero(~np.isfinite(weights_P))} of {asked.pairs} pairs"
    if problem:
        raise EvaluationError(
            f"generation {generation}: the `weights` of centre {asked.centre} {problem}", field="search.algorithm"
        )


def _wrong_policies(ask: PolicyAsk, size: int, observation_size: int) -> str:
    """Why policies cannot be evaluated; empty if they can."""
    if isinstance(ask.parameters_N_D, Recipes):
        if problem := ask.parameters_N_D.problem(size):
            return f"the recipes of the policies {problem}"
        return _wrong_statistics(ask, len(ask.parameters_N_D), observation_size)
    count = len(ask.parameters_N_D) if isinstance(ask.parameters_N_D, np.ndarray) and ask.parameters_N_D.ndim else 1
    if problem := _not_floats(ask.parameters_N_D, (max(1, count), size)):
        return f"the parameters of the policies {problem}"
    if not np.isfinite(ask.parameters_N_D).all():
        return "the parameters of the policies are not all finite"
    return _wrong_statistics(ask, count, observation_size)


def _wrong_statistics(ask: PolicyAsk, count: int, observation_size: int) -> str:
    """Why policies cannot be evaluated with their observation statistics; empty if they can."""
    statistics = {"mean": ask.observation_mean_N_O, "standard deviation": ask.observation_std_N_O}
    if all(given is None for given in statistics.values()):
        return ""
    for name, given in statistics.items():
        if problem := _not_floats(given, (count, observation_size)):
            return f"the observation {name} of the policies {problem}; or both statistics are None"
        assert given is not None
        if not np.isfinite(given).all() or (name != "mean" and not (given > 0.0).all()):
            must = "finite" if name == "mean" else "finite and positive"
            return f"the observation {name} of the policies must be {must}"
    return ""


def _not_floats(given: object, shape: tuple[int, ...]) -> str:
    """In which way a value is no float32 array of a shape; empty if it is one."""
    if isinstance(given, np.ndarray) and given.dtype == np.float32 and given.shape == shape:
        return ""
    kind = f"{given.dtype} {given.shape}" if isinstance(given, np.ndarray) else type(given).__name__
    return f"are {kind}; must be a float32 array of shape {shape}"


def valid_members(result: EpisodesResult) -> NDArray[np.bool_]:
    """Whether each member (or episode) has a finite fitness and a finite descriptor, with the axes of the fitness."""
    return np.isfinite(result.fitness) & np.isfinite(result.descriptor).all(axis=-1)


def infeasible_members(result: EpisodesResult) -> NDArray[np.bool_]:
    """Whether the fitness of each member (or episode) is -inf, which says that it is infeasible, with its axes."""
    return np.isneginf(result.fitness)


def invalidate(
    populations: Sequence[EpisodesResult], search: SearchConfig, generation: int
) -> tuple[list[EpisodesResult], int]:
    """The populations with fitness NaN, which ranks last, for every invalid and every infeasible member; and how many
    are infeasible, which none is unless `search.allow_infeasible` is set.

    Raises:
        EvaluationError: more than `search.max_invalid_fraction` of a generation's members are invalid.
    """
    valid = [valid_members(population) for population in populations]
    infeasible = sum(int(np.count_nonzero(infeasible_members(population))) for population in populations)
    allowed = infeasible if search.allow_infeasible else 0
    members = sum(mask_P_S.size for mask_P_S in valid)
    invalid = sum(int(np.count_nonzero(~mask_P_S)) for mask_P_S in valid) - allowed
    if invalid > search.max_invalid_fraction * members:
        told = [text for population in populations for text in population.failures]
        nowhere = [~np.isfinite(one.descriptor).all(axis=-1) for one in populations]
        if search.allow_infeasible:
            nowhere = [mask & ~infeasible_members(one) for mask, one in zip(nowhere, populations, strict=True)]
        counts = {
            "fitness": sum(np.count_nonzero(~np.isfinite(one.fitness)) for one in populations) - allowed,
            "descriptor": sum(map(np.count_nonzero, nowhere)),
        }
        which = " and ".join(f"a {name} that is not finite ({count:,})" for name, count in counts.items() if count)
        hints = [f"smaller values of {one_of(search.spread_by, 'and')} may help"] if search.spread_by else []
        if told:
            which, hints = "no valid result", [f"the first: {told[0]}"]
        elif infeasible > allowed:
            hints = [INFEASIBLE]
        raise EvaluationError(
            f"generation {generation}: {invalid} of {members} members returned {which}, more than "
            f"search.max_invalid_fraction ({search.max_invalid_fraction}) allows. "
            + "; ".join([f"Everything up to generation {generation - 1} is saved", *hints]),
            field="search.max_invalid_fraction",
            value=search.max_invalid_fraction,
        )
    return [
        replace(population, fitness=np.where(valid_P_S, population.fitness, np.float32(np.nan)))
        for population, valid_P_S in zip(populations, valid, strict=True)
    ], allowed


def require_some_finite(
    evaluations: Sequence[EpisodesResult], environment: str, *, allow_infeasible: bool = False
) -> None:
    """Raise an EvaluationError if no episode of any initial centre is valid, nor infeasible where that is allowed; this
    is an error of the task."""
    count = sum(evaluation.fitness.size for evaluation in evaluations)
    infeasible = any(infeasible_members(evaluation).any() for evaluation in evaluations)
    if any(valid_members(evaluation).any() for evaluation in evaluations) or (allow_infeasible and infeasible):
        return
    finite = {
        "return": any(np.isfinite(evaluation.returns).any() for evaluation in evaluations),
        "descriptor": any(np.isfinite(evaluation.descriptor).any() for evaluation in evaluations),
    }
    wrong = " and ".join(name for name, is_finite in finite.items() if not is_finite) or "fitness or descriptor"
    steps = min(int(evaluation.steps.min()) for evaluation in evaluations)
    why = (
        f"the {wrong} is NaN or infinite in each of the {count} episodes of the initial centres; the shortest episode "
        f"has {steps} steps. The run cannot learn from this: look for a division by 0, a root or logarithm of a "
        f"negative number, or physics that diverges, in the task {environment}{f'; {INFEASIBLE}' if infeasible else ''}"
    )
    if told := [text for evaluation in evaluations for text in evaluation.failures]:
        why = f"each of the {count} episodes of the initial centres failed. The first: {told[0]}"
    raise EvaluationError(f"generation 0: {why}", field="task.environment", value=environment)


def require_finite(centres: Sequence[Centre], search: SearchConfig, generation: int) -> None:
    """Raise an EvaluationError if a centre is not finite after its update."""
    if all(np.isfinite(centre.parameters_D).all() for centre in centres):
        return
    saved = f"so it is not kept. Everything up to generation {generation - 1} is saved."
    if not isinstance(search, PopulationConfig):  # a search of the user's, with a step of its own
        raise EvaluationError(f"generation {generation}: a centre is not finite after its update, {saved}")
    learning_rate = search.step.learning_rate
    raise EvaluationError(
        f"generation {generation}: a centre is not finite after its update with {LEARNING_RATE} = {learning_rate:g}, "
        f"{saved}",
        field=LEARNING_RATE,
        value=learning_rate,
        ways_out=[
            WayOut(
                "fork",
                "continue from there with a smaller learning rate",
                settings={LEARNING_RATE: learning_rate / 10},
            )
        ],
    )


def require_storable(state: RunState, before: RunState | None) -> None:
    """Raise StoreError if the search's state is none that can be stored.

    Args:
        before: one that is; what is the same object in it is not looked at again.
    """
    if wrong := _malformed(state.search, None if before is None else before.search):
        raise _refusal(state.generation, wrong)


def _malformed(search: SearchState, earlier: SearchState | None) -> str:
    """What of a search's state is none that can be stored; empty if all is."""
    if not search.centres:
        return "the search has no centre; one must remain"
    if wrong := _malformed_centres(search, earlier):
        return wrong
    if earlier is not None and (search.map is None) != (earlier.map is None):
        return "the behaviour map was added or removed, which only `map.enabled` decides"
    if (earlier is None or search.extra is not earlier.extra) and (
        wrong := problem_of_extra(search.extra, earlier.extra if earlier is not None else {})
    ):
        return wrong
    return ""


def _malformed_centres(search: SearchState, earlier: SearchState | None) -> str:
    """Which new centre is none from which a generation could go on; empty if none is."""
    known = earlier.centres if earlier is not None else ()
    shape = (known or search.centres)[0].centre_D.shape
    for index, centre in enumerate(search.centres):
        if index < len(known) and centre is known[index]:
            continue
        centre_D = centre.centre_D
        if not isinstance(centre_D, np.ndarray) or centre_D.dtype != np.float32 or centre_D.shape != shape:
            now = f"{centre_D.dtype} {centre_D.shape}" if isinstance(centre_D, np.ndarray) else type(centre_D).__name__
            return f"centre {index} is {now}; it must be float32 {shape}"
        if not np.isfinite(centre_D).all():
            return f"centre {index} has {np.count_nonzero(~np.isfinite(centre_D))} values that are not finite"
    return ""


def _malformed_map(map_: BehaviourMap, before: BehaviourMap | None) -> str:
    """Which array of a map has another type, shape or content than its cells need; empty if none has."""
    needed = {"cell_N": "i8", **COLUMNS, **({} if map_.samples_N is None else {"samples_N": "i8"})}
    for name, type_ in needed.items():
        array = getattr(map_, name)
        shape = (map_.size, len(map_.geometry.bounds)) if name == "descriptor_N_B" else (map_.size,)
        if not isinstance(array, np.ndarray) or array.dtype != type_ or array.shape != shape:
            now = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            return f"the map's {name} is {now}; it must be {np.dtype(type_)} {shape}"
    cells = map_.cell_N if before is None or map_.cell_N is not before.cell_N else map_.cell_N[:0]
    if len(np.unique(cells)) < len(cells) or not ((cells >= 0) & (cells < map_.geometry.size)).all():
        return f"the map's cells must be different ones from 0 to {map_.geometry.size - 1}"
    return ""


def require_known(named: Collection[bytes], before: RunState | None, generation: int) -> None:
    """Raise StoreError if a state names a policy that was neither evaluated now nor named by the state before.

    Args:
        named: names of those that were not evaluated now.
    """
    if unknown := set(named).difference(() if before is None or not named else names_of(stored(before))):
        name = min(unknown).hex()
        raise _refusal(generation, f"it names the policy {name}, which was neither evaluated now nor named before")


def require_columns(search: SearchState, before: SearchState, generation: int) -> None:
    """Raise StoreError if the arrays of a map are none that can be stored; `before` is what can."""
    map_before = before.map
    if search.map is None or search.map is map_before:
        return
    if wrong := _malformed_map(search.map, map_before):
        raise _refusal(generation, wrong)


def _refusal(generation: int, why: str) -> StoreError:
    saved = f" Everything up to generation {generation - 1} is saved." if generation else ""
    return StoreError(
        f"generation {generation} cannot be stored: {why}; the class SearchState in "
        f"es_service/search/algorithms/base.py describes what a state is.{saved}"
    )
