"""Policies and traces by name, and the chunks in which policies travel to the workers.

Axes: N evaluated centres and policies, T points of a trace, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.errors import EvaluationError, StoreError
from es_service.protocol.content import NAME, Arrays, Cache, Policy, as_bytes, name_of, names, policy_of
from es_service.protocol.messages import Centre, EpisodesResult, FloatArray, Policies, PolicyChunk, Work, with_subject
from es_service.protocol.noise import Domain
from es_service.protocol.policies import POLICY_SLOTS, Origin, Recipes, chunks_of, unvaried
from es_service.protocol.policy_spec import PolicySpec
from es_service.search.algorithms.base import PolicyAsk
from es_service.search.arrays import freeze
from es_service.search.maps.behaviour_map import Elite

# Policies that are evaluated as they are: the chunks in which they travel to the workers.
#
# Axes: N policies, E episodes, D policy parameters, O observation, T points of a trace, B descriptor dimensions.


@dataclass(frozen=True)
class PolicyWork:
    """An ask for policies: the policies with their observation statistics, and the chunks in which they travel."""

    parameters_N_D: FloatArray | Recipes
    observation_mean_N_O: FloatArray
    observation_std_N_O: FloatArray
    episodes: int
    """Episodes of each policy."""
    work: list[Work]
    _made: dict[int, FloatArray] = field(default_factory=dict)
    """Parameters of policies that were made of their recipes here."""

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of the policies and of the episodes of each."""
        return len(self.parameters_N_D), self.episodes

    def policies(self, numbers: Sequence[int], spec: PolicySpec) -> list[Policy]:
        """Some of the policies, in arrays that are not parts of others; `spec`: what they are."""
        statistics = self.observation_mean_N_O, self.observation_std_N_O
        return [
            Policy(spec, parameters_D, *(array[number].copy() for array in statistics))
            for number, parameters_D in zip(numbers, self._parameters(numbers), strict=True)
        ]

    def _parameters(self, numbers: Sequence[int]) -> list[FloatArray]:
        if not isinstance(self.parameters_N_D, Recipes):
            return [self.parameters_N_D[number].copy() for number in numbers]
        if missing := [number for number in dict.fromkeys(numbers) if number not in self._made]:
            recipes = self.parameters_N_D.part(missing)
            self._made.update(zip(missing, (parameters_D.copy() for parameters_D in recipes.made()), strict=True))
        return [self._made[number] for number in numbers]


def policy_work(
    parameters_N_D: FloatArray | Recipes,
    statistics: tuple[FloatArray, FloatArray],
    episodes: int,
    *,
    seed: int,
    generation: int,
    ask: int = 0,
    request: int = 0,
    traces: bool = False,
    domain: Domain = Domain.EVALUATION_RESET,
) -> PolicyWork:
    """The chunks of policies with some number of episodes each.

    The reset of each episode depends on (seed, domain, generation, ask, number of the policy, number of the episode)
    alone.

    Args:
        parameters_N_D: parameters of each, or recipes.
        statistics: mean and standard deviation of observations, [N, O] each.
        request: index of the ask among all that is computed side by side.
    """
    work: list[Work] = []
    mean_N_O, std_N_O = statistics
    has_none = not (mean_N_O.any() or np.signbit(mean_N_O).any()) and bool((std_N_O == 1.0).all())
    for first in range(0, len(parameters_N_D), POLICY_SLOTS):
        of = slice(first, first + POLICY_SLOTS)
        given = (
            parameters_N_D.some(of) if isinstance(parameters_N_D, Recipes) else np.ascontiguousarray(parameters_N_D[of])
        )
        of_each = () if has_none else (np.ascontiguousarray(array[of]) for array in statistics)
        policies = Policies(first, episodes, seed, traces, given, *of_each, domain=domain)
        parts = range(chunks_of(len(policies.parameters_N_D), episodes))
        work += with_subject(
            policies, [PolicyChunk(generation, len(work) + part, ask, part, request=request) for part in parts]
        )
    return PolicyWork(parameters_N_D, *statistics, episodes, work)


def no_statistics(policies: int, observation_size: int) -> tuple[FloatArray, FloatArray]:
    """The observation statistics of policies that have none: mean 0 and standard deviation 1, [N, O] each."""
    shape = policies, observation_size
    return np.zeros(shape, np.float32), np.ones(shape, np.float32)


@np.errstate(invalid="ignore", over="ignore")  # an infinite value makes the policy invalid
def as_population(result: EpisodesResult) -> EpisodesResult:
    """The policies as members of a population: means over the episodes, with axis [N]."""
    return replace(
        result,
        fitness=result.fitness.mean(axis=1),
        returns=result.returns.mean(axis=1),
        descriptor=result.descriptor.mean(axis=1),
    )


RECENT_BYTES = 256 * 2**20
"""Most bytes that are kept of policies that the store has: 400 of an ant with a 256x256 policy are 155 MB."""
MOST_ORIGINS = 1 << 16
"""Most policies of which it is known how they were made."""


class Named:
    """The policies that a generation has evaluated, and their traces, which get names when something needs them."""

    def __init__(
        self, subjects: Sequence[Centre | PolicyWork], trace_N_T_B: NDArray[np.float32] | None, spec: PolicySpec
    ) -> None:
        """Name nothing yet; `subjects`: centres and asks for policies, which together are the N."""
        self._subjects, self._trace_N_T_B, self._spec = subjects, trace_N_T_B, spec
        self._known: dict[int, tuple[bytes, bytes]] = {}
        self.contents: dict[bytes, Arrays] = {}
        """Those that have a name."""
        self.origins: dict[bytes, Origin] = {}
        """How those of them that were made of recipes were made."""

    def names(self, rows: Sequence[int]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Names of the policies of some rows, and of their traces."""
        new = [row for row in dict.fromkeys(rows) if row not in self._known]
        for row, policy in self.policies(new).items():
            assert self._trace_N_T_B is not None, "an evaluation has a trace"
            self._known[row] = self._add(policy.content), self._add({"trace_T_B": self._trace_N_T_B[row].copy()})
        for work, numbers, rows_here in self._of_subjects(new):
            if isinstance(work, PolicyWork) and isinstance(work.parameters_N_D, Recipes):
                self.origins |= work.parameters_N_D.part(numbers).origins_of([self._known[row][0] for row in rows_here])
        return names(self._known[row][0] for row in rows), names(self._known[row][1] for row in rows)

    def policies(self, rows: Sequence[int]) -> dict[int, Policy]:
        """What was evaluated, by row, in arrays that are not parts of others."""
        found: dict[int, Policy] = {}
        for subject, numbers, here in self._of_subjects(rows):
            if isinstance(subject, Centre):
                of = subject.parameters_D, subject.observation_mean_O, subject.observation_std_O
                policies = [Policy(self._spec, *of)]
            else:
                policies = subject.policies(numbers, self._spec)
            found |= zip(here, policies, strict=True)
        return found

    def _of_subjects(self, rows: Sequence[int]) -> Iterator[tuple[Centre | PolicyWork, list[int], list[int]]]:
        """(a centre or an ask for policies, numbers of its policies, their rows), of those that have some of `rows`."""
        first = 0
        for subject in self._subjects:
            end = first + (1 if isinstance(subject, Centre) else len(subject.parameters_N_D))
            if here := [row for row in rows if first <= row < end]:
                yield subject, [row - first for row in here], here
            first = end

    def _add(self, content: Arrays) -> bytes:
        freeze(content.values())
        name = name_of(content)
        self.contents[name] = content
        return name


class StatePolicies:
    """The policies that a state names. Those of the newest generation need not be stored yet."""

    def __init__(self, read: Callable[[bytes], Arrays], most_bytes: int = RECENT_BYTES) -> None:
        """Keep nothing yet.

        Args:
            read: returns a content that is stored; raises KeyError if there is none of this name.
        """
        self._read, self._most_bytes = read, most_bytes
        self._kept: Cache[bytes, Arrays] = Cache(lambda content: sum(array.nbytes for array in content.values()))
        self._newest: Mapping[bytes, Arrays] = {}
        self._origins: dict[bytes, Origin] = {}

    def add(self, contents: Mapping[bytes, Arrays], origins: Mapping[bytes, Origin]) -> None:
        """Take in those of a new generation, and how they were made. Those of the one before are stored."""
        self._newest = contents
        for name, content in contents.items():
            self._kept.add(name, content)
        self._kept.forget_oldest(self._most_bytes)
        self._origins |= origins
        for name in [*islice(self._origins, max(0, len(self._origins) - MOST_ORIGINS))]:
            del self._origins[name]

    def of(self, wanted: Sequence[bytes]) -> dict[bytes, Arrays]:
        """Contents by their names. Raises KeyError if there is none of one name.

        One that is read takes the place of none that was asked for with it: a batch of mutants asks for nearly the
        whole map, and if that is too large, each elite would otherwise be gone when it is needed.
        """
        asked, kept = dict.fromkeys(wanted), self._kept
        kept.use(asked)
        found: dict[bytes, Arrays] = {}
        for name in asked:
            content = self._newest.get(name) or kept.get(name)
            if content is None:
                content = self._read(name)
                freeze(content.values())
            if name not in kept:
                kept.add(name, content)
                kept.forget_oldest(self._most_bytes, spared=asked)
                if kept.nbytes > self._most_bytes:
                    kept.forget(name)
            found[name] = content
        return found

    def policy(self, name: bytes, spec: PolicySpec) -> Policy:
        return stored_policy(spec, self.of([name])[name])

    def completed(self, asked: object, generation: int) -> object:
        """What a search asks for, with the parameters of the policies that it names.

        Raises:
            EvaluationError: it names a policy that nothing in the state before names.
        """
        if not isinstance(asked, tuple):
            return asked
        try:
            return tuple(self.policies(ask) if isinstance(ask, PolicyAsk) else ask for ask in asked)
        except KeyError as error:
            name = error.args[0].hex()
            text = f"generation {generation}: `ask` names the policy {name}, which nothing in the state names"
            raise EvaluationError(text, field="search.algorithm") from error

    def policies(self, ask: PolicyAsk) -> PolicyAsk:
        """Policies that are asked for, with the parameters of those that are named. Raises KeyError as `of`."""
        policies = ask.parameters_N_D
        if isinstance(policies, Recipes):
            if policies.parents:
                return ask
            known = {name: content["parameters_D"] for name, content in self.of(policies.names).items()}
            return replace(ask, parameters_N_D=policies.complete(known, self._origins))
        if not isinstance(policies, np.ndarray) or policies.dtype != NAME:
            return ask
        wanted = as_bytes(policies)
        contents = self.of(wanted)
        arrays = ("observation_mean_O", "observation_std_O")
        statistics = (np.stack([contents[name][array] for name in wanted]) for array in arrays)
        known = {name: content["parameters_D"] for name, content in contents.items()}
        return PolicyAsk(unvaried(policies).complete(known, self._origins), *statistics)


def stored_policy(spec: PolicySpec, content: Arrays) -> Policy:
    """The policy of a content that a state names as one. Raises StoreError if it is something else."""
    try:
        return policy_of(spec, content)
    except KeyError as error:
        raise StoreError("a name in the state is not that of a policy") from error


def stored_elite(spec: PolicySpec, content: Arrays, trace: Arrays) -> Elite:
    """The elite of a policy as it is stored, and of a trace. Raises StoreError if they are something else."""
    policy = stored_policy(spec, content)
    if "trace_T_B" not in trace:
        raise StoreError("a name in the state is not that of a trace")
    return Elite(**vars(policy), trace_T_B=trace["trace_T_B"])
