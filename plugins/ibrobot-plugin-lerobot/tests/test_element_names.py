# mypy: disable-error-code="arg-type"
"""Names of a dataset's elements, in every form that others write: they are the contract's, or it is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_lerobot import layout
from ibrobot_lerobot.reader import LeRobotReader

from ibrobot_core.api import ContractError, EpisodeAddress

from .conftest import values
from .test_reader import FEATURES, foreign, provenance

KEYS = ("observation.state", "action")
RIGHT = ("a.pos", "b.pos", "c.pos")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return foreign(tmp_path_factory.mktemp("sets") / "set", videos=False)


def read(root: Path, names: Any, /, *keys: str, **more: str) -> list[Any]:
    """Episode 0 of a dataset whose `names` of some features are replaced."""
    path = root / layout.INFO
    original = path.read_bytes()
    document = json.loads(original)
    for key in keys or KEYS:
        if names is ...:
            del document["features"][key]["names"]
        else:
            document["features"][key]["names"] = names
    path.write_text(json.dumps(document))
    try:
        return list(LeRobotReader(EpisodeAddress(root, 0, provenance(**more))).messages())
    finally:
        path.write_bytes(original)


def commands(items: list[Any]) -> list[Any]:
    return [item.message.data for item in items if item.topic == "/arm"]


@pytest.mark.parametrize(
    "names",
    [
        list(RIGHT),
        {"motors": list(RIGHT)},
        {"motors": ["a", "b", "c"]},
        {"motors": {"follower": ["a", "b", "c"]}},
        [["a", "b", "c"]],
        {"c": 2, "a": 0, "b": 1},
        {"axes": {"a.pos": 0, "b.pos": 1, "c.pos": 2}},
    ],
)
def test_every_form_of_names_names_the_joints(dataset: Path, names: Any):
    items = commands(read(dataset, names))
    np.testing.assert_array_equal(items[0], values(FEATURES, 0)["action"])


@pytest.mark.parametrize(
    "names",
    [
        {"motors": ["c", "b", "a"]},
        {"motors": ["a.pos", "c.pos", "b.pos"]},
        {"motors": {"follower": ["b", "a", "c"]}},
        {"a": 0, "b": 2, "c": 1},
        ["main_a", "main_b", "main_c"],
    ],
)
def test_other_order_or_names_are_refused_with_both_sides(dataset: Path, names: Any):
    with pytest.raises(ContractError, match=r"does not match the contract:\n *dataset: .*\n *contract: .*a.pos, b.pos"):
        read(dataset, names)


@pytest.mark.parametrize(
    "names",
    [
        ...,
        None,
        [],
        {},
        ["motors"],
        {"motors": None},
        {"motors": ["a", "b"]},
        {"motors": ["a", "b", "b"]},
        {"left": ["a"], "right": ["b", "c"]},
        {"a": 0, "b": 1},
        {"a": 0, "b": 1, "c": 1},
        {"a": 1, "b": 2, "c": 3},
        {"motors": [0, 1, 2]},
        "abc",
        7,
    ],
)
@pytest.mark.parametrize("key", KEYS)
def test_names_that_do_not_tell_the_order_are_asked_for(dataset: Path, names: Any, key: str):
    with pytest.raises(
        ContractError, match=rf"{key} does not name its elements.*state it with --names {key}=a.pos,b.p"
    ):
        read(dataset, names, key)


def test_stated_order_is_taken_if_it_is_the_contracts(dataset: Path):
    stated = {key: ["a", "b", "c"] for key in KEYS}
    assert len(commands(read(dataset, None, names=json.dumps(stated)))) == 3
    with pytest.raises(ContractError, match=r"action does not match the contract:\n *dataset: .*a, c, b"):
        read(dataset, None, names=json.dumps({**stated, "action": ["a", "c", "b"]}))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_no_form_of_names_moves_another_joint(dataset: Path, data: st.DataObject):
    """Lists, dicts, nested, positions, with orders, names and numbers of names as they come."""
    order = data.draw(st.one_of(st.permutations("abc"), st.lists(st.sampled_from("abcd"), max_size=4)))
    suffix = data.draw(st.sampled_from(("", ".pos", ".vel")))
    names: Any = [f"{joint}{suffix}" for joint in order]
    form = data.draw(st.sampled_from(("list", "positions", "groups", "indices")))
    shuffled = data.draw(st.permutations(list(enumerate(names))))
    if form == "positions":
        names = {name: place for place, name in shuffled}
    elif form == "groups":
        names = {"second": names[2:], "first": names[:2]}
    elif form == "indices":
        names = {str(place): name for place, name in shuffled}
    for _ in range(data.draw(st.integers(0, 3))):
        names = data.draw(st.sampled_from(({"motors": names}, [names])))
    try:
        moved = commands(read(dataset, names))
    except ContractError:
        return
    assert (order, suffix in ("", ".pos")) == (["a", "b", "c"], True)
    np.testing.assert_array_equal(moved[0], values(FEATURES, 0)["action"])
