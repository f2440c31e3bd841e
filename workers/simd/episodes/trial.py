"""A short trial of a task in which products with 0 are computed and not folded: where JAX has NaN and simd a number.

In the code of simd, x * 0 is 0 (`graph/folding.py`); in JAX it is NaN where x is NaN or infinite. So each lane of a
trial is computed twice, side by side: as in JAX, and with 0 for these products. The two differ only after such a
product. What `jnp.where` discards does not count, only what reaches the reward, the end, the observation, the
descriptor, the distance to the goal or the state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path

from es_service.protocol.messages import TaskSpec
from es_service.protocol.noise import KEY_WORDS, Domain, stream_keys
from es_service.protocol.options import OptionValue, option_values
from es_service.protocol.sources import user_path
from workers.environments import Environment, make_environment
from workers.rollouts.backend import Examination
from workers.simd.backend import cache
from workers.simd.backend.native import OWN_VERSION, pack, words_of
from workers.simd.episodes.check import output_words
from workers.simd.episodes.kernel import DRAWN
from workers.simd.episodes.rollout import training_program, why_not
from workers.simd.frontend.trace import draws, jaxpr_digest, trace_jaxpr
from workers.simd.frontend.tracer import line_of
from workers.simd.graph.graph import Graph, UnsupportedError, fault, reached
from workers.simd.graph.operations import OPERATIONS
from workers.simd.graph.schedule import evaluate

ACTIONS: dict[str, Callable[[int, int], Any]] = {
    "of 0": lambda size, step: np.zeros(size),
    "of 1": lambda size, step: np.ones(size),
    "of -1": lambda size, step: np.full(size, -1.0),
    "of 1.08": lambda size, step: np.full(size, 1.08),  # what 1 becomes at most by the default action noise
    "of -1.08": lambda size, step: np.full(size, -1.08),
    "of 1 and -1 by turns": lambda size, step: 1.0 - 2.0 * ((np.arange(size) + step) % 2),
    "of which one is 1 and the others 0": lambda size, step: np.arange(size) == step % size,
    "drawn from [-1, 1]": lambda size, step: np.random.default_rng(step).uniform(-1.0, 1.0, size),
}
"""Actions in words -> function (size, number of the step) of their values."""
LANES = 2 * len(ACTIONS)
"""Lanes as in JAX; as many beside them are as in simd."""
MOST_STEPS, MOST_OPERATIONS = 20, 300_000
"""A trial ends after so many steps, or after the step in which it has done so many operations. A step of an ant has
200,000, which take half a second."""
MOST_NODES = 500_000
"""Most nodes of a step that is tried, so that a task is described soon enough."""
KEY = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)


class _After(NamedTuple):
    """What a reset or a step gives, in the order in which it is looked at."""

    reward: Any
    done: Any
    observation: Any
    descriptor: Any
    goal_distance: Any
    state: Any


class _Traced(NamedTuple):
    """A function of an environment as a graph whose products with 0 are not folded."""

    graph: Graph
    outputs: list[int]
    names: list[str]
    """Name of each output, such as `observation[3]`."""
    products: frozenset[int]
    """Its products with a constant 0."""

    def places(self, field: str) -> list[int]:
        """Places of the outputs that belong to a field of `_After`."""
        return [place for place, name in enumerate(self.names) if name.partition("[")[0].partition(".")[0] == field]


FaultPlace = tuple[int, int]
"""(place of an output, lane) where something was found."""
Record = Callable[[int, Sequence[Any], Any], object]
"""Told of an operation by its node, its arguments and its result."""


def examine(task: TaskSpec, given: Mapping[str, OptionValue] = MappingProxyType({})) -> Examination:
    """Whether simd can compile a task's steps, and what a trial of them finds if they are a user's.

    The cache of kernels remembers the tasks of which there was nothing to say. Tests try the tasks of Brax.

    Args:
        given: values of options; the others have their defaults.
    """
    options = option_values(task.options, given)
    folder, key = cache.cache_folder(), _key(task, options)
    if not key or folder is None or not cache.trusted(folder):
        folder = None
    if folder is not None and cache.load(folder, key) is not None:
        return Examination()
    if why := why_not(task, options):
        return Examination(why)
    found = Examination()
    if user_path(task.name):
        try:
            found = try_out(task, make_environment(task.name, options))
        except UnsupportedError:  # without folding, it is too large
            found = Examination()
        except Exception as error:
            return Examination(notes=(f"{task.name}: {fault(error)}",))
    if folder is not None and found == Examination():
        cache.save(folder, key, b"")
    return found


def _key(task: TaskSpec, options: Mapping[str, OptionValue]) -> str:
    """Key of all on which `examine` depends; empty if that has no text."""
    try:
        environment = make_environment(task.name, options)
        reset = jax.make_jaxpr(environment.reset)(KEY)
        text = f"examined {training_program(task, options, environment).name} {jaxpr_digest(reset)} {OWN_VERSION}"
    except Exception:  # `why_not` tells what it is
        return ""
    return hashlib.sha256(text.encode()).hexdigest()


def try_out(task: TaskSpec, environment: Environment) -> Examination:
    """What is not finite in resets and some steps with extreme actions of a task that simd can compile.

    Raises:
        UnsupportedError: without folding, a step has too many operations.
    """
    notes: tuple[str, ...] = ()
    alive_L = np.ones(LANES, bool)
    for traced, words, values, step in _tried(task, environment):
        differs = _differ(values[:, :LANES], values[:, LANES:])  # whether JAX and simd have an output differently
        if (found := _first(differs & alive_L)) is not None:
            return Examination(hidden=_explained(traced, words, found, step, is_hidden=True), notes=notes)
        if not notes and (found := _not_finite(traced, values, alive_L)) is not None:
            where = _explained(traced, words, found, step, is_hidden=False)
            notes = (f"{task.name}: {where}; such episodes are invalid",)
        for done in traced.places("done"):
            alive_L &= values[done, :LANES] == 0
        if not alive_L.any():
            break
    return Examination(notes=notes)


def _tried(task: TaskSpec, environment: Environment) -> Iterator[tuple[_Traced, np.ndarray, np.ndarray, int]]:
    """(function, its input words, its output words, number of the step) of the reset, which is 0, and of the steps."""
    keys_L = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(LANES))
    try:
        may_draw = environment.compiles_drawn_resets
        traced = _traced(lambda key: _after(environment, environment.reset(key)), KEY, may_draw=may_draw)
        words = np.tile(keys_L.T, 2)
        values = _computed(traced, words)
        yield traced, words, values, 0
        state = values[traced.places("state")]
    except UnsupportedError:  # JAX computes it, and hides nothing
        leaves = jax.tree.leaves(jax.jit(jax.vmap(environment.reset))(keys_L))
        state = np.tile(pack(leaves, LANES)[0], 2)

    def stepped(state: Any, action_A: Any) -> _After:
        after, reward, done = environment.step(state, action_A)
        return _after(environment, after)._replace(reward=reward, done=done)

    action_A = jax.ShapeDtypeStruct((task.action_size,), jnp.float32)
    traced = _traced(stepped, jax.eval_shape(environment.reset, KEY), action_A)
    if len(traced.graph.keys) > MOST_NODES:
        raise UnsupportedError(f"more than {MOST_NODES:,} operations without folding")
    operations = 0

    def count(node: int, arguments: Sequence[Any], result: Any) -> None:
        nonlocal operations
        operations += 1

    for step in range(1, min(MOST_STEPS, task.episode_steps) + 1):
        rows_A = [kind(task.action_size, step) for kind in ACTIONS.values()]
        action_L_A = np.tile(np.asarray(rows_A, np.float32), (2 * LANES // len(ACTIONS), 1))
        words = np.concatenate([state, action_L_A.T.view(np.uint32)])
        values = _computed(traced, words, count)
        yield traced, words, values, step
        if operations > MOST_OPERATIONS:
            return
        state = values[traced.places("state")]


def _after(environment: Environment, state: Any) -> _After:
    seen = environment.observe(state), environment.descriptor(state), environment.goal_distance(state)
    return _After(None, None, *seen, state)


def _traced(function: Callable[..., _After], *arguments: Any, may_draw: bool = True) -> _Traced:
    closed, after = jax.make_jaxpr(function, return_shape=True)(*arguments)
    if not may_draw and draws(closed):
        raise UnsupportedError(DRAWN)
    graph, _, outputs = trace_jaxpr(closed, folds_zeros=False)
    names = []
    for path, leaf in tree_flatten_with_path(after)[0]:
        name = keystr(path).removeprefix(".")
        is_row = len(path) == 1 and leaf.shape
        names += [f"{name}[{place}]" if is_row else name for place in range(words_of(leaf))]
    products = {
        node
        for node, key in enumerate(graph.keys)
        if key[0] == "mul" and any(graph.constant(argument) == 0.0 for argument in graph.arguments(node))
    }
    return _Traced(graph, outputs, names, frozenset(products))


def _computed(traced: _Traced, words: np.ndarray, record: Record = lambda *_: None) -> np.ndarray:
    """Values of the outputs as words [output, 2 LANES], of which the second half has no NaN in products with 0."""

    def operation(node: int, arguments: Sequence[Any]) -> Any:
        name = traced.graph.keys[node][0]
        result = OPERATIONS[name].meaning(*arguments)  # without regard to denormal numbers
        if name == "fma":
            result = result.astype(np.float32)
        if node in traced.products:
            result[LANES:][np.isnan(result[LANES:])] = 0.0
        record(node, arguments, result)
        return result

    with np.errstate(all="ignore"):
        return output_words(evaluate(traced.graph, traced.outputs, words, operation, fuse=False))


def _differ(words: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Whether words differ, where NaN is equal to NaN. Integers with the bits of NaN count as such."""
    return (words != others) & ~(np.isnan(words.view(np.float32)) & np.isnan(others.view(np.float32)))


def _not_finite(traced: _Traced, values: np.ndarray, alive_L: np.ndarray) -> FaultPlace | None:
    """The first output of which an episode is invalid."""
    floats = np.array([traced.graph.dtypes[node] == "f" for node in traced.outputs])
    of_policy = np.isin(np.arange(len(floats)), traced.places("observation"))
    numbers = values[:, :LANES].view(np.float32)
    is_bad = np.isnan(numbers) | (np.isinf(numbers) & ~of_policy[:, None])  # a clip may bound an observation
    is_bad[[*np.flatnonzero(~floats), *traced.places("goal_distance"), *traced.places("state")]] = False
    return _first(is_bad & alive_L)


def _first(is_found: np.ndarray) -> FaultPlace | None:
    places, lanes = np.nonzero(is_found)
    return (int(places[0]), int(lanes[0])) if places.size else None


def _explained(traced: _Traced, words: np.ndarray, found: FaultPlace, step: int, *, is_hidden: bool) -> str:
    """What was found, in words, with the lines of the task from which it comes."""
    graph, (output, lane) = traced.graph, found
    differing: set[int] = set()
    not_finite: set[int] = set()
    begun: set[int] = set()

    def record(node: int, arguments: Sequence[Any], result: Any) -> None:
        """Note of the lane: nodes that differ, that are not finite, and of the latter those of finite arguments."""
        of_jax, of_simd = output_words([result[lane : lane + 1], result[LANES + lane : LANES + lane + 1]])
        if _differ(of_jax, of_simd).any():
            differing.add(node)
        if graph.dtypes[node] == "f" and not np.isfinite(result[lane]):
            not_finite.add(node)
            given = [x[lane] for x, argument in zip(arguments, graph.arguments(node), strict=True)
                     if graph.keys[argument][0] != "const"]  # fmt: skip
            if np.isfinite(np.asarray(given, np.float64)).all():
                begun.add(node)

    def behind(starts: Iterable[int], nodes: set[int]) -> set[int]:
        """Nodes on which `starts` depend through nodes of a set."""
        of_loops = ("carry", "result")
        return reached(
            starts, lambda node: [x for x in graph.needs(node) if x in nodes or graph.keys[x][0] in of_loops]
        )

    _computed(traced, words, record)
    starts, product = [traced.outputs[output]], ""
    if is_hidden:
        products = sorted(behind(starts, differing) & traced.products & differing)
        first = next((node for node in products if not {*graph.arguments(node)} & differing), products[0])
        starts, product = list(graph.arguments(first)), line_of(graph.places[first])
    origins = sorted(behind(starts, not_finite) & begun)
    origin = line_of(graph.places[origins[0]]) if origins else ""
    is_what = "depends on NaN"
    if graph.dtypes[traced.outputs[output]] == "f":
        number = _computed(traced, words)[output, lane : lane + 1].view(np.float32)
        is_what = "is NaN" if np.isnan(number).any() else "is infinite" if np.isinf(number).any() else is_what
    kinds = [*ACTIONS]
    where = f"in step {step} with actions {kinds[lane % len(kinds)]}" if step else "in the reset"
    return f"its {traced.names[output]} {is_what} {where}{_lines(origin, product)}"


def _lines(origin: str, product: str) -> str:
    if product and origin in ("", product):
        return f": {product} multiplies by 0 what is not finite"
    lines = f": what {origin} computes is not finite" if origin else ""
    return f"{lines}, and {product} multiplies it by 0" if product else lines
