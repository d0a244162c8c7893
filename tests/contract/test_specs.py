"""The contract: what the YAML leaves open is filled in, and the fingerprint follows what shapes the data, no more."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import pytest
import yaml
from ibrobot_testing.contexts import ARM, GRIPPER

from ibrobot_core.config import load_config
from ibrobot_core.contract.specs import Contract
from ibrobot_core.descriptors import HardwareDescriptor
from ibrobot_core.interfaces.feature import Feature
from ibrobot_core.plugins import Entry, discover
from ibrobot_core.schema import ActionSpec, Align, ImageSpec, ObservationSpec

Make = Callable[..., Any]

STATE = ObservationSpec("observation.state", topic="/joint_states")
TOP = ObservationSpec("observation.images.top", peripheral="top", image=ImageSpec(resize=(2, 3)))
IMU = ObservationSpec("observation.imu", topic="/imu", type="sensor_msgs/msg/Imu", select=("angular_velocity",))
SCENE = ObservationSpec("observation.environment_state", topic="/scene", type="std_msgs/msg/Float64MultiArray")
IMAGE_NAMES = ("height", "width", "channels")


def contract(make_config: Make, *observations: ObservationSpec, **changes: Any) -> Contract:
    return Contract.from_config(make_config(observations, **changes))


def test_features_are_as_lerobot_describes_them(make_config: Make) -> None:
    joints = tuple(f"{name}.pos" for name in ARM + GRIPPER)
    assert contract(make_config, STATE, TOP).features() == {
        "observation.state": Feature("float32", (6,), joints),
        "observation.images.top": Feature("image", (2, 3, 3), IMAGE_NAMES),
        "action": Feature("float32", (6,), joints),
    }


def test_specs_of_one_key_concatenate_in_file_order(make_config: Make) -> None:
    elbow = attrs.evolve(STATE, select=("velocity.elbow_flex", "position.gripper"))
    imu = attrs.evolve(IMU, key="observation.state")
    both = contract(make_config, elbow, TOP, imu).observations["observation.state"]
    names = ("elbow_flex.vel", "gripper.pos", "angular_velocity.x", "angular_velocity.y", "angular_velocity.z")
    assert both == Feature("float32", (5,), names)
    assert list(contract(make_config, TOP, elbow, imu).observations) == ["observation.images.top", "observation.state"]


def test_a_length_that_only_messages_know_is_open(make_config: Make) -> None:
    assert contract(make_config, SCENE).observations[SCENE.key] == Feature("float32", (-1,))
    mixed = contract(make_config, STATE, attrs.evolve(SCENE, key=STATE.key))
    assert mixed.observations[STATE.key] == Feature("float32", (-1,))


@pytest.mark.parametrize(
    ("peripheral", "image", "expected"),
    [
        ("top", None, Feature("image", (4, 6, 3), IMAGE_NAMES)),
        ("top", ImageSpec(encoding="mono8"), Feature("image", (4, 6, 1), IMAGE_NAMES)),
        ("wrist", None, Feature("image", (-1, -1, 3), IMAGE_NAMES)),
        ("wrist", ImageSpec((2, 3), "16UC1"), Feature("uint16", (2, 3, 1), IMAGE_NAMES)),
        ("wrist", ImageSpec((2, 3), "32FC1"), Feature("float32", (2, 3, 1), IMAGE_NAMES)),
    ],
)
def test_images(make_config: Make, peripheral: str, image: ImageSpec | None, expected: Feature) -> None:
    spec = attrs.evolve(TOP, peripheral=peripheral, image=image)
    made = contract(make_config, spec)
    assert made.observations[TOP.key] == expected
    assert made.topics[f"/camera/{peripheral}/image_raw"] == "sensor_msgs/msg/Image"


def test_a_compressed_picture_is_a_picture(make_config: Make) -> None:
    raw = ObservationSpec("observation.images.desk", topic="/desk", type="sensor_msgs/msg/Image")
    compressed = attrs.evolve(raw, type="sensor_msgs/msg/CompressedImage")
    assert contract(make_config, compressed).fingerprint() == contract(make_config, raw).fingerprint()


def test_a_message_without_a_header_goes_by_its_receipt(make_config: Make) -> None:
    made = contract(make_config, STATE, SCENE)
    assert [part.align.stamp for part in made.observation_parts] == ["header", "receive"]


def test_an_episode_has_a_contract_or_none(make_config: Make) -> None:
    contract = Contract.from_config(make_config((STATE,)))
    found = Contract.of_episode({"contract": json.dumps(contract.canonical())})
    assert found is not None
    assert found.fingerprint() == contract.fingerprint()
    for foreign in ({}, {"contract": "of sale"}, {"contract": "3"}, {"contract": '{"rate_hz": 30}'}):
        assert Contract.of_episode(foreign) is None


def test_a_foreign_type_is_read_back_as_it_was(make_config: Make) -> None:
    spec = ObservationSpec(
        "observation.touch", topic="/touch", type="lamp_msgs/msg/Touch", foreign=True, select=("tags.0.id", "x")
    )
    contract = Contract.from_config(make_config((STATE, spec)))
    assert contract.observations["observation.touch"] == Feature("float32", (2,), ("tags.0.id", "x"))
    again = Contract.from_canonical(json.loads(json.dumps(contract.canonical())))
    assert again.fingerprint() == contract.fingerprint()
    assert again.parts("observation.touch") == contract.parts("observation.touch")


@pytest.mark.parametrize(
    ("type_", "select", "expected"),
    [
        ("sensor_msgs/msg/JointState", (), ("position.gripper",)),
        ("trajectory_msgs/msg/JointTrajectory", ("points.0.positions.0",), ("points.0.positions.0",)),
        ("lamp_msgs/msg/Command", ("joints.0.target",), ("joints.0.target",)),
    ],
)
def test_foreign_commands_are_read_back_as_they_were(
    make_config: Make, type_: str, select: tuple[str, ...], expected: tuple[str, ...]
) -> None:
    action = ActionSpec(executor="gripper_position", topic="/lamp/command", type=type_, foreign=True, select=select)
    contract = Contract.from_config(make_config((STATE,), (action,)))
    assert contract.action_parts[0].select == expected
    again = Contract.from_canonical(json.loads(json.dumps(contract.canonical())))
    assert again.fingerprint() == contract.fingerprint()
    assert again.action_parts[0].select == expected


def test_steps_joints_and_topics(make_config: Make) -> None:
    made = contract(make_config, STATE)
    assert made.step_ns == 33_333_333
    assert made.action_joints == ARM + GRIPPER
    assert made.topics == {
        "/joint_states": "sensor_msgs/msg/JointState",
        "/arm/commands": "std_msgs/msg/Float64MultiArray",
        "/gripper/commands": "std_msgs/msg/Float64MultiArray",
    }
    assert [(part.executor, part.safety_behavior) for part in made.action_parts] == [
        ("arm_position", "hold"),
        ("gripper_position", "hold"),
    ]


def test_extra_observations_join(make_config: Make) -> None:
    made = Contract.from_config(make_config([STATE]), [SCENE])
    assert list(made.observations) == ["observation.state", "observation.environment_state"]
    assert made.fingerprint() != contract(make_config, STATE).fingerprint()


SELECTED = attrs.evolve(STATE, select=("position.gripper", "position.elbow_flex"))
FINGERPRINT_BASE = (SELECTED, attrs.evolve(TOP, align=Align("asof", "header", 100.0)))


def changed(**changes: Any) -> tuple[ObservationSpec, ...]:
    return (attrs.evolve(SELECTED, **changes), FINGERPRINT_BASE[1])


def changed_image(**changes: Any) -> tuple[ObservationSpec, ...]:
    return (SELECTED, attrs.evolve(FINGERPRINT_BASE[1], **changes))


SHAPING: dict[str, dict[str, Any]] = {
    "joint order": {"observations": changed(select=SELECTED.select[::-1])},
    "fewer joints": {"observations": changed(select=SELECTED.select[:1])},
    "another field": {"observations": changed(select=("position.gripper", "velocity.elbow_flex"))},
    "another topic": {"observations": changed(topic="/other", type="sensor_msgs/msg/JointState")},
    "another key": {"observations": changed(key="observation.joints")},
    "strategy": {"observations": changed(align=Align("drop"))},
    "which stamp": {"observations": changed(align=Align("hold", "receive"))},
    "tolerance": {"observations": changed_image(align=Align("asof", "header", 99.0))},
    "image size": {"observations": changed_image(image=ImageSpec((3, 2)))},
    "image encoding": {"observations": changed_image(image=ImageSpec((2, 3), "bgr8"))},
    "another camera": {"observations": changed_image(peripheral="wrist")},
    "one more": {"observations": (*FINGERPRINT_BASE, IMU)},
    "one less": {"observations": FINGERPRINT_BASE[:1]},
    "rate": {"rate_hz": 31.0},
    "action joints": {"actions": (ActionSpec(executor="arm_position", topic="/arm/commands"),)},
    "action order": {"actions": (ActionSpec(executor="whole_position", topic="/arm/commands"),)},
}


@pytest.mark.parametrize("change", SHAPING)
def test_each_shaping_change_changes_the_fingerprint_and_shows_both_sides(make_config: Make, change: str) -> None:
    base = Contract.from_config(make_config(FINGERPRINT_BASE))
    other = Contract.from_config(make_config(**{"observations": FINGERPRINT_BASE, **SHAPING[change]}))
    assert base.fingerprint() != other.fingerprint()
    lines = base.difference(other, ("robot", "policy")).splitlines()
    assert len(lines) % 3 == 0
    assert lines[1].startswith("   robot: ")
    assert lines[2].startswith("  policy: ")
    assert lines[1][10:] != lines[2][10:]


@pytest.mark.parametrize(
    "same",
    [
        {"observations": FINGERPRINT_BASE[::-1]},
        {"observations": FINGERPRINT_BASE, "rate_hz": 30},
        {"observations": changed(type="sensor_msgs/msg/JointState")},
        {
            "observations": FINGERPRINT_BASE,
            "actions": (
                ActionSpec(executor="arm_position", topic="/arm/commands", safety_behavior="relax"),
                ActionSpec(executor="gripper_position", topic="/gripper/commands"),
            ),
        },
    ],
)
def test_what_shapes_nothing_keeps_the_fingerprint(make_config: Make, same: dict[str, Any]) -> None:
    base, other = Contract.from_config(make_config(FINGERPRINT_BASE)), Contract.from_config(make_config(**same))
    assert base.fingerprint() == other.fingerprint()
    assert base.difference(other) == ""


def test_difference_with_a_contract_read_back(make_config: Make) -> None:
    base = Contract.from_config(make_config(FINGERPRINT_BASE))
    assert base.difference(json.loads(json.dumps(base.canonical()))) == ""
    other = json.loads(json.dumps(contract(make_config, SELECTED, rate_hz=50.0).canonical()))
    text = base.difference(other)
    assert text.startswith("rate_hz\n   this: 30.0\n  other: 50.0\nobservation.images.top\n   this: topic: /camera")
    assert text.endswith("\n  other: (none)")


def test_the_fingerprint_never_changes_between_releases(make_config: Make) -> None:
    """It is written into bags and checkpoints; whoever changes it makes them unusable and says so in the change log."""
    expected = "81a5542824b97e7934624569a7d866e87e12467b09f2904f0bca2b75666b3dcf"
    assert Contract.from_config(make_config(FINGERPRINT_BASE)).fingerprint() == expected


ROBOT = """
robot:
  name: two
  joints:
    - {name: a, lower: -1, upper: 1, max_velocity: 2, max_acceleration: 10}
    - {name: b, lower: -1, upper: 1, max_velocity: 2, max_acceleration: 10}
  groups: {all: [a, b]}
hardware: {type: bus}
executors: {both: {type: position, group: all}}
control_modes: {idle: {executors: [both], teleop: stick}}
default_control_mode: idle
teleoperation: {stick: {type: stick}}
contract:
  rate_hz: 30
  observations:
    - key: observation.state
      topic: /joint_states
      select: [position.b, velocity.a]
      align: {strategy: asof, stamp: header, tol_ms: 20}
  actions:
    - {executor: both, topic: /both}
"""


def never_made(options: Any, ctx: Any) -> Any:
    """The `make` of descriptors whose objects no test makes."""


def reversed_keys(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: reversed_keys(value[key]) for key in reversed(value)}
    return [reversed_keys(item) for item in value] if isinstance(value, list) else value


def test_the_order_of_yaml_keys_keeps_the_fingerprint(tmp_path: Path) -> None:
    registry = discover([])
    for kind, type_ in (("hardware", "bus"), ("teleop", "stick")):
        descriptor = HardwareDescriptor(type=type_, make=never_made, summary="")
        registry.entries[kind, type_] = Entry(kind, descriptor, "test", "test", "0")
    contracts = []
    for i, document in enumerate((yaml.safe_load(ROBOT), reversed_keys(yaml.safe_load(ROBOT)))):
        path = tmp_path / f"{i}.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        contracts.append(Contract.from_config(load_config(path, registry=registry)))
    assert contracts[0].fingerprint() == contracts[1].fingerprint()
    assert contracts[0].observations["observation.state"].names == ("b.pos", "a.vel")
