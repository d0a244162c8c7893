"""Service calls as JSON: what goes through unchanged, what becomes plain data, and what is refused."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_ros2 import CodecError
from ibrobot_ros2.services import (
    Answer,
    Call,
    decode_answer,
    decode_call,
    encode_answer,
    encode_call,
    endpoint,
    plain,
)

from ibrobot_core.api import Header, JointState, PlanCode

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(st.text(), PLAIN)
def test_plain_data_goes_through_unchanged(service: str, value: object):
    assert decode_call(encode_call(Call(service, value))) == Call(service, value)
    assert decode_answer(encode_answer(Answer(value, result=False))) == Answer(value, result=False)


def test_calls_are_those_of_rosbridge():
    assert json.loads(encode_call(Call("/a", {"x": 1}))) == {"op": "call_service", "service": "/a", "args": {"x": 1}}
    assert json.loads(encode_answer(Answer([1]))) == {"op": "service_response", "values": [1], "result": True}


class Colour(Enum):
    RED = 3


def test_objects_become_plain_data():
    state = JointState(Header(5, "base"), ("pan",), [0.5])
    assert plain(state) == {
        "header": {"stamp_ns": 5, "frame_id": "base"},
        "name": ["pan"],
        "position": [0.5],
        "velocity": [],
        "effort": [],
    }
    assert plain({"a": np.float64(1), 2: (Path("b"), frozenset({"d", "c"}))}) == {"a": 1.0, "2": ["b", ["c", "d"]]}
    assert plain([Colour.RED, PlanCode.NO_IK_SOLUTION]) == ["RED", "NO_IK_SOLUTION"]
    with pytest.raises(CodecError, match="a object cannot be sent to another process"):
        plain([object()])


@given(st.binary(max_size=200))
def test_foreign_bytes_are_refused(data: bytes):
    for decode in (decode_call, decode_answer):
        with pytest.raises(CodecError):
            decode(data)


@pytest.mark.parametrize("data", [b'{"op":"call_service"}', b'{"op":"service_response","result":1}', b"{}"])
def test_messages_with_missing_parts_are_refused(data: bytes):
    for decode in (decode_call, decode_answer):
        with pytest.raises(CodecError, match="needs op"):
            decode(data)


def test_name_on_the_network_begins_with_the_namespace():
    assert (endpoint(), endpoint("arm1"), endpoint("/lab/arm1/")) == ("services", "arm1/services", "lab/arm1/services")
