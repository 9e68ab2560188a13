"""The CSV files of a run as numpy arrays."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import ShoalError


def read(path: Path) -> np.ndarray:
    """The file as a structured array, a field for each column. Empty cells are NaN.

    A column is int64 if all its cells are whole numbers, float64 if they are numbers, and text otherwise. A line that
    is being written is left out.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ShoalError(f"{path} cannot be read: {error.strerror}") from error
    whole = text[: text.rfind("\n") + 1]
    rows = list(csv.reader(whole.splitlines()))
    if not rows:
        raise ShoalError(f"{path} has no header")
    names, rows = rows[0], [row for row in rows[1:] if len(row) == len(rows[0])]
    return of_columns({name: column([row[index] for row in rows]) for index, name in enumerate(names)})


def of_columns(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Columns of one length as a structured array, a field for each."""
    length = max((len(values) for values in columns.values()), default=0)
    table = np.empty(length, dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def column(cells: list[str]) -> np.ndarray:
    """The cells of a column in the narrowest type that holds them all."""
    for kind in (int, float):
        try:
            values: list[Any] = [kind(cell) if cell or kind is int else np.nan for cell in cells]
            return np.array(values, dtype=np.int64 if kind is int and cells else np.float64)
        except (ValueError, OverflowError):
            continue
    return np.array(cells, dtype=object)
