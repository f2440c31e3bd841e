"""What every search algorithm is made of: its state, its plan, its functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from es_service.optimizer import Adam
from es_service.protocol import EpisodesResult, FloatArray


@dataclass(frozen=True)
class Member:
    """One centre with its optimiser. A meta-population has several, plain ES one."""

    centre_D: FloatArray
    adam: Adam


@dataclass(frozen=True)
class SearchState:
    """All that a search remembers between generations."""

    members: tuple[Member, ...]


@dataclass(frozen=True)
class Plan:
    """What to evaluate in this generation: the population around one member's centre."""

    member: int
    centre_D: FloatArray


@dataclass(frozen=True)
class Algorithm:
    """The functions of one method. All are pure."""

    start: Callable[[FloatArray], SearchState]
    """Initial centre -> state before the first generation."""
    plan: Callable[[SearchState], Plan]
    weights: Callable[[SearchState, EpisodesResult], NDArray[np.float32]]
    """The whole population's results (axes P, S) -> weight of each pair's noise [P]."""
    step: Callable[[SearchState, Plan, FloatArray], SearchState]
    """(state, plan, gradient estimate [D]) -> state with the planned member moved."""


def member_part(index: int) -> str:
    """Name of a member's part in the run store."""
    return f"member_{index}"


def member_to_arrays(member: Member) -> dict[str, np.ndarray]:
    """A member as the store keeps it."""
    adam = member.adam
    return {
        "centre_D": member.centre_D,
        "adam_m_D": adam.m_D,
        "adam_v_D": adam.v_D,
        "adam_step": np.asarray(adam.step, np.int64),
    }


def member_from_arrays(arrays: Mapping[str, np.ndarray]) -> Member:
    """Inverse of `member_to_arrays`."""
    adam = Adam(arrays["adam_m_D"], arrays["adam_v_D"], int(arrays["adam_step"]))
    return Member(arrays["centre_D"], adam)
