"""Policies of recipes: machine code against the definition in NumPy, with every size of a last vector."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.policies import IsoLine, Recipes, recipes_of
from tests.workers.simd.rollouts import every_target
from workers.rollouts import BACKENDS
from workers.simd.backend.native import WrongCodeError
from workers.simd.backend.target import Target
from workers.simd.episodes import noise_kernels

RULES = (IsoLine(0.005, 0.05), IsoLine(0.0, 0.0), IsoLine(0.3, 0.0), IsoLine(3.7, 11.3))


def recipes(size: int, count: int = 9, rule: IsoLine = RULES[0], parents=None) -> Recipes:
    rng = np.random.default_rng(size)
    parents = parents if parents is not None else rng.normal(size=(5, size)).astype(np.float32)
    keys = stream_keys(3, Domain.VARIATION, size, np.arange(count))
    return recipes_of(rule, list(parents), rng.integers(len(parents), size=(count, 2)), keys)


def assert_equal(found: np.ndarray, wanted: np.ndarray) -> None:
    assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape)
    np.testing.assert_array_equal(found.view(np.uint32), wanted.view(np.uint32))


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("rule", RULES, ids=str)
def test_policies_have_the_bits_of_their_definition_at_every_width_and_size(rule, target: Target):
    made = noise_kernels.make_variation(target)
    for size in (1, 7, 8, 9, 15, 16, 17, 31, 32, 114, 4482):
        asked = recipes(size, rule=rule)
        assert_equal(made(asked), asked.made())
        assert_equal(made(asked.part([4])), asked.made()[4:5])


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_values_that_are_denormal_infinite_or_no_numbers_are_those_of_numpy(target: Target):
    """So the code that treats denormal numbers as zeros elsewhere is not used here."""
    kinds = np.array([1e-40, -1e-45, 0.0, -0.0, 1.0, 3e38, np.inf, np.nan, 1e-38], np.float32)
    parents = np.stack([np.roll(np.tile(kinds, 4), shift) for shift in range(4)])
    for rule, has_denormal in ((IsoLine(1e-41, 0.0), True), (IsoLine(0.0, 1e-3), True), (IsoLine(0.5, 0.5), False)):
        asked = recipes(36, rule=rule, parents=parents)
        with np.errstate(all="ignore"):
            wanted = asked.made()
        found = noise_kernels.make_variation(target)(asked)
        assert (np.isnan(found) == np.isnan(wanted)).all()
        assert_equal(np.nan_to_num(found), np.nan_to_num(wanted))
        assert (np.abs(wanted[wanted != 0.0]) < 1e-38).any() == has_denormal


def test_every_rollout_makes_the_same_policies():
    asked = recipes(100)
    for backend in BACKENDS.values():
        assert_equal(backend.made(asked), asked.made())


def test_parents_of_different_sizes_are_refused_before_memory_is_read():
    asked = recipes(100)
    with pytest.raises(ValueError, match="parents of one size"):
        noise_kernels.make_variation()(replace(asked, parents=(asked.parents[0][:50], *asked.parents[1:])))


def test_wrong_code_is_noticed_before_it_is_used():
    with pytest.raises(WrongCodeError, match="a policy made of its parents differ"):
        noise_kernels.check_variation(lambda asked: asked.made() + np.float32(1e-6))
