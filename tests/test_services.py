"""Requests of services: what fits, what is refused and how that is told, and that nothing in them is expanded."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import attrs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core import convert
from ibrobot_core.errors import RequestError
from ibrobot_core.options import option
from ibrobot_core.robot import Vector
from ibrobot_core.services import NoRequest, RequestLimits, Service


@attrs.frozen(eq=False)
class Part:
    size: tuple[float, float, float] | None = None
    speeds: Mapping[str, float] = option(factory=dict)
    values: Vector | None = None


@attrs.frozen(eq=False)
class Order:
    name: str = option(help="what it is called")
    count: int = option(1, ge=0, le=9)
    speed: float = option(1.0, unit="m/s", gt=0, le=1)
    kind: Literal["box", "ball"] = "box"
    part: Part | None = None
    parts: tuple[Part, ...] = ()
    file: Path | None = None
    goal: str | Part = option("", plain=str)


ORDER = Service("/order", Order, int)
ALONE = Service("/alone", Order, int, alone="name")
NOTHING = Service("/nothing", NoRequest, int)


def refusal(request: Any, service: Service[Any, Any] = ORDER) -> str:
    with pytest.raises(RequestError) as failure:
        service.read(request)
    return str(failure.value)


def test_plain_data_becomes_an_object_of_the_class():
    found = ORDER.read({"name": "a", "speed": 1, "part": {"size": [1, 2, 3], "values": [1, 2.5]}})
    assert (found.name, found.speed, found.count) == ("a", 1.0, 1)
    assert found.part is not None
    assert found.part.size == (1.0, 2.0, 3.0)
    assert found.part.values is not None
    np.testing.assert_array_equal(found.part.values, [1.0, 2.5])
    assert ALONE.read("b").name == ALONE.read({"name": "b"}).name == "b"
    assert NOTHING.read(None) == NOTHING.read({}) == NoRequest()
    order = Order("c")
    assert ORDER.read(order) is order


REFUSED = {
    "a text": ("a", "expected a mapping with name, count, speed, kind, part, parts, file, goal, got 'a'"),
    "nothing": (None, "name: required key is missing"),
    "an unknown key": ({"name": "a", "sped": 1}, "sped: unknown key, did you mean 'speed'?"),
    "text for a number": ({"name": "a", "speed": "1"}, "speed: expected a number, got '1'"),
    "true for a number": ({"name": "a", "count": True}, "count: expected a whole number, got true"),
    "a list for a text": ({"name": ["a"]}, "name: expected text, got a list"),
    "too fast": ({"name": "a", "speed": 2}, "speed: 2.0 is too large, must be at most 1 m/s"),
    "too slow": ({"name": "a", "speed": 0}, "speed: 0.0 is too small, must be above 0 m/s"),
    "another kind": ({"name": "a", "kind": "cone"}, "kind: 'cone' is not one of: box, ball"),
    "a list for a kind": ({"name": "a", "kind": ["box"]}, "kind: a list is not one of: box, ball"),
    "not a number": ({"name": "a", "speed": float("nan")}, "speed: nan is not a finite number"),
    "infinite, deep": ({"name": "a", "parts": [{"size": [0, 0, -float("inf")]}]}, "parts.0.size.2: -inf is not a"),
    "a large number": ({"name": "a", "speed": 10**400}, "speed: a whole number of more than 64 bits"),
    "two lengths": ({"name": "a", "part": {"size": [1, 2]}}, "part.size: expected a list of 3 values, got 2"),
    "a scalar for an array": ({"name": "a", "part": {"values": 1}}, "part.values: expected a list of numbers, got 1"),
    "an array of lists": ({"name": "a", "part": {"values": [[1]]}}, "part.values.0: expected a number, got a list"),
    "a file": ({"name": "a", "file": "/etc/passwd"}, "file: '/etc/passwd': no file can be named here"),
    "a mapping where programs set objects": ({"name": "a", "goal": {}}, "goal: expected text, got a mapping"),
    "another object": (NoRequest(), "a NoRequest is no plain data: text, numbers, lists and mappings"),
    "an object within": ({"name": "a", "part": Part()}, "part: a Part is no plain data"),
    "a number as a key": ({"name": "a", "part": {"speeds": {1.5: 1}}}, "part.speeds: 1.5 is no key: a key is a text"),
    "control characters": ({"name": "a\x1b[2J"}, r"name: 'a\x1b[2J' has control characters"),
    "half a character": ({"name": "\ud800"}, r"name: '\ud800' has control characters"),
    "a control character in a key": ({"name": "a", "\x00": 1}, r"'\x00' has control characters"),
    "a long text": ({"name": "a" * 1001}, "name: a text of 1001 characters, at most 1000 are allowed"),
    "a long key": ({"name": "a", "b" * 1001: 1}, "a text of 1001 characters, at most 1000 are allowed"),
    "many values": ({"name": "a", "parts": [0] * 2000}, "the request has more than 2000 values"),
}


@pytest.mark.parametrize(("request_", "told"), REFUSED.values(), ids=REFUSED)
def test_requests_that_do_not_fit_are_refused(request_: Any, told: str):
    assert refusal(request_).startswith(f"/order: {told}")


def test_deep_requests_are_refused():
    deep: Any = 1
    for _ in range(10_000):
        deep = [deep]
    assert "more than 10 lists and mappings within one another" in refusal({"name": "a", "parts": deep})


def test_a_message_has_up_to_five_faults():
    assert refusal({"name": 1, "speed": 2, "part": 3}) == (
        "/order: name: expected text, got 1 (quote it: '1'); speed: 2.0 is too large, must be at most 1 m/s; "
        "part: expected a mapping, got 3"
    )
    assert refusal({f"x{i}": 1 for i in range(9)}).endswith("; and more")


def test_no_faults_are_looked_for_beyond_those_in_the_message(monkeypatch: pytest.MonkeyPatch):
    checked: list[object] = []

    def refuse(instance: object, attribute: object, value: object) -> None:
        checked.append(value)
        raise ValueError("no")

    step = attrs.make_class("Step", {"size": option(validator=refuse)}, frozen=True)
    steps = attrs.make_class("Steps", {"steps": attrs.field(type=tuple[step, ...])}, frozen=True)  # type: ignore[valid-type]
    service: Service[Any, Any] = Service("/steps", steps, int)
    assert refusal({"steps": [{"size": 1}] * 900}, service).endswith("; and more")
    assert len(checked) == 6

    def unknown_key(word: str, known: list[str]) -> str:
        checked.append(word)
        return "unknown key"

    monkeypatch.setattr(convert, "unknown_key", unknown_key)
    for request in ({f"x{i}": 1 for i in range(900)}, {"steps": [{f"x{j}": 1 for j in range(9)}] * 90}):
        checked.clear()
        refusal(request, service)
        assert len(checked) == 6


def test_nothing_is_expanded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("IBROBOT_PASSWORD", "hunter2")
    for text in ("${IBROBOT_PASSWORD}", "~/x", "{name: a}", "$IBROBOT_PASSWORD"):
        assert ORDER.read({"name": text}).name == text
        for request in ({"name": "a", "speed": text}, {"name": "a", text: 1}, {"name": "a", "file": text}, text):
            assert "hunter2" not in refusal(request)


def test_files_are_found_by_the_owner():
    def files(text: str) -> Path:
        if text != "a.stl":
            raise OSError(36, "File name too long")
        return Path("/meshes") / text

    assert ORDER.read({"name": "a", "file": "a.stl"}, files).file == Path("/meshes/a.stl")
    with pytest.raises(RequestError, match="file: 'b': File name too long"):
        ORDER.read({"name": "a", "file": "b"}, files)


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from(["a", "box", 10**400])
KEYS = st.sampled_from([*attrs.fields_dict(Order), *attrs.fields_dict(Part)]) | st.text()
PLAIN = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(KEYS, inner))


@given(PLAIN)
def test_any_data_is_read_or_refused(data: Any):
    for service in (ORDER, ALONE, NOTHING):
        told, found = "", None
        try:
            found = service.read(data)
        except RequestError as error:
            told = str(error)
        assert isinstance(found, service.request) or told.startswith(service.name)
        assert len(told) < 5000


@pytest.mark.parametrize("request_", [[0] * 1_000_000, {"name": "a" * 5_000_000}, {str(i): i for i in range(300_000)}])
def test_a_large_request_costs_little(request_: Any):
    tracemalloc.start()
    begun = time.process_time()
    assert len(refusal(request_)) < 5000
    took, (_, most) = time.process_time() - begun, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50_000_000
    assert took < 5.0, "a generous deadline: it takes milliseconds"


def test_limits_are_the_services_own():
    texts = Service("/texts", Order, int, alone="name", limits=RequestLimits(text=10_000))
    assert texts.read("a" * 10_000).name == "a" * 10_000


def test_a_request_is_an_attrs_class():
    with pytest.raises(TypeError, match="/x: the request must be an attrs class, got <class 'int'>"):
        Service("/x", int, int)
