"""The JSON Schema: valid itself, takes what the loader takes, refuses what an editor should mark."""

from __future__ import annotations

from typing import Any

import attrs
import jsonschema
import pytest

from ibrobot_core.config.yaml_nodes import parse_yaml
from ibrobot_core.descriptors import SectionDescriptor
from ibrobot_core.options import option
from ibrobot_core.plugins import Entry, Registry

json_schema = pytest.importorskip("ibrobot_import.schema").json_schema
pytestmark = pytest.mark.integration

INFERENCE = ("control_modes", "policy", "inference")


@pytest.fixture
def validator(registry: Registry) -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(json_schema(registry))


def test_it_is_a_json_schema(registry: Registry) -> None:
    jsonschema.Draft202012Validator.check_schema(json_schema(registry))


def test_a_good_file_is_valid(validator: jsonschema.Draft202012Validator, base: str) -> None:
    validator.validate(parse_yaml(base, "robot.yaml").root)


def test_named_hardware_is_valid(validator: jsonschema.Draft202012Validator, base: str) -> None:
    both = "hardware: {l: {type: bus, port: a, joints: [pan, lift]}, r: {type: bus, port: b, joints: [grip]}}"

    validator.validate(parse_yaml(base.replace("hardware: {type: bus, port: /dev/null}", both), "robot.yaml").root)


def test_options_of_an_engine_are_valid(validator: jsonschema.Draft202012Validator, base: str) -> None:
    far = "{model: net, execution_mode: far, server: big}"

    validator.validate(parse_yaml(base.replace("{model: net}", far), "robot.yaml").root)


@pytest.mark.parametrize(
    ("old", "new", "path"),
    [
        ("recording: {type", "recordings: {type", ()),
        ("port: /dev/null}", "port: /dev/null, max_sped: 2.0}", ("hardware",)),
        ("port: /dev/null}", "port: /dev/null, max_speed: 0}", ("hardware", "max_speed")),
        ("port: /dev/null}", "port: /dev/null, torque: on}", ("hardware", "torque")),
        ("port: /dev/null}", "port: /dev/null, parity: odd}", ("hardware", "parity")),
        ("hardware: {type: bus, port: /dev/null}", "hardware: {type: bus}", ("hardware",)),
        ("hardware: {type: bus, port: /dev/null}", "hardware: {type: world}", ("hardware", "type")),
        ("simulation: {type: world}", "simulation: {type: bus}", ("simulation", "type")),
        ("{type: position, group: arm}", "{type: position}", ("executors", "arm_position")),
        ("type: webcam, fps: 30", "type: webcam, fps: fast", ("peripherals", 0, "fps")),
        ("planner: {type: straight}", "planner: {type: bent}", ("control_modes", "plan", "planner", "type")),
        ("{model: net}", "{model: net, server: big}", INFERENCE),
        (
            "{model: net}",
            "{model: net, execution_mode: monolithic, server: big}",
            INFERENCE,
        ),
        (
            "{model: net}",
            "{model: net, execution_mode: fat}",
            (*INFERENCE, "execution_mode"),
        ),
        (
            "{model: net}",
            "{model: net, execution_mode: far, server: 5}",
            (*INFERENCE, "server"),
        ),
        ("net: {type: net}", "net: {type: net, gains: [1.0]}", ("models", "net", "gains")),
        ("strategy: asof", "strategy: newest", ("contract", "observations", 1, "align", "strategy")),
        ("stop: hold}", "stop: hold, priority: 100}", ("control", "priority")),
    ],
)
def test_what_an_editor_marks(
    validator: jsonschema.Draft202012Validator, base: str, old: str, new: str, path: tuple[Any, ...]
) -> None:
    assert base.count(old) == 1

    errors = list(validator.iter_errors(parse_yaml(base.replace(old, new), "robot.yaml").root))

    assert {tuple(error.absolute_path) for error in errors} == {path}


def test_options_carry_unit_default_and_summary(registry: Registry) -> None:
    branch = json_schema(registry)["properties"]["hardware"]["then"]["allOf"][0]["then"]

    assert branch["description"] == "a bus"
    assert branch["properties"]["max_speed"] == {
        "type": "number",
        "exclusiveMinimum": 0,
        "description": "speed limit of the servos [rad/s]",
        "default": 3.0,
    }


@attrs.frozen
class Around:
    """Options of a section that a plugin adds."""

    padding: float = option(0.0, ge=0, help="added around the robot")


def test_sections_of_plugins_are_in_it(registry: Registry) -> None:
    section = SectionDescriptor("around", "what is around the robot", make=lambda *_: None, options=Around)  # type: ignore[arg-type]
    registry.entries["section", "around"] = Entry("section", section, "fake", "ibrobot-plugin-fake", "1.0")
    schema = json_schema(registry)["properties"]["around"]
    assert schema["description"] == "what is around the robot"
    jsonschema.validate({"padding": 0.1}, schema)
    with pytest.raises(jsonschema.ValidationError, match="less than the minimum"):
        jsonschema.validate({"padding": -1}, schema)
    with pytest.raises(jsonschema.ValidationError, match="Additional properties"):
        jsonschema.validate({"paddign": 1}, schema)
