"""Strategies of evosax as pure functions of named arrays, in a process of their own.

    python -m workers.strategies DESCRIPTOR     # run by `es_service.protocol.child`

The driver loads no JAX. In a caller's program JAX may have other settings, such as float64, a GPU or more threads, and
each of them changes bits; this process has those of a worker.

A strategy is made from its settings, and its state is the leaves of evosax's state by their names, such as `mean` and
`opt_state.0.mu`. No arrays stand for the state before the first generation: a strategy with a distribution then begins
with the given centre as its mean. One with a population begins with normal variates around the centre, which are its
first generation.

Keys are those of `jax.random.key(seed)`, folded in with the number of the generation and split into two, for `ask` and
for `tell`; `init` has the key of generation 0. Fitness is maximised here, and minimised by evosax.

Axes: N members, D parameters.
"""

from __future__ import annotations

import inspect
import math
import os
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import answer_parent
from workers.compiling import xla_cache_settings

Arrays = Mapping[str, NDArray[Any]]
SIZES = ((8, 4), (16, 7))
"""Two numbers of members and of parameters: what differs between them is computed from these numbers."""
SIGMA = "std_init"
"""Parameter of evosax that is the first standard deviation."""
SCHEDULE, OPTIMIZER = "std_schedule", "optimizer"
"""Arguments of evosax with a standard deviation as a function of the generation, and with an optimiser of optax."""
RATE = "learning_rate"
"""Our option beside `OPTIMIZER`: evosax takes both in one object."""
PLAIN = (bool, int, float)


class RefusedError(Exception):
    """The message says what a strategy cannot be, or what it cannot continue."""


class Settings(NamedTuple):
    """What a strategy is made from."""

    name: str
    """That of evosax, such as `CMA_ES`."""
    members: int
    parameters: int
    sigma: float | None
    options: tuple[tuple[str, Any], ...]
    """Those that differ from the defaults of evosax."""


class Strategy(NamedTuple):
    """An algorithm of evosax with its parameters."""

    algorithm: Any
    params: Any
    sigma: float | None
    has_population: bool
    """Whether it begins with an evaluated population instead of a mean."""


def described(name: str) -> dict[str, Any]:
    """What a config may say about an algorithm of evosax.

    Returns:
        `options`: name -> (type, default), None as the default of what evosax computes from the sizes; `optimizers`:
        the values of the option `optimizer`, if there is one; `has_sigma`: whether it has a first standard deviation;
        `version` of evosax.

    Raises:
        RefusedError: it needs an argument that no config can give.
    """
    kind = _kinds()[name]
    arguments = _arguments(kind)
    if needed := [key for key, argument in arguments.items() if argument.default is inspect.Parameter.empty]:
        raise RefusedError(f"evosax:{name} needs {' and '.join(needed)}, which no config can give")
    first, second = (vars(kind(members, np.zeros(size, np.float32)).default_params) for members, size in SIZES)
    plain = {key: argument.default for key, argument in arguments.items() if isinstance(argument.default, PLAIN)}
    options: dict[str, tuple[str, Any]] = {key: (type(value).__name__, value) for key, value in plain.items()}
    for key in first:
        value, other = _number(first[key]), _number(second[key])
        if value is not None and key != SIGMA:
            is_fixed = value == other and math.isfinite(value)
            options[key] = type(value).__name__, value if is_fixed else None
    return {
        "options": options,
        "optimizers": sorted(_optimizers()) if OPTIMIZER in arguments else [],
        "has_sigma": SIGMA in first or SCHEDULE in arguments or _has_population(kind),
        "version": metadata.version("evosax"),
    }


def _kinds() -> Mapping[str, Any]:
    from evosax import algorithms

    return {kind.__name__: kind for kind in algorithms.algorithms.values()}


def _optimizers() -> Mapping[str, Callable[[float], Any]]:
    """Optimisers of which a learning rate is all that must be given."""
    import optax
    from evosax.core.optimizer import clipup

    return {"adam": optax.adam, "adamw": optax.adamw, "clipup": clipup, "rmsprop": optax.rmsprop, "sgd": optax.sgd}


def _arguments(kind: Any) -> dict[str, inspect.Parameter]:
    """Arguments with which an algorithm is made, but for those that all have."""
    from evosax.algorithms.base import EvolutionaryAlgorithm

    common = inspect.signature(EvolutionaryAlgorithm).parameters
    return {key: it for key, it in inspect.signature(kind).parameters.items() if key not in common}


def _has_population(kind: Any) -> bool:
    from evosax.algorithms.population_based.base import PopulationBasedAlgorithm

    return issubclass(kind, PopulationBasedAlgorithm)


def _number(value: Any) -> bool | int | float | None:
    """A parameter that is one number, as Python has it; else None."""
    if isinstance(value, PLAIN):
        return value
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else None


@lru_cache(maxsize=8)
def strategy(settings: Settings) -> Strategy:
    """The strategy with these settings.

    Raises:
        RefusedError: evosax refuses them.
    """
    import optax

    kind, options = _kinds()[settings.name], dict(settings.options)
    arguments = {key: options.pop(key) for key in _arguments(kind) if key in options and key != OPTIMIZER}
    if (optimizer := options.pop(OPTIMIZER, None)) is not None:
        arguments[OPTIMIZER] = _optimizers()[optimizer](options.pop(RATE))
    if settings.sigma is not None and SCHEDULE in _arguments(kind):
        arguments[SCHEDULE] = optax.constant_schedule(settings.sigma)
    try:
        made = kind(settings.members, np.zeros(settings.parameters, np.float32), **arguments)
        params = made.default_params
    except (AssertionError, ValueError, TypeError, ZeroDivisionError) as error:
        what = f"{settings.members} members, {settings.parameters} parameters and these options"
        raise RefusedError(f"evosax:{settings.name} refuses {what}: {error}") from error
    if settings.sigma is not None and hasattr(params, SIGMA):
        options[SIGMA] = settings.sigma
    return Strategy(made, params.replace(**options), settings.sigma, _has_population(kind))


def keys(seed: int, generation: int) -> tuple[Any, Any]:
    """The keys of `ask` and of `tell` in a generation."""
    import jax

    return tuple(jax.random.split(_key(seed, generation)))


def _key(seed: int, generation: int) -> Any:
    """The key of a generation; a seed above 32 bits has both of its halves in it."""
    import jax

    words = jax.numpy.asarray(np.array([seed >> 32, seed & 0xFFFFFFFF], np.uint32))
    return jax.random.fold_in(jax.random.wrap_key_data(words, impl="threefry2x32"), generation)


def form(settings: Settings) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Name of each array of the state -> its type and shape."""
    return {name: (str(leaf.dtype), leaf.shape) for name, leaf in _leaves(_state_form(settings)).items()}


@lru_cache(maxsize=8)
def _state_form(settings: Settings) -> Any:
    """A state without values."""
    import jax

    made = strategy(settings)
    algorithm, mean_D = made.algorithm, np.zeros(made.algorithm.num_dims, np.float32)
    key = _key(0, 0)
    if made.has_population:
        population_N_D = np.zeros((algorithm.population_size, algorithm.num_dims), np.float32)
        fitness_N = np.zeros(algorithm.population_size, np.float32)
        state = jax.eval_shape(algorithm.init, key, population_N_D, fitness_N, made.params)
    else:
        state = jax.eval_shape(algorithm.init, key, mean_D, made.params)
    members = jax.eval_shape(algorithm.ask, key, state, made.params)[0].shape[0]
    if members != settings.members:
        raise RefusedError(f"evosax:{settings.name} asks for {members} members instead of {settings.members}")
    return state


def _leaves(state: Any) -> dict[str, Any]:
    from jax.tree_util import keystr, tree_flatten_with_path

    return {keystr(path, simple=True, separator="."): leaf for path, leaf in tree_flatten_with_path(state)[0]}


def _arrays(state: Any) -> dict[str, NDArray[Any]]:
    return {name: np.asarray(leaf) for name, leaf in _leaves(state).items()}


def _state(settings: Settings, arrays: Arrays) -> Any:
    """The state of evosax with these arrays.

    Raises:
        RefusedError: they are not those of this strategy.
    """
    from jax.tree_util import tree_structure, tree_unflatten

    expected = form(settings)
    given = {name: (str(array.dtype), array.shape) for name, array in arrays.items()}
    if given != expected:
        names = sorted(name for name in {*given, *expected} if given.get(name) != expected.get(name))
        first = names[0]
        was, now = (_in_words(forms.get(first)) for forms in (given, expected))
        raise RefusedError(
            f"the stored state of evosax:{settings.name} does not fit: its {first} is {was}, and must be {now} for "
            f"evosax {metadata.version('evosax')}, {settings.members} members and {settings.parameters} parameters"
        )
    return tree_unflatten(tree_structure(_state_form(settings)), [arrays[name] for name in expected])


def _in_words(form: tuple[str, tuple[int, ...]] | None) -> str:
    return "missing" if form is None else f"{form[0]} {form[1]}"


class Strategies:
    """Answers about strategies, which remember nothing but the newest population: `tell` needs that of `ask` again."""

    def __init__(self) -> None:
        self._newest: tuple[object, Any, Any] = (None, None, None)

    def asked(self, settings: Settings, seed: int, generation: int, centre_D: Any, arrays: Arrays) -> tuple[Any, Any]:
        """The population [N, D] of a generation, and the state of evosax with it; None for its first population."""
        import jax

        request = settings, seed, generation, centre_D.tobytes(), {name: it.tobytes() for name, it in arrays.items()}
        if self._newest[0] == request:
            return self._newest[1:]
        made, (ask_key, _) = strategy(settings), keys(seed, generation)
        if not arrays and made.has_population:
            shape = made.algorithm.population_size, made.algorithm.num_dims
            state, population_N_D = None, centre_D + np.float32(made.sigma) * jax.random.normal(ask_key, shape)
        else:
            begun = _state(settings, arrays or _arrays(made.algorithm.init(_key(seed, 0), centre_D, made.params)))
            population_N_D, state = made.algorithm.ask(ask_key, begun, made.params)
        self._newest = request, population_N_D, state
        return population_N_D, state

    def ask(self, *request: Any) -> NDArray[np.float32]:
        """The population [N, D] of a generation; arguments as of `asked`."""
        return np.asarray(self.asked(*request)[0])

    def tell(
        self, settings: Settings, seed: int, generation: int, centre_D: Any, arrays: Arrays, fitness_N: Any
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32]]:
        """The state after a generation, and the centre [D]: the mean, or the best member so far.

        Args:
            fitness_N: fitness of the population, finite; higher is better.
        """
        made, (_, tell_key) = strategy(settings), keys(seed, generation)
        population_N_D, state = self.asked(settings, seed, generation, centre_D, arrays)
        cost_N = -np.asarray(fitness_N, np.float32)
        if state is None:
            state = made.algorithm.init(_key(seed, 0), population_N_D, cost_N, made.params)
        else:
            state, _ = made.algorithm.tell(tell_key, population_N_D, cost_N, state, made.params)
        centre = state.best_solution if made.has_population else made.algorithm.get_mean(state)
        return _arrays(state), np.asarray(centre, np.float32)


def answers(library: str) -> Callable[..., tuple[str, Any]]:
    """Function that answers questions: ("answer", what it is), or ("refused", why not).

    Args:
        library: evosax, the package whose frames an error has.
    """
    strategies = Strategies()
    functions: dict[str, Callable[..., Any]] = {
        "names": lambda: sorted(_kinds()),
        "describe": described,
        "form": lambda settings: form(Settings(*settings)),
        "ask": lambda settings, *request: strategies.ask(Settings(*settings), *request),
        "tell": lambda settings, *request: strategies.tell(Settings(*settings), *request),
    }

    def answer(question: str, *request: Any) -> tuple[str, Any]:
        try:
            return "answer", functions[question](*request)
        except RefusedError as error:
            return "refused", str(error)

    return answer


if __name__ == "__main__":
    # Most of what is compiled here are single operations, which together take seconds.
    os.environ.update(xla_cache_settings() | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"})
    answer_parent(int(sys.argv[1]), answers)
