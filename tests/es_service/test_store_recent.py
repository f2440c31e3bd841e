"""Parts of the state that are kept decoded: what is read is what is stored, whatever was read before."""

import sqlite3

import numpy as np
import pytest

from es_service.protocol.kept import Kept
from tests.es_service.store_examples import assert_same_state, create, history_row, parts_of


def arrays(kilobytes, value=0.0):
    return {"a": np.full(kilobytes * 128, value), "b": np.zeros(0, np.float32)}


def test_parts_not_asked_for_the_longest_are_forgotten_when_there_are_too_many_bytes():
    recent = Kept(lambda part: sum(values.nbytes for values in part.values()))

    def add(name, kilobytes, **limits):
        recent.add(name, arrays(kilobytes))
        recent.forget_oldest(3 * 1024, **limits)
        return list(recent)

    assert [add(name, 1) for name in "xyz"][-1] == ["x", "y", "z"]
    recent.use(["x", "not kept"])
    assert add("w", 1) == ["z", "x", "w"]
    assert add("large", 4) == []
    assert add("large", 4, spared=["large"]) == ["large"]
    assert add("small", 3) == ["small"]
    recent.forget("small")
    recent.forget("small")
    assert add("other", 2) == ["other"], "what is forgotten needs no room"
    assert add("other", 3) == ["other"], "nor what is replaced"
    assert [add(name, 0, most=2) for name in "xy"][-1] == ["x", "y"]


def test_a_store_returns_the_newest_part_though_it_keeps_parts(tmp_path):
    with create(tmp_path / "run") as store:
        for generation in range(6):
            store.commit(generation, parts_of(generation), history_row(generation))
            for name, expected in parts_of(generation).items():
                for _ in range(2):
                    if expected is None:
                        with pytest.raises(KeyError):
                            store.part(name)
                    else:
                        assert_same_state({name: store.part(name)}, {name: expected})
        part = store.part("centre_0")
        array = next(iter(part.values()))
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
        with pytest.raises(TypeError):
            part["other"] = array


def test_a_part_that_was_read_needs_no_other_reading(tmp_path):
    with create(tmp_path / "run", generations=3) as store:
        before = store.part("centre_0")
        with sqlite3.connect(tmp_path / "run" / "run.db") as connection:
            connection.execute("UPDATE state SET payload = x'00' WHERE part = 'centre_0'")
        assert_same_state({"p": store.part("centre_0")}, {"p": before})
