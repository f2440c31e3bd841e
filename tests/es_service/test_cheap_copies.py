"""Containers with cheap copies, held against a dict and a list whose copies are made in full."""

from __future__ import annotations

import bisect
import copy
import time
from random import Random

import pytest

from es_service.dispatch.cheap_copies import _LONGEST, _SHORTEST, Sorted, Table


@pytest.mark.parametrize("seed", range(25))
def test_a_table_and_all_its_copies_are_dicts(seed):
    """Any copy may be changed, also an old one whose other copies have been changed since."""
    random = Random(seed)
    keys = random.choice((3, 50, 2000))
    kept: list[tuple[Table[int, int], dict[int, int]]] = [(Table(), {})]
    for number in range(400):
        table, plain = random.choice(kept[-3:] if random.random() < 0.9 else kept)
        table, plain = table.copy(), plain.copy()
        for _ in range(random.choice((0, 1, 2, 200))):
            key = random.randrange(keys)
            if random.random() < 0.6:
                table[key] = plain[key] = number
            else:
                assert table.pop(key) == plain.pop(key, None)
        key = random.randrange(keys)
        assert (table.get(key), key in table, len(table), bool(table)) == (
            plain.get(key), key in plain, len(plain), bool(plain),
        )  # fmt: skip
        kept.append((table, plain))
    for table, plain in random.sample(kept, 40):
        assert {key: table[key] for key in table} == plain
        other, other_plain = random.choice(kept)
        assert (table == other) == (plain == other_plain)
        assert table == table.copy() == copy.deepcopy(table)


def test_a_table_is_iterated_in_the_order_of_insertion():
    table, plain = Table(), {}
    for number in range(3000):
        table = table.copy()
        table[number] = plain[number] = 0
        if number % 2:
            del plain[number // 2]
            assert table.pop(number // 2) is not None
            plain[number // 2 + 1] = table[number // 2 + 1] = number
    assert list(table) == list(plain)


def test_a_missing_key_of_a_table_is_an_error():
    table: Table[str, int] = Table()
    table["a"] = 1
    table = table.copy()
    table.pop("a")
    for key in ("a", "b"):
        with pytest.raises(KeyError, match=key):
            table[key]
    assert table == Table()
    assert table != {}


@pytest.mark.parametrize("seed", range(25))
def test_a_sorted_list_and_all_its_copies_are_sorted_lists(seed):
    random = Random(seed)
    numbers, add_rate = random.choice((5, 200, 2000)), random.choice((0.5, 0.8))
    kept: list[tuple[Sorted[tuple[int, str]], list[tuple[int, str]]]] = [(Sorted(), [])]
    for _ in range(300):
        entries, plain = random.choice(kept[-3:] if random.random() < 0.9 else kept)
        entries, plain = entries.copy(), plain.copy()
        for _ in range(random.choice((0, 1, 2, 100))):
            entry = (random.randrange(numbers), "x")
            if plain and random.random() > add_rate:
                entry = random.choice((plain[0], plain[-1], random.choice(plain)))
                plain.remove(entry)
                entries.remove(entry)
            elif entry not in plain:
                bisect.insort(plain, entry)
                entries.add(entry)
        if random.random() < 0.1:
            start = plain[-1][0] + 1 if plain else 0
            more = [(start + number, "y") for number in range(random.choice((0, 1, 300)))]
            plain.extend(more)
            entries.extend(more)
        assert (len(entries), bool(entries)) == (len(plain), bool(plain))
        assert (entries.first(), entries.last()) == ((plain[0], plain[-1]) if plain else (None, None))
        kept.append((entries, plain))
    for entries, plain in random.sample(kept, 40):
        assert list(entries) == plain
        other, other_plain = random.choice(kept)
        assert (entries == other) == (plain == other_plain)
        assert entries == entries.copy() == copy.deepcopy(entries)


def test_an_iteration_is_of_the_entries_at_its_start():
    entries: Sorted[tuple[int]] = Sorted()
    entries.extend((number,) for number in range(500))
    seen = []
    for entry in entries:
        seen.append(entry)
        entries.remove(entry)
        entries.add((entry[0] + 1000,))
    assert seen == [(number,) for number in range(500)]
    assert list(entries) == [(number + 1000,) for number in range(500)]


def test_an_entry_that_is_not_there_cannot_be_removed():
    entries: Sorted[tuple[int]] = Sorted()
    entries.extend([(1,), (3,)])
    with pytest.raises(KeyError, match="2"):
        entries.remove((2,))


def test_blocks_stay_short_and_few():
    """Whether entries come and go at random, or come at the end and leave anywhere, as deadlines do."""
    random, entries = Random(0), Sorted()
    entries.extend((number,) for number in range(2000))
    present = list(range(2000))
    for number in range(20_000):
        index = random.randrange(len(present))
        entries.remove((present[index],))
        present[index] = number + 2000 if number < 10_000 else random.randrange(10**6, 10**9)
        entries.add((present[index],))
        lengths = [len(block) for block in entries._blocks]
    assert max(lengths) <= _LONGEST
    assert min(lengths) >= _SHORTEST


@pytest.mark.parametrize("kind", ["table", "sorted"])
def test_a_copy_and_a_change_of_many_entries_cost_little(kind):
    """About a microsecond; the bound leaves room for a slow machine, and a full copy of 100,000 does not keep it."""
    size = 100_000
    table: Table[int, int] = Table()
    entries: Sorted[tuple[int]] = Sorted()
    entries.extend((number,) for number in range(size))
    for number in range(size):
        table[number] = 0
    started = time.process_time()
    for number in range(2000):
        if kind == "table":
            table = table.copy()
            table.pop(number)
            table[number + size] = 0
        else:
            entries = entries.copy()
            entries.remove((number * 37,))
            entries.add((number + size,))
    assert (time.process_time() - started) / 2000 < 100e-6
