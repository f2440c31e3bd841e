"""Functions of users as tasks without a policy, named `function:package.module:name`. A function gets its parameters:

    def beam(parameters):                    # float64 [D]
        return -weight                       # fitness, or (fitness, descriptor)

    beam.parameters = {"width": (0.1, 2.0), "height": (0.1, 2.0)}    # name -> bounds, None for a parameter without

What a search moves is one number for each parameter: where there are bounds, -1 and 1 stand for them, and what is
beyond is evaluated at the bound; elsewhere it is the parameter itself. So `search.sigma` is in half ranges. The search
starts at `start`. A function may have these attributes, too:

- `parameters` as a number: that many without names and bounds; or a tuple of names;
- `start`: a mapping from names to values, or one value for each; else the middle of the bounds, or 0;
- `descriptor_names` and `descriptor_bounds`, tuples: the function returns (fitness, descriptor). Without them the
  descriptor is the first two parameters;
- `deterministic = True`: equal parameters have equal results, so that a search evaluates each once;
- `least_fitness`: the fitness from which QD-scores are counted;
- `metric_names`, a tuple of names: the function returns as many numbers at the end, as one tuple or list, (fitness,
  metrics) or (fitness, descriptor, metrics). The run records them as columns `metric_NAME`; NaN is no number;
- a docstring, whose first line `es-service` shows.

If a function has an argument `seed`, it gets a whole number below 2^31 that belongs to the episode, for random numbers
that repeat. `name` may also be a class with these attributes and with `options`, as in
`workers.environments.user_task`, whose objects are called.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.episodes import METRIC_FORM, wrong_metric_names
from es_service.protocol.messages import Bounds, FloatArray, TaskSpec
from es_service.protocol.options import FREE, OptionValue, ParameterSpec, declared_options
from workers.environments import TaskError
from workers.environments.declared import (
    are_finite,
    clashes,
    construct,
    finite_bounds,
    import_named,
    unknown_attributes,
    wrong_pairs,
)

PREFIX = "function:"
SHOWN = 2
"""Parameters that are the descriptor of a function without one."""
DESCRIPTOR = ("descriptor_names", "descriptor_bounds")
KNOWN = ("parameters", "start", *DESCRIPTOR, "deterministic", "least_fitness", "options", "metric_names")


@dataclass(frozen=True)
class FunctionTask:
    """A function of parameters, as the rollout sees it."""

    name: str
    parameters: ParameterSpec
    descriptor_size: int
    has_descriptor: bool
    """Whether the function returns a descriptor; else it is the first parameters."""
    takes_seed: bool
    metrics: int
    """How many metrics the function returns."""
    call: Callable[..., Any]

    def __call__(self, parameters_D: FloatArray, seed: int) -> tuple[float, NDArray[np.float32], NDArray[np.float32]]:
        """(fitness, descriptor [B], metrics [M]) of search parameters.

        Raises whatever the function raises, and TaskError for a result of another form.
        """
        point_D = self.parameters.values(parameters_D)
        result = self.call(point_D.copy(), **({"seed": seed} if self.takes_seed else {}))
        sizes = {"descriptor": self.descriptor_size} if self.has_descriptor else {}
        sizes |= {"metrics": self.metrics} if self.metrics else {}
        if sizes and not (isinstance(result, tuple | list) and len(result) == 1 + len(sizes)):
            forgotten = "; is a `return` missing?" if result is None else ""
            must = ", ".join(["fitness", *sizes])
            raise TaskError(f"{self.name} returned {result!r}; it must return ({must}){forgotten}")
        fitness, *others = result if sizes else (result,)
        given = {what: self._numbers(what, value, sizes[what]) for what, value in zip(sizes, others, strict=True)}
        first_B = point_D[: self.descriptor_size].astype(np.float32)
        no_metrics = np.zeros(0, np.float32)
        return _number(fitness, self.name), given.get("descriptor", first_B), given.get("metrics", no_metrics)

    def _numbers(self, what: str, value: Any, size: int) -> NDArray[np.float32]:
        try:
            array_N = np.asarray(value, np.float32).reshape(-1)
        except (TypeError, ValueError):
            raise TaskError(f"{self.name} returned the {what} {value!r}; it must be numbers") from None
        if array_N.size != size:
            raise TaskError(f"{self.name} returned {what} of size {array_N.size}, not {size}")
        return array_N


def describe(path: str) -> TaskSpec:
    """Description of a user's function as a task. It is not called, since a call may take long.

    Raises:
        TaskError: the function cannot be imported, or its attributes are missing or wrong.
    """
    function, name = import_named(path, "function"), PREFIX + path
    if not callable(function):
        raise TaskError(f"{name} is no function, but {function!r}")
    if inspect.isclass(function) and not any("__call__" in vars(base) for base in function.__mro__):
        hint = f"; did you mean python:{path}?" if hasattr(function, "step") else ""
        raise TaskError(f"{name} is a class without __call__, so its objects are no functions{hint}")
    if not hasattr(function, "parameters"):
        raise TaskError(
            f"{name} has no attribute parameters; workers/environments/function_task.py lists what a function may have"
        )
    options, wrong = declared_options(function)
    parameters, problems = _parameters(function)
    wrong += problems
    names, bounds = (), ()
    if parameters is not None:
        names, bounds = _descriptor(function, parameters)
        if not (isinstance(names, tuple) and isinstance(bounds, tuple) and len(names) == len(bounds) > 0):
            wrong.append(
                f"descriptor_names = {names!r} and descriptor_bounds = {bounds!r} are not tuples of one length"
            )
        else:
            wrong += wrong_pairs("descriptor_bounds", bounds) + clashes(tuple(map(str, names)))
    metrics = getattr(function, "metric_names", ())
    if not isinstance(metrics, tuple) or wrong_metric_names(metrics):
        wrong.append(f"metric_names = {metrics!r} is not a tuple of different names of {METRIC_FORM}")
    least = getattr(function, "least_fitness", None)
    if least is not None and not are_finite((least,)):
        wrong.append(f"least_fitness = {least!r} is not a finite number")
    if wrong or parameters is None:
        raise TaskError(f"{name}: {'; '.join(wrong)}")
    return TaskSpec(
        name=name,
        observation_size=1,
        action_size=len(parameters.names),
        episode_steps=1,
        descriptor_names=tuple(map(str, names)),
        descriptor_bounds=tuple((float(low), float(high)) for low, high in bounds),
        final_fitness=False,
        has_goal=False,
        options=options,
        summary=(function.__doc__ or "").strip().partition("\n")[0],
        least_reward=least,
        kind="function",
        parameters=parameters,
        deterministic=bool(getattr(function, "deterministic", False)),
        notes=unknown_attributes(name, function, KNOWN),
        metric_names=metrics,
    )


def make(path: str, options: Mapping[str, OptionValue]) -> FunctionTask:
    """A user's function as a task; one of a class is an object with the task's options."""
    function = import_named(path, "function")
    parameters, wrong = _parameters(function)
    if parameters is None:
        raise TaskError(f"{PREFIX}{path}: {'; '.join(wrong)}")
    call: Any = construct(function, options) if inspect.isclass(function) else function
    return FunctionTask(
        name=PREFIX + path,
        parameters=parameters,
        descriptor_size=len(_descriptor(function, parameters)[0]),
        has_descriptor=hasattr(function, DESCRIPTOR[0]),
        metrics=len(getattr(function, "metric_names", ())),
        takes_seed="seed" in inspect.signature(call).parameters,
        call=call,
    )


def _number(value: Any, name: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        forgotten = "; is a `return` missing?" if value is None else ""
        raise TaskError(f"{name} returned the fitness {value!r}; it must be a number{forgotten}") from None


def _descriptor(function: Any, parameters: ParameterSpec) -> tuple[Any, Any]:
    """Names and bounds of the descriptor."""
    if any(hasattr(function, attribute) for attribute in DESCRIPTOR):
        return getattr(function, DESCRIPTOR[0], None), getattr(function, DESCRIPTOR[1], None)
    bounds: Bounds = tuple(finite_bounds(*pair) for pair in parameters.bounds[:SHOWN])
    return parameters.names[:SHOWN], bounds


def _plain(pair: Any) -> Any:
    """A pair with Python's numbers in the place of NumPy's."""
    return tuple(x.item() if isinstance(x, np.generic) else x for x in pair) if isinstance(pair, tuple) else pair


def _parameters(function: Any) -> tuple[ParameterSpec | None, list[str]]:
    """Parameters that a function declares, and problems of the declaration."""
    given = function.parameters
    if isinstance(given, int | np.integer) and not isinstance(given, bool):
        given = tuple(f"x{index}" for index in range(given))
    if isinstance(given, tuple):
        given = dict.fromkeys(given)
    if not isinstance(given, Mapping) or not given or not all(isinstance(name, str) for name in given):
        return None, [f"parameters = {given!r} is not a mapping from names to bounds, nor a tuple of names or a number"]
    bounds = tuple(FREE if pair is None else _plain(pair) for pair in given.values())
    wrong = wrong_pairs("parameters", tuple(pair for pair in bounds if pair != FREE))
    if wrong:
        return None, wrong
    middle = {name: 0.0 if pair == FREE else (pair[0] + pair[1]) / 2 for name, pair in zip(given, bounds, strict=True)}
    start = getattr(function, "start", middle)
    if not isinstance(start, Mapping):
        values = list(start) if isinstance(start, list | tuple | np.ndarray) else []
        if len(values) != len(given):
            return None, [f"start = {start!r} has not one value for each of the {len(given)} parameters"]
        start = dict(zip(given, values, strict=True))
    if unknown := [name for name in start if name not in given]:
        return None, [f"start has {', '.join(map(str, unknown))}, which is none of the parameters"]
    try:
        begun = tuple(float(value) for value in {**middle, **start}.values())
    except (TypeError, ValueError, OverflowError):
        return None, [f"start = {start!r} has values that are no numbers"]
    for name, value, (low, high) in zip(given, begun, bounds, strict=True):
        if not (math.isfinite(value) and low <= value <= high):
            wrong.append(f"start of {name} = {value:g} is not between its bounds {low:g} and {high:g}")
    return (None, wrong) if wrong else (ParameterSpec(tuple(given), tuple(bounds), begun), [])
