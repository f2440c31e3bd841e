"""Recipes: policies made of parents and noise, on which sides what is kept, and what of them is refused."""

from __future__ import annotations

import hashlib
import pickle
import random
from dataclasses import replace

import numpy as np
import pytest

from es_service.errors import EvaluationError
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.messages import Policies, with_subject
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.policies import (
    POLICY_SLOTS,
    IsoLine,
    Origin,
    PolicyChunk,
    Recipes,
    parent_name,
    recipes_again,
    recipes_of,
    unvaried,
    variation,
)
from es_service.protocol.sent import LEAST_BYTES, LackingError, Memory, Received, parcel
from es_service.search.algorithms.base import PolicyAsk
from tests.laws.me_es_runs import SHAPE, config_of, run_in_memory
from tests.laws.test_policies import only
from workers.cores import with_made_policies

RULE = IsoLine(0.3, 0.6)
SIZE = SHAPE.parameters
PARENTS = list(np.random.default_rng(0).normal(size=(40, SIZE)).astype(np.float32))


def recipes(count: int, generation: int = 1, parents=tuple(PARENTS), rule=RULE) -> Recipes:
    drawn_N_2 = np.random.default_rng(generation).integers(len(parents), size=(count, 2))
    used, index_N_2 = np.unique(drawn_N_2, return_inverse=True)
    keys = stream_keys(0, Domain.VARIATION, generation, np.arange(count))
    return recipes_of(rule, [parents[one] for one in used], index_N_2.reshape(-1, 2), keys)


def bits(array: np.ndarray) -> bytes:
    return array.tobytes()


def work_of(count: int, generation: int = 1, **given):
    asked = recipes(count, generation, **given)
    return policy_work(asked, no_statistics(count, 2), 1, seed=0, generation=generation).work


def made(work) -> list[bytes]:
    """The parameters of each chunk's policies."""
    return [bits(subject.parameters_N_D.made()) for subject, _ in work]


def test_how_policies_are_grouped_changes_no_bit():
    asked = recipes(41)
    whole_N_D = asked.made()
    for n in range(41):
        x, y = (asked.parents[index] for index in asked.parent_N_2[n])
        assert bits(variation(x, y, asked.key_N_4[n], RULE)) == bits(whole_N_D[n])
        assert bits(asked.part([n]).made()[0]) == bits(whole_N_D[n])
    for first, last in ((0, 16), (5, 6), (17, 41)):
        assert bits(asked.part(slice(first, last)).made()) == bits(whole_N_D[first:last])
    assert len({bits(row) for row in whole_N_D}) == 41


def test_the_driver_makes_a_policy_with_the_bits_that_a_worker_makes():
    asked = recipes(20)
    work = policy_work(asked, no_statistics(20, 2), 1, seed=0, generation=1)
    theirs = np.concatenate([subject.parameters_N_D.made() for subject, _ in work.work])
    for number, policy in zip([3, 19, 3, 0], work.policies([3, 19, 3, 0], SHAPE), strict=True):
        assert bits(policy.parameters_D) == bits(theirs[number])
    assert bits(work.policies([7], SHAPE)[0].parameters_D) == bits(theirs[7])


def test_a_name_is_that_of_the_content():
    one, other = PARENTS[0].copy(), PARENTS[0].copy()
    assert parent_name(one) == parent_name(other)
    before = parent_name(one)
    one[3] += 1.0  # it was writable, so nothing of it is remembered
    assert parent_name(one) != before
    one.flags.writeable = False
    assert parent_name(one) == parent_name(one.copy()) != before
    assert len({parent_name(parent) for parent in PARENTS}) == len(PARENTS)


@pytest.mark.parametrize("view", [lambda array: array[:], lambda array: array[2:].view(), np.broadcast_to])
def test_the_name_of_a_read_only_view_follows_the_array_that_is_seen_through_it(view):
    array = PARENTS[0].copy()
    seen = view(array, array.shape) if view is np.broadcast_to else view(array)
    seen.flags.writeable = False
    before = parent_name(seen)
    array[3] += 1.0
    assert parent_name(seen) == parent_name(seen.copy()) != before


def test_an_array_that_cannot_change_is_hashed_once(monkeypatch):
    arrays = [PARENTS[0].copy(), np.stack(PARENTS), np.frombuffer(PARENTS[0].tobytes(), np.float32)]
    for array in arrays[:2]:
        array.flags.writeable = False
    kept = [arrays[0], arrays[1][1], arrays[2]]
    names = [*map(parent_name, kept)]
    monkeypatch.setattr(hashlib, "sha256", None)
    assert [*map(parent_name, kept)] == names


# What travels


def test_no_parameters_travel_with_an_item():
    work = work_of(POLICY_SLOTS)
    sent = parcel(work, Memory(2**40, int))
    assert len(sent.work) < 3000 < PARENTS[0].nbytes * 20
    received = Received(2**40, Recipes.made)
    received.add(dict(zip(map(parent_name, PARENTS), PARENTS, strict=True)))
    assert made(received.work({}, sent.work)) == made(work)


def test_statistics_travel_only_if_there_are_any():
    for mean, std, travel in ((0.0, 1.0, False), (-0.0, 1.0, True), (0.0, 2.0, True), (0.5, 1.0, True)):
        statistics = tuple(np.full((3, 2), value, np.float32) for value in (mean, std))
        (subject, _) = policy_work(recipes(3), statistics, 1, seed=0, generation=1).work[0]
        assert isinstance(subject, Policies)
        assert (subject.observation_mean_N_O is not None, subject.observation_std_N_O is not None) == (travel, travel)


class Worker:
    """A worker that is sent items as a transport sends them, and its sender."""

    def __init__(self, most_parents: int, theirs: int | None = None) -> None:
        limit = PARENTS[0].nbytes
        self.known: Memory[int] = Memory(most_parents * limit, int)
        self.received = Received((theirs or most_parents) * limit, Recipes.made)
        self.kept = self.received.memory
        self.sent: list[bytes | Origin] = []
        """The names of parents that it was sent, or their origins."""

    def item(self, work):
        arrays, origins, pickled = parcel(work, self.known)
        self.sent += [*arrays, *origins.values()]
        self.received.add(arrays)
        return self.received.work(pickle.loads(pickle.dumps(origins)), pickled)


def test_a_parent_travels_once_while_it_is_kept():
    worker, work = Worker(40), work_of(64)
    for _ in range(3):
        assert made(worker.item(work)) == made(work)
    names = [name for subject, _ in work for name in subject.parameters_N_D.names]
    assert worker.sent == list(dict.fromkeys(names))


@pytest.mark.parametrize("most", [1, 12, 25])
def test_with_any_limit_a_worker_has_what_its_sender_believes_and_keeps_no_more(most):
    rng, worker, sent = random.Random(most), Worker(most), 0
    for generation in range(60):
        work = work_of(rng.choice([1, 5, 16, 40]), generation)
        first = rng.randrange(len(work))
        item = work[first : first + rng.choice([1, 2, 3])]
        assert made(worker.item(item)) == made(item)
        assert list(worker.kept) == list(worker.known)
        needed = {name for subject, _ in item for name in subject.parameters_N_D.names}
        assert needed <= set(worker.kept)
        assert len(worker.kept) <= max(most, len(needed))
        sent += len(needed)
    assert 40 < len(worker.sent) < sent


def test_a_worker_that_lacks_parents_says_so_and_computes_when_it_is_sent_all_again():
    """As if it kept less than its sender believes; also while other items are on their way."""
    rng, worker, lacked = random.Random(0), Worker(40, theirs=3), 0
    for generation in range(60):
        work = work_of(rng.choice([1, 2, 3]), generation)
        try:
            item = worker.item(work)
        except LackingError:
            lacked += 1
            worker.known.clear()
            item = worker.item(work)
        assert made(item) == made(work)
    assert lacked > 10


def test_what_a_sender_does_not_know_of_is_forgotten_first():
    """After an answer `lacks`, the sender knows less than the worker has; it must not know more, later."""
    rng, worker = random.Random(1), Worker(10)
    for generation in range(200):
        if rng.random() < 0.1:
            worker.known.clear()
        item = work_of(rng.choice([1, 2, 4]), generation)
        assert made(worker.item(item)) == made(item)
        assert set(worker.known) <= set(worker.kept)


def born(work, number, origins):
    """One of the policies that are asked for, whose origin is then known."""
    parameters_D = work.policies([number], SHAPE)[0].parameters_D
    origins |= work.parameters_N_D.part([number]).origins_of([parent_name(parameters_D)])
    return parameters_D


def descendants(generations: int, size: int, policies: int = 32):
    """Work of generations in which a few policies of each take the places of parents, as elites do."""
    rng, origins = np.random.default_rng(size), {}
    parents = [rng.normal(size=size).astype(np.float32) for _ in range(20)]
    for generation in range(generations):
        asked = replace(recipes(policies, generation, parents=parents), origins=origins)
        work = policy_work(asked, no_statistics(policies, 2), 1, seed=0, generation=generation)
        yield work.work
        for number in rng.integers(policies, size=2).tolist():
            parents[rng.integers(len(parents))] = born(work, number, origins)


@pytest.mark.parametrize("most", [1, 15, 1000])
def test_of_a_parent_that_was_made_of_others_only_the_origin_travels(most):
    """Unless the worker lacks what it was made of: then it may be made in a few steps, or travels itself."""
    size = 2000
    one, other = (Worker(most * size // SIZE + 1) for _ in range(2))
    for work in descendants(40, size):
        for worker, item in ((one, work[:1]), (other, work[1:])):
            assert made(worker.item(item)) == made(item)
            assert list(worker.kept) == list(worker.known)
    origins = [sum(isinstance(given, Origin) for given in worker.sent) for worker in (one, other)]
    if most == 1000:
        assert all(len(worker.sent) - count < 25 for worker, count in zip((one, other), origins, strict=True))
        assert min(origins) > 40
    assert max(origins) > 0


def test_parents_that_a_worker_lacks_are_made_after_what_they_are_made_of():
    """It has the first two. Of their children and grandchildren it hears with the first item of these."""
    parents = list(np.random.default_rng(0).normal(size=(2, 2000)).astype(np.float32))
    worker, origins = Worker(1000), {}
    for generation in range(3):
        asked = replace(recipes(4, generation, parents=parents), origins=origins)
        work = policy_work(asked, no_statistics(4, 2), 1, seed=0, generation=generation)
        if generation != 1:
            assert made(worker.item(work.work)) == made(work.work)
        parents = [born(work, number, origins) for number in range(2)]
    assert [isinstance(given, Origin) for given in worker.sent] == [False] * 2 + [True] * 4


def test_a_small_parent_travels_itself():
    worker = Worker(1000)
    for work in descendants(10, LEAST_BYTES // 4 - 1):
        assert made(worker.item(work)) == made(work)
    assert not any(isinstance(given, Origin) for given in worker.sent)


def test_a_policy_has_the_origin_of_which_it_was_made():
    asked = recipes(5, 77)
    name = parent_name(asked.made()[3])
    origin = asked.origins_of([*map(parent_name, asked.made())])[name]
    known = dict(zip(asked.names, asked.parents, strict=True))
    assert bits(recipes_again([origin], known).made()[0]) == bits(asked.made()[3])


def test_a_policy_as_it_is_has_its_own_bits_and_no_origin():
    """An origin that names the policy itself would never end."""
    policies = [np.random.default_rng(seed).normal(size=2000).astype(np.float32) for seed in range(3)]
    recipes = unvaried(policies)
    made_N_D = recipes.made()
    np.testing.assert_array_equal(made_N_D, policies)
    assert recipes.names == tuple(map(parent_name, made_N_D))
    assert recipes.origins_of(recipes.names) == {}


def test_a_worker_whose_cores_are_processes_gives_them_the_policies():
    work = work_of(20)
    found = with_made_policies(work)
    assert [bits(subject.parameters_N_D) for subject, _ in found] == made(work)
    assert found[0][0] is not work[0][0]
    explicit = with_subject(found[0][0], [PolicyChunk(1, 0), PolicyChunk(1, 1)])
    assert with_made_policies(explicit) == explicit


# What is refused

GOOD = recipes(18)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (replace(GOOD, parents=(PARENTS[0].astype(float), *GOOD.parents[1:])), "parent that is float64"),
        (replace(GOOD, parents=(PARENTS[0][1:], *GOOD.parents[1:])), rf"must be float32 \({SIZE},\)"),
        (replace(GOOD, parent_N_2=GOOD.parent_N_2[:, :1]), r"parents int64 \(18, 1\); must be indices"),
        (replace(GOOD, parent_N_2=GOOD.parent_N_2[:0]), r"parents int64 \(0, 2\); must be indices"),
        (replace(GOOD, parent_N_2=GOOD.parent_N_2 - 1), "a parent -1 or"),
        (replace(GOOD, parent_N_2=GOOD.parent_N_2 + 1), rf"; there are {len(GOOD.parents)}"),
        (replace(GOOD, key_N_4=GOOD.key_N_4[:, :3]), r"keys uint32 \(18, 3\); must be uint32 \(18, 4\)"),
        (replace(GOOD, key_N_4=GOOD.key_N_4[:1]), r"keys uint32 \(1, 4\)"),
        (replace(GOOD, rule=IsoLine(-0.1, 0.0)), r"deviations \(-0.1, 0.0\); must be finite and not negative"),
        (replace(GOOD, rule=IsoLine(0.1, np.inf)), "must be finite"),
        (replace(GOOD, rule=IsoLine(0.1, 1e38)), "may not be finite, of parents with values up to"),
        (recipes(18, parents=[np.full(SIZE, np.nan, np.float32)] * 40), "may not be finite.*nan"),
        (recipes(18, parents=[np.full(SIZE, 3e38, np.float32)] * 40), r"may not be finite.* values up to 3e\+38"),
    ],
)
def test_recipes_of_which_no_policies_can_be_made_are_an_error_with_a_sentence(asked, sentence):
    few = config_of(generations=1, algorithm="es")
    algorithm = replace(only(PARENTS[0]), ask=lambda state, generation: (PolicyAsk(asked),))
    with pytest.raises(EvaluationError, match=f"generation 1: the recipes of the policies .*{sentence}") as error:
        run_in_memory(few, algorithm=algorithm)
    assert error.value.field == "search.algorithm"


def test_a_parent_that_is_no_array_is_a_type_error():
    with pytest.raises(TypeError, match="a parent is list; must be a float32 array"):
        recipes_of(RULE, [[1.0]], np.zeros((1, 2), int), GOOD.key_N_4[:1])


def test_policies_by_recipe_have_the_results_of_explicit_ones():
    """Whatever search asks for them, also with observation statistics."""
    few = config_of(generations=2, algorithm="es")
    statistics = np.full((18, 2), 0.3, np.float32), np.full((18, 2), 2.0, np.float32)
    found = []
    for asked in (GOOD, GOOD.made()):
        for given in ((), statistics):
            algorithm = replace(only(None), ask=lambda s, g, asked=asked, given=given: (PolicyAsk(asked, *given),))
            _, store, _ = run_in_memory(few, algorithm=algorithm)
            found.append((store.evaluated, store.parts["best"]))
    found = [repr(one) for one in found]
    assert found[0] == found[2] != found[1] == found[3]
