"""Policies by name: those of the newest generation, and those of the store, which are kept in memory as far as there is
room; and what a search asks for by name."""

import numpy as np
import pytest

from es_service.errors import EvaluationError
from es_service.loop.contents import StatePolicies
from es_service.protocol.content import Policy, name_of, names, policy_of
from es_service.protocol.policies import IsoLine, recipes_of
from es_service.protocol.policy_spec import PolicySpec
from es_service.search.algorithms.base import PolicyAsk

KILOBYTE = 1024
SPEC = PolicySpec((2, 2))


def content(value, kilobytes=1):
    return {"parameters_D": np.full(kilobytes * 256, value, np.float32)}


class Counting:
    """Contents of a store, and the names that were read."""

    def __init__(self):
        self.contents, self.read = {bytes([number]): content(number) for number in range(5)}, []

    def content(self, name):
        self.read += name
        return self.contents[name]


@pytest.fixture
def store():
    return Counting()


def values(contents, *numbers):
    return [found["parameters_D"][0] for found in contents.of([bytes([number]) for number in numbers]).values()]


def test_a_policy_that_was_read_needs_no_other_reading_until_there_is_no_room(store):
    contents = StatePolicies(store.content, most_bytes=3 * KILOBYTE)
    for number in (0, 1, 2, 0, 3, 0, 2, 1):
        assert values(contents, number) == [number]
    assert store.read == [0, 1, 2, 3, 1]  # 1 was not asked for the longest


def test_of_a_map_larger_than_the_room_only_the_rest_is_read_again(store):
    """As a batch of mutants asks for it, generation after generation."""
    contents = StatePolicies(store.content, most_bytes=3 * KILOBYTE)
    for _ in range(3):
        assert values(contents, 0, 1, 2, 3, 4, 4) == [0, 1, 2, 3, 4]
    assert store.read == [0, 1, 2, 3, 4, *(3, 4) * 2]
    values(contents, 3, 4)
    assert values(contents, 4) == [4]
    assert store.read[9:] == [3, 4], "others make room for what alone is asked for"


def test_a_policy_larger_than_the_room_is_read_each_time(store):
    store.contents[bytes([0])] = content(0, kilobytes=4)
    contents = StatePolicies(store.content, most_bytes=3 * KILOBYTE)
    assert [values(contents, number) for number in (0, 0, 1, 1)] == [[0], [0], [1], [1]]
    assert store.read == [0, 0, 1]


def test_those_of_the_newest_generation_need_not_be_stored_yet(store):
    contents = StatePolicies(store.content)
    contents.add({bytes([9]): content(9)}, {})
    assert values(contents, 0, 9) == [0, 9]
    contents.add({}, {})
    assert values(contents, 9) == [9]
    assert store.read == [0]
    contents = StatePolicies(store.content, most_bytes=3 * KILOBYTE)
    contents.add({bytes([number]): content(number) for number in range(5)}, {})
    assert values(contents, 0, 1, 2, 3, 4) == [0, 1, 2, 3, 4]
    contents.add({}, {})
    assert values(contents, 3, 4) == [3, 4]
    assert store.read == [0]
    with pytest.raises(KeyError):
        values(contents, 8)


def test_policies_are_read_only(store):
    contents = StatePolicies(store.content)
    with pytest.raises(ValueError, match="read-only"):
        contents.of([bytes([0])])[bytes([0])]["parameters_D"][0] = 1


def policy(value):
    of_policy = np.full(6, value, np.float32), np.full(2, value, np.float32), np.ones(2, np.float32)
    return Policy(SPEC, *of_policy).content


def test_policies_that_are_asked_for_by_name_get_their_parameters_and_statistics(store):
    policies = [policy(value) for value in (1, 2)]
    store.contents = {name_of(content): content for content in policies}
    named = names(map(name_of, policies))
    (asked,) = StatePolicies(store.content).completed((PolicyAsk(named[[1, 0, 1]]),), 3)
    np.testing.assert_array_equal(asked.parameters_N_D.made(), np.repeat([[2], [1], [2]], 6, axis=1))
    np.testing.assert_array_equal(asked.observation_mean_N_O, [[2, 2], [1, 1], [2, 2]])
    recipes = recipes_of(IsoLine(0.0, 0.0), named, np.array([[0, 1]]), np.zeros((1, 4), np.uint32))
    (asked,) = StatePolicies(store.content).completed((PolicyAsk(recipes),), 3)
    np.testing.assert_array_equal(asked.parameters_N_D.made(), np.ones((1, 6)))


def test_a_policy_that_nobody_has_is_named(store):
    with pytest.raises(EvaluationError, match=r"generation 3: `ask` names the policy 07070707.*nothing in the state"):
        StatePolicies(store.content).completed((PolicyAsk(names([bytes([7] * 32)])),), 3)


def test_a_name_is_that_of_the_content_alone():
    one = policy(1)
    assert name_of(one) == name_of({name: one[name].copy() for name in reversed(one)})
    other = policy_of(PolicySpec((2, 2), bias=False), one).content
    changed = [{**one, "parameters_D": one["parameters_D"] + 0.0 * np.float32(-1)}, policy(2), other]
    assert len({name_of(one), *map(name_of, changed[1:])}) == 3
    assert name_of(changed[0]) == name_of(one)
