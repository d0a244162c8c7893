"""The tool's pose in a run."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, override

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics.hooks import ibrobot_sections
from ibrobot_kinematics.options import ToolPoseOptions
from ibrobot_testing import SectionSuite, make_robot, make_session

from ibrobot_core.api import Description, Header, JointState, PoseStamped, ns
from ibrobot_core.app import Component, Session

MJCF = """<mujoco><worldbody>
<body pos="0 0 0.1"><joint name="shoulder_pan" axis="0 0 1"/><geom size="0.01"/>
<body pos="0.1 0 0"><joint name="elbow_flex" axis="0 1 0"/><geom size="0.01"/>
<site name="tool" pos="0.2 0 0" euler="90 20 0"/></body></body>
<body pos="1 0 0"><joint name="shoulder_lift"/><geom size="0.01"/></body>
<body pos="1 0 0"><joint name="wrist_flex"/><geom size="0.01"/></body>
<body pos="1 0 0"><joint name="wrist_roll"/><geom size="0.01"/></body>
<body pos="1 0 0"><joint name="gripper"/><geom size="0.01"/></body>
</worldbody></mujoco>"""
SECTION, _ = ibrobot_sections()


@pytest.fixture(scope="session")
def model(tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(MJCF)
    return path


def session_of(path: Path, tip: str = "tool") -> Session:
    return make_session(robot=attrs.evolve(make_robot(), description=Description(mjcf=path, tip=tip)))


class TestToolPose(SectionSuite):
    path: ClassVar[Path]

    @pytest.fixture(autouse=True)
    def arm(self, model: Path) -> None:
        type(self).path = model

    @override
    def session(self) -> Session:
        return session_of(self.path)

    @override
    def component(self, session: Session) -> Component:
        return SECTION.make(None, session)


def states(session: Session, component: Component, stamps: list[float], position: np.ndarray) -> list[PoseStamped]:
    """What is published for joint states at these times [s]."""
    poses = session.bus.subscribe("/robot_status/ee_pose", 1000)
    for stamp in stamps:
        session.bus.publish("/joint_states", JointState(Header(ns(stamp)), session.config.robot.joint_names, position))
        component.step(ns(stamp))
    found = [received.message for received in poses.drain()]
    poses.close()
    return [message for message in found if isinstance(message, PoseStamped)]


def test_the_pose_is_mujocos(model):
    session = session_of(model)
    component = SECTION.make(None, session)
    component.start()
    physics = mujoco.MjModel.from_xml_path(str(model))
    data = mujoco.MjData(physics)
    rng = np.random.default_rng(0)
    for stamp in range(10):
        position = rng.uniform(-3, 3, 6)
        for name, at in zip(session.config.robot.joint_names, position, strict=True):
            data.joint(name).qpos[0] = at
        mujoco.mj_kinematics(physics, data)
        (message,) = states(session, component, [float(stamp)], position)
        assert message.header == Header(ns(stamp), "base_link")
        where, turn = message.pose.position, message.pose.orientation
        np.testing.assert_allclose([where.x, where.y, where.z], data.site("tool").xpos, atol=1e-12)
        theirs = np.zeros(4)
        mujoco.mju_mat2Quat(theirs, data.site("tool").xmat)
        assert abs(np.dot([turn.w, turn.x, turn.y, turn.z], theirs)) == pytest.approx(1.0, abs=1e-12)
    component.stop()


def test_it_comes_at_its_rate(model):
    stamps = np.arange(0, 2, 0.01).tolist()
    for rate, count in ((20.0, 40), (10.0, 20), (30.0, 60), (1000.0, 200)):
        session = session_of(model)
        component = SECTION.make(ToolPoseOptions(rate_hz=rate), session)
        component.start()
        assert abs(len(states(session, component, stamps, np.zeros(6))) - count) <= 1
        component.stop()


def test_a_clock_that_is_set_back_does_not_silence_it(model):
    session = session_of(model)
    component = SECTION.make(None, session)
    component.start()
    assert len(states(session, component, [100.0, 5.0, 5.05, 500.0], np.zeros(6))) == 4
    component.stop()


def test_every_robot_with_a_model_has_it(model):
    assert SECTION.without_section(session_of(model).config)
    assert not SECTION.without_section(make_session().config)


def test_a_model_without_the_tip_is_reported(model, caplog):
    session = session_of(model, tip="nose")
    component = SECTION.make(None, session)
    component.start()
    assert states(session, component, [0.0], np.zeros(6)) == []
    component.stop()
    (record,) = caplog.records
    assert "/robot_status/ee_pose is not published: " in record.getMessage()
    assert "has no site 'nose'; it has: tool" in record.getMessage()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topic": "ee_pose"}, "'ee_pose' is not a topic: a topic begins with /, e.g. /robot_status/ee_pose"),
        ({"rate_hz": 0.0}, "0.0 is too small, must be above 0 Hz"),
        ({"rate_hz": float("nan")}, "nan is too small, must be above 0 Hz"),
    ],
)
def test_keys_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ToolPoseOptions(**options)
