"""Arrays in msgpack."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from ibrobot_policy_wire import pack, unpack

from ibrobot_core.api import PolicyError


@pytest.mark.parametrize("dtype", ["u1", "i8", "f4", "f8", "?", "f2"])
def test_arrays_survive(dtype: str) -> None:
    array = np.arange(12).reshape(3, 4).astype(dtype)
    found = unpack(pack({"a": [array, "text", None, 1.5]}))["a"]
    np.testing.assert_array_equal(found[0], array)
    assert found[0].dtype == array.dtype
    assert found[1:] == ["text", None, 1.5]
    assert unpack(pack({"x": np.float32(2.5)})) == {"x": np.float32(2.5)}


@pytest.mark.parametrize("value", [np.array([object()]), np.array([1j]), object(), np.array(["text"])])
def test_others_are_not_packed(value: Any) -> None:
    with pytest.raises(TypeError, match="has no place"):
        pack({"a": value})


@pytest.mark.parametrize(
    "change",
    [
        {b"dtype": "O"},
        {b"dtype": "|V8"},
        {b"dtype": "f4, f4"},
        {b"dtype": 3},
        {b"shape": [3]},
        {b"shape": [-1, 4]},
        {b"shape": [1 << 40, 0]},
        {b"shape": "ab"},
        {b"data": "text"},
        {b"shape": [2**62, 2**62]},
    ],
)
def test_a_lying_array_is_refused(change: dict[bytes, Any]) -> None:
    whole = {b"__ndarray__": True, b"data": bytes(16), b"dtype": "<f4", b"shape": [4]}
    assert unpack(msgpack.packb(whole)).shape == (4,)
    with pytest.raises(PolicyError, match="cannot be read"):
        unpack(msgpack.packb(whole | change))


def test_nesting_without_end_is_refused() -> None:
    with pytest.raises(PolicyError, match="cannot be read"):
        unpack(b"\x91" * 100_000)
