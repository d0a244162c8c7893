"""Arrow arrays from Python values and NumPy arrays, without pandas.

If pandas is installed, as it is with LeRobot, `pyarrow.array` imports it. This would take more than a second and
130 MiB in every process, for pandas types that are not used here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import types

_NUMBERS = {
    pa.from_numpy_dtype(np.dtype(name)): np.dtype(name)
    for name in ("uint8", "uint16", "int32", "int64", "float32", "float64")
}
"""`DataType.to_pandas_dtype` needs pandas in old releases."""


def to_array(values: Any, kind: pa.DataType) -> pa.Array:
    """An array of type `kind` with `values`, a sequence without missing values.

    Supported types are those of the tables: numeric types of features, booleans, text, bytes, lists of these, and
    structs from mappings.
    """
    if types.is_struct(kind):
        columns = [to_array([value[field.name] for value in values], field.type) for field in kind]
        return pa.StructArray.from_arrays(columns, fields=list(kind))
    if types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(to_array(_flat(values), kind.value_type), kind.list_size)
    if types.is_list(kind):
        offsets = to_array(_offsets(values), pa.int32())
        return pa.ListArray.from_arrays(offsets, to_array(_flat(values), kind.value_type))
    if types.is_string(kind):
        values = [value.encode() for value in values]
    if types.is_string(kind) or types.is_binary(kind):
        return _from_buffers(kind, len(values), _offsets(values), b"".join(values))
    if types.is_boolean(kind):
        return _from_buffers(kind, len(values), np.packbits(np.asarray(values, bool), bitorder="little"))
    return _from_buffers(kind, len(values), np.ascontiguousarray(values, _NUMBERS[kind]))


def table_of(rows: Sequence[Mapping[str, Any]], schema: pa.Schema | None = None) -> pa.Table:
    """A table of `rows`, with `schema` or else with the types of the first row."""
    schema = schema or pa.schema([(name, _type_of(value)) for name, value in rows[0].items()])
    return pa.Table.from_arrays(
        [to_array([row[field.name] for row in rows], field.type) for field in schema], schema=schema
    )


def to_numpy(column: pa.ChunkedArray) -> Any:
    """The values of a column of numbers, or of lists of equal length: shape (N, D)."""
    blocks = [_block(chunk) for chunk in column.chunks]
    return np.concatenate(blocks) if blocks else np.empty((0, 1))


def _block(array: pa.Array) -> Any:
    length = len(array)
    values = array.flatten() if types.is_fixed_size_list(array.type) or types.is_list(array.type) else array
    if types.is_boolean(values.type):
        numbers = np.array(values.to_pylist(), bool)
    else:
        numbers = np.frombuffer(values.buffers()[1], _NUMBERS[values.type])[values.offset : values.offset + len(values)]
    return numbers.reshape(length, -1)


def _type_of(value: Any) -> pa.DataType:
    if isinstance(value, list):
        return pa.list_(_type_of(value[0]))
    return {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}[type(value)]


def _flat(values: Any) -> Any:
    """The elements of all lists."""
    return values.reshape(-1) if isinstance(values, np.ndarray) else list(chain.from_iterable(values))


def _offsets(values: Sequence[Any]) -> Any:
    """The start of each value, and the end of the last."""
    return np.cumsum([0, *map(len, values)], dtype=np.int32)


def _from_buffers(kind: pa.DataType, length: int, *buffers: Any) -> pa.Array:
    return pa.Array.from_buffers(kind, length, [None, *map(pa.py_buffer, buffers)])
