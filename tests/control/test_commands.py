"""Commands of the host as messages: each comes back as it was sent, and whatever is no command is refused."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, get_args

import attrs
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ibrobot_core.control.commands import Command, decode, encode, raise_error
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces.executor import ExecutorGoal, FollowTrajectory, MoveJoint, SlowDown
from ibrobot_core.messages import Header, JointTrajectory, JointTrajectoryPoint
from ibrobot_core.options import fields

KINDS = get_args(Command)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
NUMBERS = st.floats(allow_nan=False)
VECTORS = st.lists(NUMBERS, max_size=2).map(lambda row: np.array(row, np.float64))
POINTS = st.builds(JointTrajectoryPoint, st.integers(), VECTORS, VECTORS, VECTORS, VECTORS)
HEADERS = st.builds(Header, st.integers(), st.text())
TOLERANCES = NUMBERS | st.dictionaries(st.text(), NUMBERS, max_size=3)
VALUES: dict[Any, st.SearchStrategy[Any]] = {
    str: st.text(),
    int: st.integers(),
    float: NUMBERS,
    int | None: st.none() | st.integers(),
    bool: st.booleans(),
    Mapping[str, Any]: st.dictionaries(st.text(), JSON, max_size=3),
    ExecutorGoal: st.one_of(
        st.builds(
            FollowTrajectory,
            st.builds(
                JointTrajectory,
                HEADERS,
                st.lists(st.text(), max_size=3).map(tuple),
                st.lists(POINTS, max_size=2).map(tuple),
            ),
            TOLERANCES,
            TOLERANCES,
            NUMBERS,
            st.none() | st.text(),
            st.integers(),
        ),
        st.builds(MoveJoint, NUMBERS, NUMBERS),
        st.builds(SlowDown),
    ),
}
OTHERS: dict[Any, st.SearchStrategy[Any]] = {
    str: JSON.filter(lambda value: not isinstance(value, str)),
    int: JSON.filter(lambda value: type(value) is not int),
    float: JSON.filter(lambda value: type(value) not in (int, float)),
    int | None: JSON.filter(lambda value: value is not None and type(value) is not int),
    bool: JSON.filter(lambda value: not isinstance(value, bool)),
    Mapping[str, Any]: JSON.filter(lambda value: not isinstance(value, dict)),
    ExecutorGoal: JSON.filter(lambda value: not isinstance(value, dict)),
}
"""Type of a field -> JSON that it does not take."""


def commands(kind: type[Command]) -> st.SearchStrategy[Command]:
    return st.builds(kind, **{name: VALUES[field.type] for name, field in fields(kind).items()})


def sent(command: Command, number: int = 7) -> dict[str, Any]:
    """A command as another process receives it."""
    message: dict[str, Any] = json.loads(json.dumps(encode(command, number)))
    return message


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(max_examples=20)
@given(data=st.data())
def test_each_comes_back_as_it_was_sent(kind: type[Command], data: st.DataObject) -> None:
    command = data.draw(commands(kind))
    assert decode(sent(command)) == command


@pytest.mark.parametrize("kind", [kind for kind in KINDS if fields(kind)], ids=lambda kind: kind.__name__)
@settings(max_examples=20)
@given(data=st.data())
def test_a_value_of_another_type_is_refused_with_field_and_value(kind: type[Command], data: st.DataObject) -> None:
    message = sent(data.draw(commands(kind)))
    field = data.draw(st.sampled_from(list(fields(kind).values())))
    value = data.draw(OTHERS[field.type])
    with pytest.raises(HardwareError, match=rf"(?s)^malformed command {kind.__name__}: {field.name}: expected "):
        decode({**message, field.name: value})


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(max_examples=20)
@given(data=st.data())
def test_further_fields_and_missing_ones_are_refused(kind: type[Command], data: st.DataObject) -> None:
    message = sent(data.draw(commands(kind)))
    extra = data.draw(st.text(min_size=1, max_size=8))
    assume(extra not in message)
    with pytest.raises(HardwareError, match=rf"(?s)^malformed command {kind.__name__}: .*: unknown key"):
        decode({**message, extra: 1})
    for name in (name for name, field in fields(kind).items() if field.default is attrs.NOTHING):
        with pytest.raises(HardwareError, match=f"^malformed command {kind.__name__}: {name}: required key"):
            decode({key: value for key, value in message.items() if key != name})


HUGE = 10**400
"""A whole number that no float can hold, which JSON may have."""
POINT = {"time_from_start_ns": 1, "positions": [0.1]}
PATH = {"header": {}, "joint_names": ["pan"], "points": [POINT]}
BAD: dict[str, Any] = {
    "expected a mapping, got 3": 3,
    "trajectory: required key is missing": {},
    "position: expected a number, got 'open'": {"position": "open"},
    "position: expected a number, got true": {"position": True},
    "width: unknown key; known keys: position, max_effort": {"position": 1.0, "width": 1},
    "stop: 1.5 is not one of: True": {"stop": 1.5},
    "trajectory: expected a mapping, got 'up'": {"trajectory": "up"},
    "trajectory.joint_names: required key is missing": {"trajectory": {"header": {}, "points": []}},
    "trajectory.points.0.time_from_start_ns: expected a whole number, got 0.5": {
        "trajectory": {**PATH, "points": [{**POINT, "time_from_start_ns": 0.5}]}
    },
    "trajectory.points.0.positions: expected a list of numbers, got 'home'": {
        "trajectory": {**PATH, "points": [{**POINT, "positions": "home"}]}
    },
    "trajectory.points.0.velocities.0: expected a number, got '1'": {
        "trajectory": {**PATH, "points": [{**POINT, "velocities": ["1"]}]}
    },
    "goal_time: expected a number, got 'soon'": {"trajectory": PATH, "goal_time": "soon"},
    "goal_time: 1000000": {"trajectory": PATH, "goal_time": HUGE},
    "path_tolerance: expected a number or a mapping, got a list": {"trajectory": PATH, "path_tolerance": []},
    "at_ns: expected a whole number, got 0.5": {"trajectory": PATH, "takes_over": "one", "at_ns": 0.5},
    "takes_over: expected text, got 1 (quote it: '1')": {"trajectory": PATH, "takes_over": 1},
}


@pytest.mark.parametrize("message", BAD)
def test_a_malformed_goal_is_refused_with_the_place(message: str) -> None:
    with pytest.raises(HardwareError) as refused:
        decode({"do": "SendGoal", "executor": "arm", "goal_id": "one", "goal": BAD[message]})
    assert "malformed command SendGoal: goal" in str(refused.value)
    assert message in str(refused.value)


@given(do=JSON)
def test_a_name_that_no_command_has_is_refused_with_the_names(do: Any) -> None:
    assume(do not in [kind.__name__ for kind in KINDS])
    with pytest.raises(HardwareError, match=r"^control has no command .*; the commands are: SwitchMode, "):
        decode({"do": do})


def test_an_answer_with_an_error_raises_it() -> None:
    assert raise_error({"reply": 1, "generation": 2}) == {"reply": 1, "generation": 2}
    with pytest.raises(HardwareError, match="no servo 3"):
        raise_error({"reply": 1, "error": "no servo 3"})
