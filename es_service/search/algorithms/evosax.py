"""Optimisers of evosax as methods: `search.algorithm: evosax:CMA_ES`, with the names of evosax (Lange 2022,
arXiv:2212.04180).

A generation asks the optimiser for `population_size` members, evaluates each as it is with
`search.evaluation_episodes` episodes, and tells the optimiser their fitness. The only centre is the mean of its
distribution or, of an optimiser that has a population instead, the best member so far. The first centre is that of any
method: the first mean, or the middle of the first population.

The optimiser's state, a tree of JAX arrays, is what this search remembers beside its centre: named arrays, which the
store keeps like any others. The optimiser itself runs in a process that `workers/strategies.py` describes, which
remembers nothing, so that a generation is a function of this state. Its bits do not depend on the number of workers or
of cores; those of a decomposition, as in CMA-ES, may depend on the kind of processor.

An invalid member counts with the lowest fitness of the others. A generation without a valid member teaches nothing.

Unlike our own methods, whose members are addresses of noise, the whole population is made here and travels to the
workers; so this is for functions and policies of up to some thousand parameters.

Axes: N members, D parameters.
"""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from threading import Lock
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model, model_validator

from es_service.config.model import RunConfig
from es_service.config.parts import CountAtOnce, Number, Positive, Section, Switch
from es_service.config.search import SearchConfig, same
from es_service.config.sections import MapConfig, NoveltyConfig
from es_service.config.text import nearest, one_of
from es_service.config.workload import policy_spec
from es_service.errors import ConfigError, EvaluationError, WayOut
from es_service.protocol.child import Child, NoAnswerError
from es_service.protocol.process_environment import child_environment
from es_service.protocol.user_code import RaisedError
from es_service.search.algorithms.base import Algorithm, CentreEvaluation, PolicyAsk, SearchState, in_columns
from es_service.search.algorithms.method import Method
from es_service.search.arrays import read_only
from es_service.search.shaping import invalid_lowest

LIBRARY = "evosax"
"""The library, the kind of its methods' names, and the extra of this package that installs it."""
STATE, VERSION = "evosax", "evosax_version"
"""Names of what the search remembers: the arrays of the optimiser's state, none before the first generation; and the
numbers in the version of evosax that made them."""
WHOLE = Annotated[int, "a whole number"]
TYPES = {"bool": Switch, "int": WHOLE, "float": Number}
"""Type of an option of evosax -> that of our key."""


class OptionsSection(Section):
    """Parameters of an optimiser; each has its own class with these."""

    @model_validator(mode="after")
    def _optimizer_has_its_rate(self) -> OptionsSection:
        values = dict(self)
        if (values.get("optimizer") is None) != (values.get("learning_rate") is None):
            raise ValueError("optimizer and learning_rate belong together; set both or none")
        return self


class EvosaxSettings(SearchConfig):
    """Keys of all optimisers of evosax; the class of each has its options, and `sigma` unless it has none."""

    population_size: CountAtOnce = Field(64, description="Members that a generation makes and evaluates.")

    presets = (
        same("policy.observation_normalization", False, "our choice; nothing could gather the statistics"),
        same("search.evaluation_episodes", 1, "our choice; as the examples of evosax"),
        same("map.enabled", False, "our choice; an optimiser has no use for descriptors"),
    )
    only_centres = 1
    spread_by = ("search.sigma",)
    unused = (
        *SearchConfig.unused,
        *(f"map.{name}" for name in MapConfig.model_fields),
        *(f"novelty.{name}" for name in NoveltyConfig.model_fields),
    )
    has_sigma: ClassVar[bool] = False

    def policies(self) -> int:
        return self.population_size

    def spread_keys(self) -> tuple[str, ...]:
        return ("search.population_size",)


SIGMA: Any = (
    Positive,
    Field(
        0.1,
        description="First standard deviation of the members around the centre, in parameter units; of an optimiser "
        "whose own one never changes, that of every generation.",
    ),
)


@cache
def named(name: str) -> Method:
    """The method `evosax:NAME`.

    Raises:
        ConfigError: evosax is not installed, has no such optimiser, or has one that no config can describe.
    """
    if importlib.util.find_spec(LIBRARY) is None:
        raise ConfigError(
            f"search.algorithm: {LIBRARY}:{name} needs the extra `{LIBRARY}`, which is not installed",
            field="search.algorithm",
            value=f"{LIBRARY}:{name}",
            ways_out=[WayOut("install", "install it", extra=LIBRARY)],
        )
    names = _answer("names")
    if name not in names:
        near = nearest(name, names)
        hint = f"did you mean {LIBRARY}:{near}?" if near else f"it has {one_of(names, 'and')}"
        raise ConfigError(
            f"{LIBRARY} has no algorithm {name}; {hint}",
            value=f"{LIBRARY}:{name}",
            suggestion=near and f"{LIBRARY}:{near}",
        )
    try:
        about = _answer("describe", name)
    except _RefusedError as error:
        raise ConfigError(str(error), value=f"{LIBRARY}:{name}") from error
    fields: dict[str, Any] = {
        option: _field(TYPES[kind], default) for option, (kind, default) in sorted(about["options"].items())
    }
    if about["optimizers"]:
        fields["optimizer"] = _field(Literal[tuple(about["optimizers"])], None)
        fields["learning_rate"] = _field(Positive, None)
    options = create_model(f"{name}Options", __base__=OptionsSection, **fields)
    sigma = {"sigma": SIGMA} if about["has_sigma"] else {}
    settings = create_model(f"{name}Settings", __base__=EvosaxSettings, **sigma, options=(options, Field(options())))
    summary = f"{name} of {LIBRARY} {about['version']}."
    return Method(partial(_algorithm, name, about["version"]), settings, f"{LIBRARY}:{name}", summary)


def _field(kind: Any, default: Any) -> Any:
    """The field of an option; None as its default says that evosax computes it."""
    return (kind | None if default is None else kind, Field(default))


def _algorithm(name: str, version: str, config: RunConfig) -> Algorithm:
    """The functions of an optimiser for a run.

    Raises:
        ConfigError: evosax refuses its settings.
    """
    search: Any = config.search
    parameters, defaults = policy_spec(config, config.made.task).parameters, type(search.options)()
    changed = tuple((key, value) for key, value in search.options if value != getattr(defaults, key))
    settings = (name, search.population_size, parameters, getattr(search, "sigma", None), changed)
    try:
        arrays = _answer("form", settings)
    except _RefusedError as error:
        raise ConfigError(f"search.algorithm: {error}", field="search.algorithm", value=search.algorithm) from error

    def request(state: SearchState, generation: int) -> tuple[Any, ...]:
        return settings, config.seed, generation, state.centres[0].centre_D, dict(state.extra.get(STATE, {}))

    def computed(question: str, state: SearchState, generation: int, *more: Any) -> Any:
        try:
            return _answer(question, *request(state, generation), *more)
        except _RefusedError as error:
            made = ".".join(map(str, state.extra[VERSION].tolist())) if VERSION in state.extra else version
            text = f"generation {generation}: {error}; evosax {made} has made this state"
            raise EvaluationError(text, field="search.algorithm", value=search.algorithm) from error

    def ask(state: SearchState, generation: int) -> tuple[PolicyAsk, ...]:
        return (PolicyAsk(computed("ask", state, generation)),)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        told = in_columns(evaluations)
        if told.generation == 0 or not told.valid_N.any():
            return state
        is_known_N = told.valid_N & np.isfinite(told.fitness_N)
        fitness_N = invalid_lowest(np.where(is_known_N, told.fitness_N, np.nan))
        if "population" in arrays:
            fitness_N = _none_unknown_best(fitness_N, is_known_N)
        now, centre_D = computed("tell", state, told.generation, fitness_N)
        numbers = np.array([int(number) for number in re.findall(r"\d+", version)], np.int64)
        centre = replace(state.centres[0], centre_D=centre_D)
        return replace(state, centres=(centre,), extra=read_only({**state.extra, STATE: now, VERSION: numbers}))

    return Algorithm(ask, tell, metrics={"sigma": _mean_sigma} if "std" in arrays else {})


def _none_unknown_best(fitness_N: NDArray[np.float64], is_known_N: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The same fitness; but if it is equal everywhere, as where no reward is found yet, that of unknown members is a
    millionth lower. Of equal members evosax takes the first for the best one, which is the centre."""
    if np.ptp(fitness_N.astype(np.float32)) or is_known_N.all() or not is_known_N.any():
        return fitness_N
    return np.where(is_known_N, fitness_N, fitness_N - 1e-6 * np.maximum(np.abs(fitness_N), 1.0))


def _mean_sigma(state: SearchState) -> float:
    """Mean standard deviation of the optimiser's distribution; NaN before its first generation."""
    arrays: Mapping[str, Any] = state.extra.get(STATE, {})
    return float(np.mean(arrays["std"], dtype=np.float64)) if arrays else np.nan


# The process of the optimisers: one for each process of ours, which starts it with the first question.


class _RefusedError(Exception):
    """The process has refused a question, with the reason as the message."""


class _Optimisers:
    """Asks the process, one question after another. A question is a pure function, so it may be asked again."""

    def __init__(self) -> None:
        self._child: Child | None = None
        self._turn = Lock()

    def answer(self, question: tuple[Any, ...]) -> Any:
        with self._turn:
            with suppress(NoAnswerError):  # perhaps somebody has killed it
                return self._of_child(question)
            return self._of_child(question)

    def _of_child(self, question: tuple[Any, ...]) -> Any:
        if self._child is None or not self._child.is_running:
            self._child = Child("workers.strategies", child_environment())
            self._child.call(LIBRARY)
        return self._child.call(*question)


@cache
def _optimisers(process: int) -> _Optimisers:
    """Those of a process; one that was forked starts its own."""
    return _Optimisers()


def _answer(*question: Any) -> Any:
    """What the process answers.

    Raises:
        _RefusedError: it refuses; the reason is a sentence. EvaluationError: it has failed.
    """
    try:
        kind, answer = _optimisers(os.getpid()).answer(question)
    except NoAnswerError as error:
        raise EvaluationError(f"the process of {LIBRARY} {error}", field="search.algorithm") from error
    except RaisedError as error:
        raise EvaluationError(f"{LIBRARY} raised an error:\n{error}", field="search.algorithm") from error
    if kind == "refused":
        raise _RefusedError(answer)
    return answer
