"""The component of the section: what it publishes, and what it finds wrong with a robot."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_kinematics.description import DescriptionPublisher
from ibrobot_kinematics.hooks import ibrobot_sections
from ibrobot_testing import SectionSuite, check_descriptor, make_robot, make_session

from ibrobot_core.api import HardwareDescriptor, Header, JointState, Options, SensorDescriptor, TFMessage
from ibrobot_core.app import Component, ConfigError, Registry, RobotConfig, Session, installed_plugins, load_config

URDF = textwrap.dedent("""\
    <robot name="tester">
      <link name="base_link"/>
      <link name="shoulder"/>
      <link name="tool"/>
      <joint name="shoulder_pan" type="revolute">
        <parent link="base_link"/><child link="shoulder"/><axis xyz="0 0 1"/>
        <limit lower="-3" upper="3" velocity="1" effort="1"/>
      </joint>
      <joint name="flange" type="fixed">
        <parent link="shoulder"/><child link="tool"/><origin xyz="0 0 0.1"/>
      </joint>
    </robot>
    """)
SRDF = '<robot name="tester"><disable_collisions link1="base_link" link2="shoulder"/></robot>\n'


def session_of(folder: Path, srdf: bool = False) -> Session:
    (folder / "robot.urdf").write_text(URDF)
    (folder / "robot.srdf").write_text(SRDF)
    robot = make_robot()
    paths: dict[str, Any] = {"urdf": folder / "robot.urdf", "srdf": folder / "robot.srdf" if srdf else None}
    return make_session(robot=attrs.evolve(robot, description=attrs.evolve(robot.description, **paths)))


class TestDescriptionPublisher(SectionSuite):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path) -> None:
        self.folder = tmp_path

    @override
    def session(self) -> Session:
        return session_of(self.folder)

    @override
    def component(self, session: Session) -> Component:
        return DescriptionPublisher(session)


def test_descriptor_is_complete() -> None:
    _, descriptor = ibrobot_sections()
    check_descriptor(descriptor, Options())


@pytest.fixture
def publish(tmp_path: Path) -> Callable[..., Session]:
    def run(srdf: bool = False) -> Session:
        session = session_of(tmp_path, srdf)
        component = DescriptionPublisher(session)
        component.start()
        positions = np.arange(6) * 0.1
        session.bus.publish("/joint_states", JointState(Header(9), session.config.robot.joint_names, positions + 1))
        component.step(0)
        component.stop()
        return session

    return run


def latched(session: Session) -> dict[str, Any]:
    return {topic: received.message for topic, received in session.bus.latched().items()}


def test_description_is_latched(publish: Callable[..., Session]) -> None:
    found = latched(publish())
    assert found["/robot_description"].data == URDF
    assert "/robot_description_semantic" not in found
    fixed = found["/tf_static"]
    assert [(each.header.frame_id, each.child_frame_id) for each in fixed.transforms] == [("shoulder", "tool")]


def test_srdf_is_latched_where_the_robot_has_one(publish: Callable[..., Session]) -> None:
    assert latched(publish(srdf=True))["/robot_description_semantic"].data == SRDF


def test_moving_links_follow_the_joint_states(tmp_path: Path) -> None:
    session = session_of(tmp_path)
    frames = session.bus.subscribe("/tf", 10)
    component = DescriptionPublisher(session)
    component.start()
    session.bus.publish("/joint_states", JointState(Header(9), session.config.robot.joint_names, np.ones(6)))
    component.step(0)
    (received,) = frames.drain()
    assert isinstance(received.message, TFMessage)
    (pan,) = received.message.transforms
    assert (pan.header.stamp_ns, pan.child_frame_id) == (9, "shoulder")
    assert pan.rotation.z == pytest.approx(np.sin(0.5))
    component.stop()
    frames.close()


def test_moving_links_are_not_computed_for_nobody(tmp_path: Path) -> None:
    session = session_of(tmp_path)
    component = DescriptionPublisher(session)
    component.start()
    session.bus.publish("/joint_states", JointState(Header(9), session.config.robot.joint_names, np.ones(6)))
    component.step(0)
    assert "/tf" not in session.bus.topics()
    component.stop()


def test_robot_without_urdf_and_mounts_needs_no_component(tmp_path: Path) -> None:
    _, descriptor = ibrobot_sections()
    assert not descriptor.without_section(make_session().config)
    assert descriptor.without_section(session_of(tmp_path).config)


ROBOT = """\
robot:
  name: tester
  joints:
    - {name: shoulder_pan, lower: -1, upper: 1, max_velocity: 2, max_acceleration: 10}
  groups: {arm: [shoulder_pan]}
  description: {urdf: robot.urdf}
hardware: {type: none}
peripherals:
  - {name: top, kind: camera, type: none}
  - {name: wrist, kind: camera, type: none}
executors:
  arm: {type: position, group: arm}
control_modes:
  idle: {executors: [arm]}
default_control_mode: idle
"""


def _nothing(options: object, ctx: object) -> Any:
    raise AssertionError("checking a config makes nothing")


@pytest.fixture
def registry() -> Registry:
    """This plugin, with hardware and sensors that exist on paper alone."""
    known = installed_plugins()
    section = known.entries["section", "description"]
    made_up: dict[tuple[str, str], Any] = {
        ("hardware", "none"): HardwareDescriptor("none", _nothing, "nothing"),
        ("sensor", "none"): SensorDescriptor("none", _nothing, "nothing"),
    }
    entries = {key: attrs.evolve(section, kind=key[0], descriptor=found) for key, found in made_up.items()}
    return attrs.evolve(known, entries={**known.entries, **entries})


Faults = Callable[..., str]


@pytest.fixture
def load(tmp_path: Path, registry: Registry) -> Callable[..., RobotConfig]:
    """Loads the robot above, with keys for its cameras and other models."""

    def run(
        top: str = "", wrist: str = "", urdf: str = URDF, srdf: str | None = None, mjcf: str | None = None,
        joint: str = "", tip: str = "",
    ) -> RobotConfig:  # fmt: skip
        text = ROBOT.replace("lower: -1,", f"{joint or 'lower: -1'},")
        if mjcf is not None:
            (tmp_path / "arm.xml").write_text(mjcf)
            text = text.replace("{urdf:", "{mjcf: arm.xml, urdf:")
        text = text.replace("{urdf:", f"{{tip: {tip}, urdf:").replace("{mjcf:", f"{{tip: {tip}, mjcf:") if tip else text
        for name, more in (("top", top), ("wrist", wrist)):
            text = text.replace(f"name: {name}, kind: camera", f"name: {name}, kind: camera{more and ', '}{more}")
        (tmp_path / "robot.urdf").write_text(urdf)
        if srdf is not None:
            (tmp_path / "robot.srdf").write_text(srdf)
            text = text.replace("{urdf: robot.urdf}", "{urdf: robot.urdf, srdf: robot.srdf}")
        (tmp_path / "robot.yaml").write_text(text)
        return load_config(tmp_path / "robot.yaml", registry=registry)

    return run


@pytest.fixture
def faults(load: Callable[..., RobotConfig], tmp_path: Path) -> Faults:
    def run(**changes: str) -> str:
        with pytest.raises(ConfigError) as error:
            load(**changes)
        return str(error.value).replace(f"{tmp_path}/", "")

    return run


def test_mounts_are_static_transforms_of_the_robot(load: Callable[..., RobotConfig]) -> None:
    config = load(wrist="transform: {parent: tool, xyz: [0, 0, 0.05], rpy: [0, 1.2, 0]}")
    session = make_session(robot=config.robot, peripherals=config.peripherals, document=config.document)
    component = DescriptionPublisher(session)
    component.start()
    component.stop()
    frames = latched(session)["/tf_static"].transforms
    assert [(each.header.frame_id, each.child_frame_id) for each in frames] == [
        ("shoulder", "tool"),
        ("tool", "wrist_frame"),
        ("wrist_frame", "wrist_optical_frame"),
    ]


def test_mount_may_carry_a_mount(load: Callable[..., RobotConfig]) -> None:
    config = load(
        top="transform: {parent: wrist_frame, frame: lens}",
        wrist="transform: {parent: tool, quaternion: [0, 0, 0.7071, 0.7071]}",
    )
    top = config.peripherals["top"].transform
    assert top is not None
    assert (top.frame, top.xyz) == ("lens", (0.0, 0.0, 0.0))


TOP_PARENT = "robot.yaml:9: peripherals.top.transform.parent: frame 'top_frame'"
TOP, WRIST = "robot.yaml:9: peripherals.top.transform", "robot.yaml:10: peripherals.wrist.transform"


@pytest.mark.parametrize(
    ("top", "wrist", "error"),
    [
        ("transform: {}", "", f"{TOP}.parent: required key is missing"),
        ("transform: {parent: tol}", "", f"{TOP_PARENT} has an unknown parent 'tol', did you mean 'tool'?"),
        ("transform: {parent: map}", "", f"{TOP_PARENT} has an unknown parent 'map'; the frames are: "
         "base_link, shoulder, tool, top_frame, top_optical_frame"),
        ("transform: {parent: top_frame}", "", f"{TOP_PARENT} is its own ancestor: top_frame -> top_frame"),
        ("transform: {parent: top_optical_frame}", "",
         f"{TOP_PARENT} is its own ancestor: top_frame -> top_optical_frame -> top_frame"),
        ("transform: {parent: wrist_frame}", "transform: {parent: top_frame}",
         f"{TOP_PARENT} is its own ancestor: top_frame -> wrist_frame -> top_frame\n"
         f"{WRIST}.parent: frame 'wrist_frame' is its own ancestor: wrist_frame -> top_frame -> wrist_frame"),
        ("transform: {parent: tool, frame: shoulder}", "",
         f"{TOP}.frame: frame 'shoulder' is already a link of robot.urdf; set another name in transform.frame"),
        ("transform: {parent: tool, frame: eye}", "transform: {parent: tool, frame: eye}",
         f"{WRIST}.frame: frame 'eye' is already a frame of peripheral 'top'; set another name in transform.frame"),
        ("transform: {parent: tool, xyz: [0, 0]}", "", f"{TOP}.xyz: expected a list of 3 values, got 2"),
        ("transform: {parent: tool, xyz: [0, 0, .nan]}", "", f"{TOP}: xyz, rpy and quaternion must be finite numbers"),
        ("transform: {parent: tool, rpy: [0, 0, 0], quaternion: [0, 0, 0, 1]}", "",
         f"{TOP}: rpy and quaternion exclude each other; give one of them"),
        ("transform: {parent: tool, quaternion: [0, 0, 0, 2]}", "", f"{TOP}: quaternion has length 2, must have 1"),
        ("transform: {parent: tool, yaw: 1}", "",
         f"{TOP}.yaw: unknown key; known keys: parent, xyz, rpy, quaternion, frame"),
    ],
)  # fmt: skip
def test_wrong_mounts_are_named_with_line_and_frame(faults: Faults, top: str, wrist: str, error: str) -> None:
    assert faults(top=top, wrist=wrist) == error


def test_wrong_models_are_named_with_their_own_line(faults: Faults) -> None:
    at = "robot.yaml:6: robot.description"
    assert faults(urdf=URDF.replace('<child link="tool"/>', '<child link="tol"/>')) == (
        f"{at}.urdf: robot.urdf:10: joint 'flange': unknown link 'tol', did you mean 'tool'?"
    )
    assert faults(srdf=SRDF.replace("base_link", "base")) == (
        f"{at}.srdf: robot.srdf:1: unknown link 'base', did you mean 'base_link'?"
    )


def test_srdf_needs_a_urdf(load: Callable[..., RobotConfig], tmp_path: Path, registry: Registry) -> None:
    load(srdf=SRDF)
    path = tmp_path / "robot.yaml"
    path.write_text(
        path.read_text()
        .replace("urdf: robot.urdf, ", "")
        .replace("kind: camera, type: none}", "kind: camera, type: none, transform: {parent: world}}", 1)
    )
    with pytest.raises(ConfigError, match=r"description\.srdf: needs a URDF, whose links and joints it names"):
        load_config(path, registry=registry)


def test_mounts_without_a_urdf_need_one_root(
    load: Callable[..., RobotConfig], tmp_path: Path, registry: Registry
) -> None:
    load()
    path = tmp_path / "robot.yaml"
    text = path.read_text().replace("  description: {urdf: robot.urdf}\n", "")
    for name, parent in (("top", "base"), ("wrist", "hand")):
        camera = f"name: {name}, kind: camera"
        text = text.replace(camera, f"{camera}, transform: {{parent: {parent}}}")
    path.write_text(text)
    with pytest.raises(ConfigError) as failure:
        load_config(path, registry=registry)
    assert str(failure.value).replace(f"{tmp_path}/", "") == (
        "robot.yaml:9: peripherals.wrist.transform.parent: frame 'wrist_frame' is not attached to the others: "
        "its root is 'hand', not 'base'"
    )
    path.write_text(text.replace("parent: hand", "parent: top_frame"))
    load_config(path, registry=registry)


def test_empty_srdf_is_named(faults: Faults) -> None:
    error = faults(top="transform: {parent: tool}", srdf="")
    assert "robot.srdf:1: not valid XML" in error


MJCF = """<mujoco>
  <compiler angle="radian"/>
  <worldbody><body><site name="nail"/>
    <joint name="shoulder_pan" range="-3.5 3.5"/>
  </body></worldbody>
</mujoco>
"""
PAN = "robot.yaml:4: robot.joints.shoulder_pan.lower"


def test_limits_beyond_the_models_need_a_word(load: Callable[..., RobotConfig], faults: Faults) -> None:
    wide = "-3.2 rad is beyond the model's limits, -3 to 3 rad (robot.urdf:5)"
    allow = "or set beyond_model: true where shoulder_pan can go there"
    assert faults(joint="lower: -3.2") == f"{PAN}: {wide}; narrow it, {allow}"
    assert faults(joint="lower: -171.9") == (
        f"{PAN}: -171.9 rad is beyond the model's limits, -3 to 3 rad (robot.urdf:5); were degrees meant? "
        "-171.9 degrees are -3.0002 rad"
    )
    assert load(joint="beyond_model: true, lower: -3.2").robot.joints[0].lower == -3.2
    assert load(joint="lower: -3.005").robot.joints[0].lower == -3.005


def test_of_two_models_the_wider_one_counts(load: Callable[..., RobotConfig], faults: Faults) -> None:
    assert load(joint="lower: -3.2", mjcf=MJCF).robot.joints[0].lower == -3.2
    assert "-3.5 to 3.5 rad (arm.xml:4)" in faults(joint="lower: -3.7", mjcf=MJCF)


def test_limits_are_checked_by_an_mjcf_alone(
    load: Callable[..., RobotConfig], tmp_path: Path, registry: Registry
) -> None:
    load(mjcf=MJCF)
    path = tmp_path / "robot.yaml"
    path.write_text(path.read_text().replace(", urdf: robot.urdf", "").replace("lower: -1,", "lower: -4,"))
    with pytest.raises(ConfigError, match=r"robot\.joints\.shoulder_pan\.lower: -4 rad is beyond the model's limits"):
        load_config(path, registry=registry)


def test_a_joint_that_the_mjcf_lacks_is_named(faults: Faults) -> None:
    assert faults(mjcf=MJCF.replace("shoulder_pan", "shoulder_pen")) == (
        "robot.yaml:6: robot.description.mjcf: the model has no joint 'shoulder_pan', did you mean 'shoulder_pen'?"
    )


def test_a_tip_that_no_model_has_is_refused(load: Callable[..., RobotConfig], faults: Faults) -> None:
    at = "robot.yaml:6: robot.description.tip"
    assert faults(tip="tol") == f"{at}: unknown link 'tol', did you mean 'tool'?"
    assert faults(tip="nial", mjcf=MJCF) == f"{at}: unknown site or link 'nial', did you mean 'nail'?"
    assert load(tip="nail", mjcf=MJCF).robot.description.tip == "nail"


def test_faults_of_both_models_and_of_limits_are_reported_together(faults: Faults) -> None:
    error = faults(mjcf="<mujoco>", joint="lower: -3.2")
    assert "robot.description.mjcf: arm.xml:1: not valid XML: no element found" in error
    assert f"{PAN}: -3.2 rad is beyond the model's limits" in error


def test_without_this_package_a_config_says_what_is_not_compared(
    load: Callable[..., RobotConfig], tmp_path: Path, registry: Registry
) -> None:
    load()
    entries = {key: each for key, each in registry.entries.items() if key != ("section", "description")}
    config = load_config(tmp_path / "robot.yaml", registry=attrs.evolve(registry, entries=entries))
    assert [(model, error.package) for model, error in config.absent_models.items()] == [("urdf", "ibrobot-kinematics")]
