"""Every robot, teleoperator and camera class of LeRobot, without its device: what maps is as the page says."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from ibrobot_lerobot_devices import library
from ibrobot_lerobot_devices.units import POSITION, Choices, UnitProblem, bases, map_joints

pytestmark = pytest.mark.lerobot

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "drive-any-lerobot-robot.md"
VALUES = {"side": "left", "name": "teleop", "image_type": "left"}
"""Required fields with a choice of values."""
PLAIN: Mapping[str, Any] = {"str": "/dev/null", "int": 1, "float": 1.0, "bool": False}


def required(fields: Mapping[str, Any]) -> dict[str, Any]:
    """A config with only what is required."""
    found = {}
    for name, field in fields.items():
        if field["required"]:
            plain = VALUES.get(name, PLAIN.get(field["type"][0], {}))
            found[name] = required(field["fields"]) if "fields" in field else plain
    return found


def outcome(kind: library.Kind, type_: str, fields: Mapping[str, Any], folder: Path) -> str:
    """What maps, in the words of the page."""
    config = required(fields)
    if kind != "camera":
        config |= {"id": "tester", "calibration_dir": str(folder)}
    try:
        device = library.make(kind, type_, config)
    except library.DeviceError as error:
        missing = re.search(r"'?([\w-]+)'? is required", str(error))
        return f"needs {missing[1]}" if missing else "needs its device"
    if kind == "camera":
        return "maps"
    found = library.facts(device)
    features = found["action_features"]
    positions = list(bases(features, POSITION))
    if not positions:
        return "no joints"
    limits = dict.fromkeys(positions, (-1.0, 1.0))
    try:
        mapped = map_joints(features, found["motors"], Choices({}, {}, "pose", (), ()), positions, limits)
    except UnitProblem:
        return f"{len(positions)} joints, give `units`"
    return f"{len(positions)} joints: {', '.join(sorted({each.unit for each in mapped}))}"


def test_the_page_has_every_class_and_what_maps(tmp_path: Path) -> None:
    described = library.describe()
    found = {
        (kind, name): outcome(kind, name, each["fields"], tmp_path)
        for kind in library.KINDS
        for name, each in described[kind].items()
        if each["module"].startswith("lerobot.")
    }
    rows = re.findall(r"^\| (robot|teleoperator|camera) \| `(\w+)` \| (.+?) \|", PAGE.read_text(), re.MULTILINE)
    assert {(kind, name): text for kind, name, text in rows} == found
