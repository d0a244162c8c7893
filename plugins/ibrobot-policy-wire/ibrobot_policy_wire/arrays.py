"""msgpack with arrays, as openpi, GR00T and vla-eval pack them; received arrays are checked, and never unpickled."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import PolicyError

MAX_MESSAGE = 64 << 20
"""Maximum size of a message [bytes]."""
_ARRAY, _SCALAR = b"__ndarray__", b"__npgeneric__"
_DATA, _DTYPE, _SHAPE = b"data", b"dtype", b"shape"
_KINDS = "biuf"
"""Booleans, integers and floats; others have no place on the wire."""


def _unpack(message: bytes, hook: Callable[[dict[Any, Any]], Any]) -> Any:
    try:
        return msgpack.unpackb(message, object_hook=hook)
    except (ValueError, TypeError, OverflowError, msgpack.exceptions.UnpackException) as error:
        raise PolicyError(
            f"a message of {len(message)} bytes cannot be read: {error or type(error).__name__}"
        ) from None


def _packed(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: value.shape}
    if isinstance(value, np.generic) and value.dtype.kind in _KINDS:
        return {_SCALAR: True, _DATA: value.item(), _DTYPE: value.dtype.str}
    raise TypeError(f"{type(value).__name__} has no place in a message")


def _unpacked(value: dict[Any, Any]) -> Any:
    if _ARRAY in value:
        return _array(value.get(_DATA), _dtype(value), value.get(_SHAPE))
    if _SCALAR in value:
        number = value.get(_DATA)
        if not isinstance(number, bool | int | float):
            raise ValueError(f"a number is {type(number).__name__}")
        return _dtype(value).type(number)
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    text = value.get(_DTYPE)
    dtype = np.dtype(text) if isinstance(text, str) and len(text) < 8 else None
    if dtype is None or dtype.kind not in _KINDS:
        raise ValueError(f"an array has dtype {text!r}")
    return dtype


def _array(content: Any, dtype: np.dtype[Any], shape: Any) -> NDArray[Any]:
    whole = isinstance(shape, list | tuple) and len(shape) <= 8 and all(type(n) is int and n >= 0 for n in shape)
    if not whole or not isinstance(content, bytes):
        raise ValueError(f"an array has shape {shape!r}")
    if math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"an array of {dtype} {tuple(shape)} has {len(content)} bytes")
    return np.frombuffer(content, dtype).reshape(shape)


def _packed_named(value: Any) -> dict[str, Any]:
    return {name.decode(): each for name, each in _packed(value).items()}


def _unpacked_named(value: dict[Any, Any]) -> Any:
    if _ARRAY.decode() not in value:
        return value
    return _unpacked({name.encode(): each for name, each in value.items() if isinstance(name, str)})


_NPY, _NPY_DATA = "__ndarray_class__", "as_npy"
_NPY_MAGIC = b"\x93NUMPY\x01\x00"
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf]\d{1,2})', 'fortran_order': (True|False), 'shape': \(([\d, ]{0,100})\), \} *\n"
)
_MODALITY, _MODALITY_JSON = "__ModalityConfig_class__", "as_json"


def _packed_npy(value: Any) -> dict[str, Any]:
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        content = io.BytesIO()
        np.save(content, value, allow_pickle=False)
        return {_NPY: True, _NPY_DATA: content.getvalue()}
    raise TypeError(f"{type(value).__name__} has no place in a message")


def _unpacked_npy(value: dict[Any, Any]) -> Any:
    if _NPY in value:
        return _npy(value.get(_NPY_DATA))
    if _MODALITY in value:
        described = value.get(_MODALITY_JSON)
        return json.loads(described) if isinstance(described, str) else described
    return value


def _npy(content: Any) -> NDArray[Any]:
    """The array of a .npy file of version 1.0.

    Its header is a Python expression. Only the form that `np.save` writes is read, and it is not evaluated.
    """
    begin = len(_NPY_MAGIC) + 2
    if not isinstance(content, bytes) or not content.startswith(_NPY_MAGIC) or len(content) < begin:
        raise ValueError("an array is not a .npy file of version 1.0")
    end = begin + int.from_bytes(content[begin - 2 : begin], "little")
    header = _NPY_HEADER.fullmatch(content[begin:end])
    if header is None:
        raise ValueError(f"an array has the header {content[begin:end][:80]!r}")
    dtype, is_fortran = np.dtype(header[1].decode()), header[2] == b"True"
    shape = [int(n) for n in header[3].split(b",") if n.strip()]
    array = _array(content[end:], dtype, shape[::-1] if is_fortran else shape)
    return array.T if is_fortran else array


type Pack = Callable[[Any], bytes]
"""Packs a message of dictionaries, lists, texts, numbers and arrays."""
type Unpack = Callable[[bytes], Any]
"""Unpacks a message; its arrays are read-only. Raises PolicyError if it is damaged."""

pack: Pack = partial(msgpack.packb, default=_packed)
"""Codec of openpi."""
unpack: Unpack = partial(_unpack, hook=_unpacked)
pack_npy: Pack = partial(msgpack.packb, default=_packed_npy)
"""Codec of GR00T, with arrays as .npy files."""
unpack_npy: Unpack = partial(_unpack, hook=_unpacked_npy)
"""Descriptions of modalities become dictionaries."""
pack_named: Pack = partial(msgpack.packb, default=_packed_named)
"""Codec of vla-eval, with arrays under text keys."""
unpack_named: Unpack = partial(_unpack, hook=_unpacked_named)
