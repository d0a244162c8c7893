"""Teleop `twist` as a program finds it: twists in, joint positions, status and counts out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, override

import attrs
import numpy as np
import pytest
from ibrobot_kinematics import KinematicModel, PathConstraints, ServoStatus, ToolConstraints, robot_model
from ibrobot_kinematics.clearance import CLEARANCE, Configuration
from ibrobot_kinematics.options import ToolPoseOptions, TwistOptions
from ibrobot_kinematics.twist import TwistTeleop
from ibrobot_testing import TeleopSuite, host_context, make_robot
from ibrobot_testing.contexts import START_NS, SetClock

from ibrobot_core.api import (
    Bool,
    Context,
    Description,
    DiagnosticArray,
    Header,
    Int8,
    Joint,
    JointReading,
    Message,
    Robot,
    Teleop,
    TeleopError,
    TransportError,
    Twist,
    TwistStamped,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import RequestError

AXES = {
    "shoulder_pan": "0 0 1",
    "shoulder_lift": "0 1 0",
    "elbow_flex": "0 1 0",
    "wrist_flex": "0 1 0",
    "wrist_roll": "1 0 0",
    "gripper": "0 0 1",
}
PLACES = ("0 0 0.05", "0 0 0.05", "0.15 0 0", "0.15 0 0", "0.05 0 0", "0.03 0.01 0")
BENT = np.array([0.3, -0.6, 1.1, 0.2, 0.2, 0.4])
TOPIC = TwistOptions().topic
DT = 0.01


@pytest.fixture(scope="session")
def model(tmp_path_factory) -> Path:
    """An arm with the joints of `make_robot`; its tool points along the arm."""
    path: Path = tmp_path_factory.mktemp("arm") / "arm.xml"
    bodies = ""
    for (name, axis), place in zip(AXES.items(), PLACES, strict=True):
        bodies += f'<body pos="{place}"><joint name="{name}" axis="{axis}"/><geom size="0.01"/>'
        if name == "wrist_roll":
            bodies += '<site name="tool" pos="0.08 0 0" xyaxes="0 0 -1 0 1 0"/>'
    path.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * len(AXES)}</worldbody></mujoco>")
    return path


def robot_of(model: Path) -> Robot:
    joints = tuple(Joint(name, -1.6, 1.6, max_velocity=3.0, max_acceleration=20.0) for name in AXES)
    groups = {"gripper": ("gripper",)}
    return attrs.evolve(make_robot(), joints=joints, groups=groups, description=Description(mjcf=model, tip="tool"))


def twist(
    linear: tuple[float, ...] = (0.0, 0.0, 0.1), angular: tuple[float, ...] = (0.0, 0.0, 0.0), frame: str = ""
) -> TwistStamped:
    return TwistStamped(Header(0, frame), Twist(Vector3(*linear), Vector3(*angular)))


class TestTwist(TeleopSuite):
    tolerance_rad = 2e-3  # the zero twist before is the first
    step_rad = 0.1  # motion goes on from the last setpoint

    path: ClassVar[Path]

    @pytest.fixture(autouse=True)
    def arm(self, model: Path) -> None:
        type(self).path = model

    @override
    def context(self) -> Context:
        self.ctx = host_context(robot=robot_of(self.path))
        return self.ctx

    @override
    def make(self, ctx: Context) -> Teleop:
        return TwistTeleop(TwistOptions(), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        assert self.ctx.bus is not None
        self.ctx.bus.publish(TOPIC, twist())

    @override
    def operate(self, teleop: Teleop) -> None:
        self.engage(teleop)

    @override
    def release(self, teleop: Teleop) -> None:
        assert self.ctx.bus is not None
        self.ctx.bus.publish(TOPIC, twist((0.0, 0.0, 0.0)))


class Rig:
    """A program that sends twists, and a robot that reaches every setpoint at once."""

    def __init__(self, path: Path, options: TwistOptions = TwistOptions()) -> None:  # noqa: B008 - it is frozen
        self.robot = robot_of(path)
        self.clock = SetClock(START_NS)
        self.ctx = host_context("twist", robot=self.robot, clock=self.clock)
        assert self.ctx.bus is not None
        self.bus = self.ctx.bus
        self.kinematics: KinematicModel = robot_model(self.robot)
        self.status = self.bus.subscribe(options.status_topic, 1000)
        self.diagnostics = self.bus.subscribe("/diagnostics", 1000)
        self.position = BENT.copy()
        self.positions: list[Vector] = []
        self.commanded = False
        self.follows = True
        self.teleop = TwistTeleop(options, self.ctx)
        self.teleop.connect()
        self.teleop.begin_operation(self.measured())
        for _ in range(30):  # no stream goes on
            self.tick()
        self.positions.clear()
        self.status.drain()

    def measured(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.position.copy(), np.zeros(6), np.zeros(6))

    def tick(self, *messages: Message, topic: str = TOPIC) -> Vector:
        self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(DT))
        for message in messages:
            self.bus.publish(topic, message)
        positions = self.teleop.operate(self.measured()).positions
        self.commanded = positions is not None
        for name, position in (positions or {}).items():
            if self.follows:
                self.position[self.robot.joint_names.index(name)] = position
        self.positions.append(self.position.copy())
        return self.position

    def follow(self, message: TwistStamped, seconds: float) -> Vector:
        begin = self.tool().copy()
        for _ in range(round(seconds / DT)):
            self.tick(message)
        return np.asarray(self.tool() - begin)

    def tool(self) -> Vector:
        return self.kinematics.forward(self.position).position

    def counts(self) -> dict[str, str]:
        published = self.diagnostics.drain()
        if not published:
            return {}
        message = published[-1].message
        assert isinstance(message, DiagnosticArray)
        return {each.key: each.value for each in message.status[0].values}


def test_the_tool_follows_the_base_frame_and_its_own(model):
    for frame in ("", "base_link"):
        np.testing.assert_allclose(Rig(model).follow(twist((0, 0, 0.1), frame=frame), 0.5), [0, 0, 0.05], atol=3e-3)
    rig = Rig(model)
    pointing = rig.kinematics.forward(BENT).rotation[:, 2]
    np.testing.assert_allclose(rig.follow(twist((0, 0, 0.05), frame="tool"), 0.4), 0.02 * pointing, atol=2e-3)


def test_only_joints_that_move_the_tool_are_commanded(model):
    rig = Rig(model)
    rig.bus.publish(TOPIC, twist())
    rig.ctx.clock.sleep_until(rig.ctx.clock.now_ns() + ns(DT))
    positions = rig.teleop.operate(rig.measured()).positions
    assert positions is not None
    assert "gripper" not in positions
    assert len(positions) == 5


def test_without_twists_the_arm_stops_within_its_accelerations_and_is_let_go(model):
    rig = Rig(model)
    rig.follow(twist((0, 0, 0.2)), 0.3)
    released = 0
    while rig.commanded:
        rig.tick()
        released += 1
    assert 10 <= released <= 25
    velocities = np.diff(rig.positions, axis=0) / DT
    assert np.abs(np.diff(velocities, axis=0, prepend=np.zeros((1, 6)))).max() <= 20.0 * DT + 1e-9
    assert not velocities[-1].any()


@pytest.mark.parametrize("off_s", [-3600.0, -0.6, 0.6, 3600.0])
def test_a_twist_whose_time_is_off_moves_nothing(model, off_s: float):
    rig = Rig(model)
    for _ in range(20):
        stamped = attrs.evolve(twist(), header=Header(rig.ctx.clock.now_ns() + ns(off_s), ""))
        np.testing.assert_array_equal(rig.tick(stamped), BENT)
    assert any("more than 0.5 s off" in reason for reason in rig.counts())
    assert rig.follow(attrs.evolve(twist(), header=Header(rig.ctx.clock.now_ns(), "")), 0.3).any()


@pytest.mark.parametrize("set_by_s", [3600.0, -3600.0])
def test_twists_of_now_move_the_tool_after_the_computers_clock_is_set(model, set_by_s: float):
    rig = Rig(model)
    rig.clock.set_by_ns = ns(set_by_s)
    for now_ns in (rig.clock.now_ns, rig.clock.wall_ns):  # a program of this run's, and one of another computer's
        old = attrs.evolve(twist(), header=Header(now_ns() - ns(3.0), ""))
        assert not rig.follow(old, 0.1).any()
        rig.tick(twist((0.0, 0.0, 0.0)))
        before = rig.position.copy()
        for _ in range(30):
            rig.tick(attrs.evolve(twist(), header=Header(now_ns(), "")))
        assert (rig.position != before).any()
        rig.follow(twist((0.0, 0.0, 0.0)), 0.5)


def test_a_stream_that_goes_on_over_a_reset_moves_nothing_before_a_zero_twist_or_a_pause(model):
    for release in ([twist((0.0, 0.0, 0.0))], [None] * 51):
        rig = Rig(model)
        assert rig.follow(twist(), 0.3).any()
        rig.teleop.begin_operation(rig.measured())
        assert not rig.follow(twist(), 2.0).any()
        assert any("the stream went on" in reason for reason in rig.counts())
        for message in release:
            rig.tick(*([] if message is None else [message]))
        assert rig.follow(twist(), 0.3).any()


def test_a_joint_that_does_not_follow_makes_the_tool_wait(model):
    rig = Rig(model)
    rig.follows = False
    most = 0.0
    for _ in range(300):
        rig.bus.publish(TOPIC, twist((0.1, 0, 0)))
        rig.ctx.clock.sleep_until(rig.ctx.clock.now_ns() + ns(DT))
        positions = rig.teleop.operate(rig.measured()).positions or {}
        lead = [
            abs(at - BENT[rig.robot.joint_names.index(name)]) / rig.robot.max_lead[0] for name, at in positions.items()
        ]
        most = max(most, *lead)
    assert 0.5 < most <= 1 + 1e-9


def test_an_arm_that_was_moved_by_hand_begins_where_it_is(model):
    rig = Rig(model)
    rig.follow(twist(), 0.2)
    while rig.commanded:
        rig.tick()
    rig.position[1] += 0.5
    before = rig.position.copy()
    np.testing.assert_allclose(rig.tick(twist()), before, atol=1e-9)


def test_the_status_is_published_when_it_changes_and_at_ten_hertz(model):
    rig = Rig(model)
    rig.follow(twist(), 1.0)
    assert 10 <= len(rig.status.drain()) <= 12
    rig.tick(twist((np.nan, 0, 0)))
    codes = [received.message for received in rig.status.drain()]
    assert codes[-1] == Int8(-1)
    rig.tick(twist())
    assert rig.status.drain()[-1].message == Int8(0)
    for _ in range(600):
        rig.tick(twist((0.2, 0, 0)))
    assert {received.message for received in rig.status.drain()} & {Int8(1), Int8(2), Int8(5)}


def test_service_of_the_topic_takes_twists_and_answers_with_the_status(model):
    rig = Rig(model)
    asked = {"header": {"frame_id": "base_link"}, "twist": {"linear": {"z": 0.1}}}
    begin = rig.tool().copy()
    for _ in range(50):
        assert rig.bus.call(TOPIC, asked) == ServoStatus.NO_WARNING
        rig.tick()
    np.testing.assert_allclose(rig.tool() - begin, [0, 0, 0.05], atol=3e-3)
    rig.bus.call(TOPIC, twist((np.nan, 0, 0)))
    rig.tick()
    assert rig.bus.call(TOPIC, asked) == ServoStatus.INVALID
    with pytest.raises(RequestError, match=r"twist\.linear\.w: unknown key"):
        rig.bus.call(TOPIC, {"twist": {"linear": {"w": 0.1}}})
    other = TwistTeleop(TwistOptions(), rig.ctx)
    other.connect()
    other.disconnect()
    assert rig.bus.serves(TOPIC)
    rig.teleop.disconnect()
    assert not rig.bus.serves(TOPIC)


REFUSED = {
    "nan": (twist((0, float("nan"), 0)), "not finite"),
    "infinite turn": (twist((0, 0, 0), (float("inf"), 0, 0)), "not finite"),
    "huge": (twist((0, 0, 1e300)), "faster than 1 m/s"),
    "too fast": (twist((0.8, 0.8, 0)), "faster than 1 m/s"),
    "spin": (twist((0, 0, 0), (0, 0, 100)), "turns faster than 6 rad/s"),
    "camera frame": (twist(frame="camera_link"), "its frame is neither base_link nor tool"),
    "tool misspelt": (twist(frame="Tool"), "its frame is neither base_link nor tool"),
}


@pytest.mark.parametrize(("message", "reason"), REFUSED.values(), ids=REFUSED.keys())
def test_a_refused_twist_is_counted_and_the_one_before_it_stays(model, message, reason, caplog):
    rig = Rig(model)
    rig.follow(twist(), 0.1)
    before = rig.tool()
    for _ in range(3):
        rig.tick(message)
    assert rig.tool()[2] > before[2] + 1e-3
    for _ in range(30):
        rig.tick(message)
    assert not rig.commanded
    assert rig.counts() == {reason: "33"}
    assert [record.getMessage() for record in caplog.records] == [f"twist: refused a twist: {reason}"]
    assert np.isfinite(rig.positions).all()


def test_a_message_of_another_type_is_refused(model):
    rig = Rig(model)
    with pytest.raises(TransportError, match=f"topic {TOPIC} carries geometry_msgs/msg/TwistStamped, not"):
        rig.tick(Bool(True))
    assert rig.follow(twist(), 0.1)[2] > 0, "the right ones are followed"


def test_twists_that_waited_longer_than_the_timeout_are_refused(model):
    rig = Rig(model)
    rig.tick()
    rig.bus.publish(TOPIC, twist())
    rig.ctx.clock.sleep_until(rig.ctx.clock.now_ns() + ns(0.5))
    rig.tick()
    assert not rig.commanded
    assert rig.counts() == {"read too late": "1"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topic": "twists"}, "'twists' is not a topic: a topic begins with /, e.g. /servo_node/delta_twist_cmds"),
        ({"topic": "/a b"}, "'/a b' is not a topic"),
        ({"status_topic": "/status/"}, "'/status/' is not a topic"),
        ({"path_constraints": PathConstraints(upright=0.1)}, "path_constraints: a device's upright needs upright_axis"),
        ({"timeout": 5.0}, "5.0 is too large, must be at most 1 s"),
        ({"hard_stop_singularity_threshold": 10.0}, "lower_singularity_threshold is 30, must be below hard_stop"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TwistOptions(**options)


def faults(robot: Robot, options: TwistOptions = TwistOptions()) -> list[str]:  # noqa: B008 - it is frozen
    return [fault.message for fault in options.check(robot, ())]


def test_options_are_checked_against_the_robot(model):
    assert faults(robot_of(model)) == []
    assert faults(make_robot()) == ["twists move a tool, which needs robot.description.mjcf: set it"]
    same = "'tool' is robot.description.tip; give the name of the base frame"
    assert faults(robot_of(model), TwistOptions(frame="tool")) == [same]
    (fault,) = ToolPoseOptions().check(make_robot(), ())
    assert fault.message == "the pose of the tool needs robot.description.mjcf: set it"


def test_a_device_that_cannot_work_says_why(model):
    with pytest.raises(TeleopError, match=r"twist: twists move a tool, which needs robot.description.mjcf: set it"):
        TwistTeleop(TwistOptions(), host_context("twist")).connect()
    ctx = attrs.evolve(host_context("twist", robot=robot_of(model)), bus=None)
    with pytest.raises(TeleopError, match="twist: twists come over the bus, which this process does not have"):
        TwistTeleop(TwistOptions(), ctx).connect()
    robot = robot_of(model)
    nose = attrs.evolve(robot, description=attrs.evolve(robot.description, tip="nose"))
    with pytest.raises(TeleopError, match="has no site 'nose'; it has: tool"):
        TwistTeleop(TwistOptions(), host_context("twist", robot=nose)).connect()


def test_help_names_topic_type_and_frames(model):
    help_text = TwistTeleop(TwistOptions(), host_context(robot=robot_of(model))).help()
    assert help_text == (
        "publish geometry_msgs/msg/TwistStamped on /servo_node/delta_twist_cmds, its frame_id base_link or tool"
    )


def test_tool_slows_down_and_stands_before_obstacles(model: Path):
    rig = Rig(model)
    ceiling = rig.tool()[2] + 0.04

    def distance(request: Configuration) -> float:
        return float(ceiling - rig.kinematics.forward(np.array([*request.positions.values(), 0.0])).position[2])

    rig.bus.serve(CLEARANCE, distance)
    up = rig.follow(twist((0.0, 0.0, 0.2)), seconds=2.0)
    assert 0.02 < up[2] <= 0.04 - TwistOptions().stop_distance + 1e-4
    assert rig.status.drain()[-1].message == Int8(ServoStatus.DECELERATE_FOR_COLLISION)
    assert rig.follow(twist((0.0, 0.0, -0.1)), seconds=0.3)[2] < -0.02, "it may leave"


LEVEL = np.array([0.3, -0.6, 1.1, -0.5, 0.0, 0.4])
UPRIGHT = PathConstraints(upright=0.1, upright_axis="-x")
WAYS: list[tuple[Sequence[float], Sequence[float]]] = [
    ((0.0, 0.0, -0.2), (0.0, 0.0, 0.0)),
    ((-0.15, 0.0, -0.15), (0.0, 0.0, 0.0)),
    ((0.0, 0.15, -0.15), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.2), (0.0, 0.5, 0.0)),
]


class Arm:
    """A robot of which some joints stand still, in a run whose guard may hold some back."""

    def __init__(self, model: Path, *, held_back: str = "", stuck: str = "") -> None:
        self.robot = robot_of(model)
        self.held_back, self.stuck = held_back, stuck
        self.command, self.measured = LEVEL.copy(), LEVEL.copy()
        state = SimpleNamespace(command=self.command)
        session: Any = SimpleNamespace(state=state, config=SimpleNamespace(robot=self.robot))
        self.ctx = attrs.evolve(host_context("twist", robot=self.robot, clock=SetClock(START_NS)), session=session)
        self.teleop = TwistTeleop(TwistOptions(path_constraints=UPRIGHT), self.ctx)
        self.teleop.connect()
        self.teleop.begin_operation(self.reading())
        kinematics = robot_model(self.robot)
        self.constraints = ToolConstraints(UPRIGHT, kinematics, LEVEL)
        self.excess = [-0.1]
        """Of each command [rad]."""
        for _ in range(60):
            self.tick()

    def reading(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.measured.copy(), np.zeros(6), np.zeros(6))

    def tick(self, *messages: Message) -> None:
        self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(DT))
        assert self.ctx.bus is not None
        for message in messages:
            self.ctx.bus.publish(TOPIC, message)
        for name, position in (self.teleop.operate(self.reading()).positions or {}).items():
            index = self.robot.joint_names.index(name)
            if name != self.held_back:
                self.command[index] = position
            if name != self.stuck:
                self.measured[index] = self.command[index]
        self.excess.append(float(self.constraints.excess(self.command)[0]))


@pytest.mark.parametrize(("linear", "angular"), WAYS)
@pytest.mark.parametrize("joint", ["shoulder_lift", "elbow_flex", "wrist_flex"])
def test_constraint_holds_while_a_guard_holds_a_joint_back(model: Path, joint: str, linear, angular):
    arm = Arm(model, held_back=joint)
    for _ in range(300):
        arm.tick(twist(linear, angular))
    assert max(arm.excess) <= 0.0


@pytest.mark.parametrize(("linear", "angular"), WAYS)
@pytest.mark.parametrize("joint", ["shoulder_lift", "elbow_flex", "wrist_flex"])
def test_constraint_holds_for_the_commands_while_a_joint_is_stuck(model: Path, joint: str, linear, angular):
    arm = Arm(model, stuck=joint)
    for _ in range(300):
        arm.tick(twist(linear, angular))
    assert max(arm.excess) <= 0.0
    assert np.abs(arm.command - arm.measured).max() <= arm.robot.max_lead[0] + 1e-9
