"""Schemas fit what services read: what a schema allows is read, and what a service refuses is not allowed by type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import attrs
import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_provenance.option_schemas import OptionSchemas

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, Service


@attrs.frozen
class Inner:
    """A part."""

    x: float = option(0.0, unit="m", help="a distance")
    way: Literal["up", "down"] = option("up", help="a direction")


@attrs.frozen
class Outer:
    """A request."""

    name: str = option(help="a name")
    count: int = option(1, ge=0, le=9, help="a number")
    on: bool = option(False, help="whether it is on")
    xyz: tuple[float, float, float] | None = option(None, help="a position")
    parts: tuple[Inner, ...] = option((), help="parts")
    joints: Mapping[str, float] = option(factory=dict, help="positions")


SERVICE = Service("/outer", Outer, type(None))
SCHEMA = OptionSchemas().of_class(SERVICE.request)
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-5, 20)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
KEYS = st.fixed_dictionaries({}, optional={name: JSON for name in attrs.fields_dict(Outer)})


def test_schema_says_type_unit_bounds_and_default() -> None:
    assert SCHEMA["properties"]["count"] == {
        "type": "integer", "description": "a number", "minimum": 0, "maximum": 9, "default": 1,
    }  # fmt: skip
    inner = SCHEMA["properties"]["parts"]["items"]
    assert inner["properties"]["x"] == {"type": "number", "description": "a distance [m]", "default": 0.0}
    assert inner["properties"]["way"]["enum"] == ["up", "down"]
    assert SCHEMA["properties"]["xyz"]["anyOf"][0] == {
        "type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3,
    }  # fmt: skip
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@attrs.frozen
class Chosen:
    """Options with choices, and one of the same class."""

    any_of: str = option("a", choices=("a", "b"), open=True, help="one of these, or another")
    several: tuple[str, ...] = option((), choices=("a", "b"), help="some of these")
    mixed: tuple[str, int] = option(("a", 1), help="a text and a number")
    again: Chosen | None = option(None, help="the same again")


def test_choices_limit_items_and_not_what_is_open_and_a_class_within_itself_ends() -> None:
    schema = OptionSchemas().of_class(Chosen)
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    for right in ({"any_of": "c"}, {"several": ["a", "b"]}, {"mixed": ["x", 2]}, {"again": {"again": None}}):
        assert validator.is_valid(right), right
    for wrong in ({"several": ["a", "c"]}, {"mixed": ["x", "y"]}, {"mixed": ["x", 1, 2]}, {"again": {"any_of": 1}}):
        assert not validator.is_valid(wrong), wrong


@settings(max_examples=400, deadline=None)
@given(KEYS)
def test_service_reads_what_the_schema_allows_and_nothing_else(request: dict[str, Any]) -> None:
    allowed = jsonschema.Draft202012Validator(SCHEMA).is_valid(request)
    try:
        SERVICE.read(request)
    except RequestError:
        assert not allowed or _beyond(request)
    else:
        assert allowed


def _beyond(request: Any) -> bool:
    """Whether a text has characters, or a number a size, that requests may not have and schemas cannot say."""
    if isinstance(request, str):
        return not request.isprintable()
    if isinstance(request, float):
        return True  # of an integer, 2.0 is allowed by schemas; and numbers have a largest size
    if isinstance(request, dict):
        return any(_beyond(each) for pair in request.items() for each in pair)
    return isinstance(request, list) and any(map(_beyond, request))


@pytest.mark.parametrize("request_", [{"name": 3}, {"name": "a", "count": 10}, {"name": "a", "b": 1}, {}])
def test_what_is_wrong_for_both(request_: Any) -> None:
    assert not jsonschema.Draft202012Validator(SCHEMA).is_valid(request_)
    with pytest.raises(RequestError):
        SERVICE.read(request_)
