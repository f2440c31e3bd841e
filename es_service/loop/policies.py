"""Policies that are evaluated as they are: the chunks in which they travel to the workers.

Axes: N policies, E episodes, D policy parameters, O observation, T points of a trace, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from es_service.protocol.content import Policy
from es_service.protocol.messages import EpisodesResult, FloatArray, Policies, PolicyChunk, Work, with_subject
from es_service.protocol.noise import Domain
from es_service.protocol.policies import POLICY_SLOTS, chunks_of
from es_service.protocol.policy_spec import PolicySpec
from es_service.protocol.recipes import Recipes


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
