"""Rows of numbers as columns: eight bytes a value, where dictionaries of Python's numbers take more than a hundred.

A long run has millions of generations, so whoever reads a whole history reads columns.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.loop.history import Column
from es_service.store.codec import Row

Columns = dict[str, NDArray[Any]]
"""Column name -> its values, [N]: float64, in which NaN stands for no value, or a masked array of int64."""


class Table:
    """Columns that grow by one row at a time."""

    def __init__(self, columns: Sequence[Column]) -> None:
        """An empty table with the names and types of `columns`."""
        self._names = [column.name for column in columns]
        whole = [column.type == "INTEGER" for column in columns]
        self._values: list[array[Any]] = [array("q" if is_whole else "d") for is_whole in whole]
        self._missing = [array("b") if is_whole else None for is_whole in whole]

    def add(self, row: Row) -> None:
        """Add a row; None stands for no value."""
        for values, missing, value in zip(self._values, self._missing, row, strict=True):
            if missing is None:
                values.append(np.nan if value is None else value)
            else:
                values.append(value or 0)
                missing.append(value is None)

    def columns(self, *, copy: bool = False) -> Columns:
        """The columns by name. Unless they are copies, nothing can be added to the table afterwards."""
        make = np.array if copy else np.asarray
        return {
            name: make(values) if missing is None else np.ma.MaskedArray(make(values), make(missing).view(np.bool_))
            for name, values, missing in zip(self._names, self._values, self._missing, strict=True)
        }


def as_floats(column: NDArray[Any]) -> NDArray[np.float64]:
    """A column as floats, in which NaN stands for no value."""
    return np.ma.filled(column.astype(np.float64, copy=False), np.nan)
