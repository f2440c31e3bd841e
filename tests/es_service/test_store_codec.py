import math
import struct

import numpy as np
import pytest

from es_service.errors import StoreError
from es_service.loop.history import NO_INTEGER, Column
from es_service.store.codec import (
    changed_sum,
    decode_part,
    encode_part,
    part_sha256,
    row_bytes,
    row_values,
    state_sha256,
    state_sum,
)
from es_service.store.rows import leading_values, table_bytes
from tests.es_service.store_examples import COLUMNS, as_table, assert_same_state, history_row

ARRAYS = {
    "float32": np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4),
    "float64": np.array([np.nan, np.inf, -0.0, 5e-324]),
    "int64": np.asarray(-(2**62), np.int64),
    "uint8": np.arange(7, dtype=np.uint8),
    "bool": np.array([[True], [False]]),
    "empty": np.zeros((0, 3), np.float32),
    "float16": np.ones(1, np.float16),
}


def test_a_part_comes_back_bit_for_bit_with_types_and_shapes():
    assert_same_state({"part": decode_part(encode_part(ARRAYS))}, {"part": ARRAYS})


@pytest.mark.parametrize(
    "header",
    [
        *(f'[["x", "<f4", {shape}]]' for shape in ("[1.5]", "[-1]", "[null]", "[[1]]", "3", "{}", f"[0, {2**70}]")),
        *(f'[["x", {kind}, [1]]]' for kind in ('"|O"', '"<f3"', '"(9,)f4"', '"M8[s]"', '["<f4"]', "null", '"<f16,"')),
        *("[" * 100_000, "{}", "[1]", '[["x", "<f4"]]', '[[3, "<f4", [1]]]', '[["x", "<f4", [0]], ["x", "<f4", [1]]]'),
    ],
)
def test_any_other_header_is_a_value_error(header):
    """As the readers of a forged run rely on."""
    text = header.encode()
    with pytest.raises(ValueError, match="a state payload"):
        decode_part(b"ESP1" + struct.pack("<I", len(text)) + text + bytes(8))


def test_decoded_arrays_can_be_written_to():
    decoded = decode_part(encode_part(ARRAYS))
    decoded["float32"][0, 0] = 7
    assert decoded["float32"][0, 0] == 7


def test_equal_values_have_equal_bytes_whatever_their_order_strides_and_endianness():
    other = {name: array.astype(array.dtype.newbyteorder(">")) for name, array in reversed(ARRAYS.items())}
    other["float32"] = np.asfortranarray(ARRAYS["float32"])
    assert encode_part(other) == encode_part(ARRAYS)
    assert encode_part({"a": ARRAYS["float32"]}) != encode_part({"b": ARRAYS["float32"]})
    assert encode_part({"a": ARRAYS["float32"]}) != encode_part({"a": ARRAYS["float32"].reshape(4, 3)})


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([object()]), np.zeros(1, "M8[s]")])
def test_what_is_no_number_is_refused(array):
    with pytest.raises(StoreError, match="'a' has dtype"):
        encode_part({"a": array})


def test_a_payload_cut_or_extended_anywhere_is_refused():
    payload = encode_part({"a": np.arange(4, dtype=np.float32), "b": np.zeros(2)})
    for length in range(len(payload)):
        with pytest.raises(ValueError, match="payload"):
            decode_part(payload[:length])
    with pytest.raises(ValueError, match="longer"):
        decode_part(payload + b"\0")


def test_a_state_row_cannot_pass_for_another():
    payload = encode_part({"a": np.zeros(2)})
    hashes = {part_sha256("a", 1, payload), part_sha256("b", 1, payload), part_sha256("a", 2, payload)}
    assert len(hashes) == 3
    a, b = {"a": (1, "x")}, {"b": (2, "y")}
    assert state_sum(a | b) == state_sum(b | a) == changed_sum(state_sum(a), {}, b)
    assert state_sum(a) != state_sum({"a": (2, "x")}) == changed_sum(state_sum(a), a, {"a": (2, "x")})
    assert len({state_sum(rows) for rows in ({}, a, b, a | b, {"a": (1, "y")}, {"b": (1, "x")})}) == 6
    assert len(state_sha256(state_sum(a))) == len(state_sha256(0)) == 64


def test_history_values_become_what_the_database_gives_back():
    row = {**history_row(1), "env_steps": np.int32(5), "centre_fitness_mean": np.float32(0.1), "goal_distance": -0.0}
    values = row_values(COLUMNS, 1, row)
    assert values == (1, 5, float(np.float32(0.1)), 0.0, 1.25)
    assert [type(value) for value in values] == [int, int, float, float, float]
    assert str(values[3]) == "0.0"
    assert row_values(COLUMNS, 1, {**row, "env_steps": np.nan, "goal_distance": None})[1:4:2] == (None, None)


def test_history_rows_that_do_not_fit_are_refused_by_name():
    row = history_row(3)
    with pytest.raises(StoreError, match=r"unknown columns \['speed'\], missing columns \['env_steps'\]"):
        row_values(COLUMNS, 3, {name: 1 for name in [*row, "speed"] if name != "env_steps"})
    with pytest.raises(StoreError, match="generation 4: its column generation has the value 3"):
        row_values(COLUMNS, 4, row)
    with pytest.raises(StoreError, match=r"env_steps is INTEGER and cannot hold 1\.5"):
        row_values(COLUMNS, 3, {**row, "env_steps": 1.5})
    with pytest.raises(StoreError, match="does not fit into 64 bits"):
        row_values(COLUMNS, 3, {**row, "env_steps": 2**63})


def as_stored(columns, row):
    """The values of a row, one by one."""
    kinds = {"INTEGER": int, "REAL": float}
    values = ((kinds[column.type], row[column.name]) for column in columns)
    return tuple(None if value is None or value != value else kind(value) + kind(0) for kind, value in values)


def test_a_table_has_the_bytes_of_its_rows():
    columns = [Column("i", "INTEGER", True, ""), Column("x", "REAL", True, ""), Column("y", "REAL", True, "")]
    numbers, floats = np.array([3, -1, 2**62]), np.array([np.nan, -0.0, np.inf])
    small = np.array([0.1, np.nan, -0.0], np.float32)
    table = {"i": np.where([False, True, False], NO_INTEGER, numbers), "x": floats, "y": small, "z": floats}
    rows = [
        {"i": 3, "x": math.nan, "y": float(small[0])},
        {"i": None, "x": 0.0, "y": None},
        {"i": 2**62, "x": math.inf, "y": 0.0},
    ]
    expected = b"".join(row_bytes(as_stored(columns, row)) for row in rows)
    assert table_bytes(columns, table) == table_bytes(columns, as_table(columns, rows)) == expected
    assert table_bytes(columns, {}) == table_bytes(columns, as_table(columns, [])) == b""


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"x": np.zeros(2)}, r"has the columns \['x'\]; it lacks \['i'\]"),
        ({"i": np.zeros(2, int), "x": np.zeros(3)}, r"column x has the shape \(3,\), and others have 2 rows"),
        ({"i": np.zeros(2), "x": np.zeros(2)}, "column i is INTEGER and cannot hold float64"),
        ({"i": np.zeros(2, int), "x": np.array(["a", "b"])}, "column x is REAL and cannot hold <U1"),
    ],
)
def test_a_table_that_cannot_be_stored_is_refused(table, message):
    with pytest.raises(StoreError, match=message):
        table_bytes([Column("i", "INTEGER", True, ""), Column("x", "REAL", True, "")], table)


def test_the_leading_values_of_rows_are_those_of_the_rows_without_the_rest():
    """Also where bytes of numbers look like the marks of values, or like the ends of lines."""
    columns = [
        Column(name, kind, True, "") for name, kind in zip("abcde", ["INTEGER", "REAL"] * 2 + ["REAL"], strict=True)
    ]
    marks = int.from_bytes(b"NIR\nNIR\n", "little")
    values = [None, 0, -1, marks, 2**62]
    random = np.random.default_rng(0)
    rows = [
        {column.name: values[index] for column, index in zip(columns, random.integers(5, size=5), strict=True)}
        for _ in range(300)
    ]
    payload = table_bytes(columns, as_table(columns, rows))
    assert payload == b"".join(row_bytes(as_stored(columns, row)) for row in rows)
    for count in range(1, 5):
        assert leading_values(payload, count, 5) == table_bytes(columns[:count], as_table(columns, rows))
    with pytest.raises(ValueError, match="unreadable from byte"):
        leading_values(payload + b"N", 2, 5)


def test_row_bytes_tell_types_and_positions_apart():
    rows = [(1, 2.0), (1.0, 2), (None, 1), (1, None), (2.0, 1), (1, 2), (0, None), (None, 0)]
    assert len({row_bytes(row) for row in rows}) == len(rows)
    with pytest.raises(ValueError, match="not a number"):
        row_bytes(("1",))
