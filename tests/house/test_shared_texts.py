"""A text that core and plugins share, e.g. the name of a topic, stands once: where core has a name for it.

One that plugins share stands in a library on which they depend.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from ibrobot_core import api, app

ROOT = Path(__file__).parents[2]
NAMED = {
    value: name
    for floor in (api, app)
    for name in floor.__all__
    if isinstance(value := getattr(floor, name), str) and name.isupper()
}
"""Text -> its name on a floor of core's interface."""
OTHERS = {
    ("ibrobot_lerobot", "action"): "a feature of LeRobot's",
    ("ibrobot_mujoco", "action"): "a tensor of the policy's own",
    ("ibrobot_onnx", "action"): "an output of the graph",
    ("ibrobot_policy_servers", "action"): "a key of the servers' answers",
    ("ibrobot_serve", "action"): "a key of the answer to clients of GR00T",
}
"""Package and text that mean something else, and what."""
COINCIDENCES = {
    ".staging": "folders of conversions, and of uploads",
    ".unfinished": "episodes of evaluations, and recordings",
    "answer": "messages of two protocols, of LeRobot's devices and of its programs",
    "ready": "messages of two protocols, of LeRobot's devices and of its programs",
    "arm": "groups of joints, of IB-Robot and of identification",
    "arm_view": "a kind of plugins, and a camera of a scene",
    "asked": "what an evaluation shows, and what a person is asked",
    "gripper": "a group of IB-Robot's, and a joint",
    "none": "values of options",
    "outcome": "a key of judgements, and of recordings",
    "range_0_100": "a unit of datasets, and of LeRobot's motors",
    "sample": "a folder of the kit, and a key of graphs",
    "task": "the key of a request of LeRobot's, of a row, and of servers",
}
"""Texts that mean something else in each package, and what."""
SEAMS = {
    "detect": "a section of the robot YAML: agents get its tools if it is there",
    "tasks": "a section of the robot YAML: agents get its tools if it is there",
    "world": "a section of the robot YAML: agents get its tools if it is there",
    "ibrobot-core": "the distribution that the kit's packages depend on",
    "IBROBOT_DEBUG": "a variable of the environment that this program reads without core",
    "observation.environment_state": "LeRobot's name of a feature",
    "observation.images.": "LeRobot's names of features",
    "observation.state": "LeRobot's name of a feature",
    "onnx_policy.json": "the file from the export to the plugin, which share no library",
    "seed": "the key of a checkpoint's and of a graph's inputs, which share no library",
}
"""Texts that several packages share without a library for them, and why."""


@cache
def constants(path: Path) -> tuple[tuple[str, str], ...]:
    """The constants of a module, in capitals: name and text."""
    return tuple(_constants(path))


def _constants(path: Path) -> Iterator[tuple[str, str]]:
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.Assign):
            continue
        pairs = [(target, node.value) for target in node.targets]
        for target, value in [*pairs]:
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):  # A, B = "a", "b"
                pairs += zip(target.elts, value.elts, strict=True)
        for target, value in pairs:
            match target, value:
                case ast.Name(id=name), ast.Constant(value=str() as text) if name.isupper():
                    yield name, text


def shared(packages: list[Path]) -> dict[str, set[str]]:
    """Text -> the constants that are it, of those that are constants of several packages."""
    places = defaultdict[str, set[tuple[str, str]]](set)
    for package in packages:
        for path in package.rglob("*.py"):
            for name, text in constants(path):
                places[text].add((package.name, f"{package.name}/{path.relative_to(package)}: {name}"))
    return {
        text: {where for _, where in each} for text, each in places.items() if len({package for package, _ in each}) > 1
    }


PACKAGES = sorted(path.parent for path in (ROOT / "plugins").glob("*/*ibrobot*/__init__.py"))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_no_package_writes_again_what_core_names(package: Path) -> None:
    again = {
        f"{path.relative_to(package)}: {name} = {text!r} is {NAMED[text]} of core"
        for path in package.rglob("*.py")
        for name, text in constants(path)
        if text in NAMED and (package.name, text) not in OTHERS
    }
    assert not again


def test_no_two_packages_write_the_same_name() -> None:
    known = {"", *COINCIDENCES, *SEAMS, *(text for _, text in OTHERS)}
    again = {text: sorted(places) for text, places in shared([*PACKAGES, ROOT / "ibrobot_core"]).items()}
    new = {text: places for text, places in again.items() if text not in known and text not in NAMED}
    assert not new, f"{new}: write each once, in a library on which these packages depend"
    assert not {*COINCIDENCES, *SEAMS} - again.keys(), "no longer in several packages"


def test_a_text_of_two_packages_is_found(tmp_path: Path) -> None:
    for package in ("one", "two"):
        (tmp_path / package).mkdir()
    (tmp_path / "one/topics.py").write_text('TOPIC = "/joints"\nOWN = "/own"\n')
    (tmp_path / "two/deep.py").write_text('_FIRST, _SECOND = "/others", "/joints"\nlower = "/own"\n')
    found = shared([tmp_path / "one", tmp_path / "two"])
    assert found == {"/joints": {"one/topics.py: TOPIC", "two/deep.py: _SECOND"}}
