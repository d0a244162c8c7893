"""Ages of the world: clouds, depth images, frames and poses that are old, blind, early or hostile."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import world_clearance
from ibrobot_planning import ibrobot_sections
from ibrobot_planning.planner import JointGoal, PlanRequest
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.world.clouds import CLEAR
from ibrobot_planning.world.objects import SNAPSHOT
from ibrobot_planning.world.options import WorldOptions
from ibrobot_planning.world.voxels import cloud_points
from ibrobot_testing import make_session

from ibrobot_core.api import (
    CameraInfo,
    Context,
    DiagnosticArray,
    DiagnosticStatus,
    Float64MultiArray,
    Header,
    Message,
    PlanCode,
    PlanningError,
    PointCloud2,
    PointField,
    Quaternion,
    SteppedClock,
    TFMessage,
    TransformStamped,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import ConfigError, Session, single_options

from .table_arm import ARM, make_robot
from .test_clouds import CLOUD, FIELDS, INFO, MOUNTS, cloud, depth_image

AHEAD = np.array([0.0, 0.8, 0.8, 0.5, 0.0])
"""A configuration in the wall."""
WALL_POINTS = np.array(
    [(x, y, z) for x in np.arange(0.1, 0.36, 0.01) for y in (-0.01, 0.01) for z in np.arange(0.01, 0.3, 0.01)]
)
FAR_POINTS = np.array([(2.5, y, 0.3) for y in np.linspace(-0.5, 0.5, 500)])
"""Within the lidar's range, and beyond the reach of the cells."""
IN_LIDAR = np.array([0.0, 0.0, 0.5])
HOUR = 3600.0
YEAR = 365 * 24 * HOUR
START_NS = ns(1.0e9)


class SetClock(SteppedClock):
    """A clock of a run whose computer's clock is set meanwhile."""

    set_s = 0.0

    def wall_ns(self) -> int:
        return self.now_ns() + ns(self.set_s)


@attrs.define
class Scene:
    """A world with sensors, and a planner that uses it."""

    session: Session
    world: Any
    planner: RrtConnectPlanner

    @property
    def clock(self) -> SetClock:
        assert isinstance(self.session.clock, SetClock)
        return self.session.clock

    def wait(self, seconds: float) -> None:
        self.clock.advance(ns(seconds))
        self.world.step(0)

    def publish(self, message: Message, topic: str = "/points") -> None:
        self.session.bus.publish(topic, message)
        self.world.step(0)

    def stamp(self, age_s: float) -> int:
        return self.clock.now_ns() - ns(age_s)

    def see(self, points: Any, age_s: float = 0.0, frame: str = "lidar") -> None:
        self.publish(
            stamped(cloud(np.asarray(points, dtype=float).reshape(-1, 3) - IN_LIDAR, frame), self.stamp(age_s))
        )

    def see_wall(self) -> None:
        self.see(np.concatenate([WALL_POINTS, FAR_POINTS]))

    def plan(self) -> tuple[PlanCode, str]:
        """The verdict on a motion into the wall."""
        try:
            self.planner.plan(PlanRequest(ARM, np.zeros(5), JointGoal(ARM, AHEAD)))
        except PlanningError as error:
            return error.code, str(error)
        return PlanCode.SUCCESS, ""


def stamped(message: Any, stamp_ns: int) -> Any:
    return attrs.evolve(message, header=attrs.evolve(message.header, stamp_ns=stamp_ns))


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Scene]]:
    made: list[Any] = []
    section = next(each for each in ibrobot_sections() if each.type == "world")

    def started(text: str = CLOUD, mounts: TFMessage | None = MOUNTS, *, plans: bool = True) -> Scene:
        session = make_session(robot=make_robot(tmp_path))
        session.clock = session.bus.clock = SetClock(START_NS)
        monkeypatch.setattr(session, "measured", lambda: SimpleNamespace(position=np.zeros(6)))
        if mounts is not None:
            session.bus.publish("/tf_static", mounts, latched=True)
        world = section.make(single_options(WorldOptions, (), "world", text=text), session)
        made.append(world)
        world.start()
        context = Context("planner", session.clock, logging.getLogger("test"), session.config.robot, bus=session.bus)
        planner = RrtConnectPlanner(RrtConnectOptions(planning_time=300.0), context)
        if plans:
            planner.load()
        return Scene(session, world, planner)

    yield started
    for each in made:
        each.stop()


def with_keys(keys: str, text: str = CLOUD) -> str:
    return text.replace("cell:", f"{keys}, cell:")


NAN, ZERO = np.full((500, 3), np.nan), np.tile(IN_LIDAR, (500, 1))
HOSTILE: dict[str, tuple[Callable[[Scene], None], str]] = {
    "an hour old": (lambda it: it.see(FAR_POINTS, HOUR), "it is 3600.0 s old by its stamp"),
    "just too old": (lambda it: it.see(FAR_POINTS, 1.6), "it is 1.6 s old by its stamp"),
    "an hour early": (lambda it: it.see(FAR_POINTS, -HOUR), "its stamp is 3600.0 s in the future"),
    "a year early": (lambda it: it.see(FAR_POINTS, -YEAR), "in the future"),
    "all NaN": (lambda it: it.see(NAN), "covered or blind: of its 500 points or pixels 0 measure"),
    "all inf": (lambda it: it.see(NAN + np.inf), "covered or blind"),
    "all zero": (lambda it: it.see(ZERO), "covered or blind"),
    "no point": (lambda it: it.see(np.zeros((0, 3))), "of its 0 points or pixels 0 measure"),
    "huge": (lambda it: it.see(np.full((500, 3), 1e30)), "covered or blind"),
    "hardly any of its points": (lambda it: it.see([*NAN, *FAR_POINTS[:20]]), "of its 520 points or pixels 20"),
    "hardly any where there were many": (lambda it: it.see(FAR_POINTS[:20]), "it measures 20 points, and measured"),
    "another frame": (lambda it: it.see(FAR_POINTS, frame="map"), "no transform of frame 'map' to the base"),
    "without a field": (
        lambda it: it.publish(attrs.evolve(cloud(FAR_POINTS), fields=FIELDS[:2])),
        "the cloud has no field z",
    ),
    "a billion points": (
        lambda it: it.publish(attrs.evolve(cloud(FAR_POINTS), height=10**9, width=1)),
        "the cloud has 1000000000x1 points",
    ),
}  # fmt: skip
"""Messages that must not erase the wall, with the reason that a refused plan names."""


@pytest.mark.parametrize(("see", "told"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_message_erases_nothing_and_then_refuses_plans(scene, see, told: str, caplog):
    at = scene()
    at.see_wall()
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
    at.wait(0.6)
    see(at)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION, "the wall is still there, and seen not long ago"
    for _ in range(3):
        at.wait(0.6)
        see(at)
    code, message = at.plan()
    assert code.name == "SENSOR_INFO_STALE"
    assert told in message
    assert "cloud 'lidar' (/points) is 2.4 s old, at most 1.5 s is allowed (world.clouds.lidar.max_age)" in message
    assert "set world.clouds.lidar.when_stale, which is refuse" in message
    logged = [record.getMessage() for record in caplog.records if "refused a message" in record.getMessage()]
    assert len(logged) == 1, "of four such messages, the first is logged"
    assert told in logged[0]
    at.see(FAR_POINTS if "hardly" not in told else [*WALL_POINTS, *FAR_POINTS])
    at.wait(0.6)
    at.see(np.concatenate([FAR_POINTS, FAR_POINTS]))
    assert at.plan()[0] is PlanCode.SUCCESS, "a sensor that sees again is believed"


def test_older_of_two_clouds_does_not_replace_the_newer(scene):
    at = scene()
    at.wait(2.0)
    at.see_wall()
    at.wait(0.6)
    at.see(FAR_POINTS, age_s=0.8)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
    at.wait(0.6)
    at.see(FAR_POINTS, age_s=0.5)
    assert at.plan()[0] is PlanCode.SUCCESS, "newer than the one with the wall, though it was on its way for 0.5 s"


@pytest.mark.parametrize(
    ("rule", "code", "then"),
    [
        ("refuse", "SENSOR_INFO_STALE", "nothing newer has come; plans are refused"),
        ("keep", "GOAL_IN_COLLISION", "planners keep what was seen last"),
        ("forget", "SUCCESS", "planners do without it"),
    ],
)
def test_silent_sensor_is_reported_and_its_rule_applies(scene, rule: str, code: str, then: str, caplog):
    at = scene(with_keys(f"when_stale: {rule}"))
    told = at.session.bus.subscribe("/diagnostics", 100)
    at.see_wall()
    for _ in range(26):
        at.wait(0.5)
    assert at.plan()[0].name == code
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("cloud 'lidar' (/points) is 2.0 s old, at most 1.5 s is allowed")
    assert then in line
    (status,) = told.drain()[-1].message.status
    assert (status.name, status.level) == (
        "world lidar",
        DiagnosticStatus.ERROR if rule == "refuse" else DiagnosticStatus.WARN,
    )
    assert "cloud 'lidar' (/points) is 1" in status.message
    at.see_wall()
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
    caplog.set_level(logging.INFO)


@pytest.mark.parametrize(
    ("rule", "code"), [("refuse", "SENSOR_INFO_STALE"), ("keep", "SENSOR_INFO_STALE"), ("forget", "SUCCESS")]
)
def test_cloud_that_never_came_is_no_empty_world(scene, rule: str, code: str):
    at = scene(with_keys(f"when_stale: {rule}"))
    at.wait(13.0)
    found, message = at.plan()
    assert found.name == code
    assert not message or "cloud 'lidar' (/points): nothing usable has come for 13.0 s" in message


def test_clouds_are_believed_after_the_computers_clock_was_set(scene):
    at = scene()
    for set_s in (HOUR, -HOUR, 0.0):
        at.clock.set_s = set_s
        for _ in range(4):
            at.wait(0.6)
            at.see([*WALL_POINTS, *FAR_POINTS], age_s=-set_s)
            assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
    at.clock.set_s = HOUR
    at.wait(0.6)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION, "setting the clock makes nothing older"


def test_stamp_of_zero_is_the_time_of_receipt(scene):
    at = scene()
    at.publish(stamped(cloud(WALL_POINTS - IN_LIDAR), 0))
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


def test_cleared_cells_are_gone_but_no_younger(scene):
    at = scene()
    at.see_wall()
    at.session.bus.call(CLEAR, None)
    assert at.plan()[0] is PlanCode.SUCCESS
    at.wait(2.0)
    assert at.plan()[0].name == "SENSOR_INFO_STALE"


def test_empty_clouds_may_be_allowed(scene):
    at = scene(with_keys("least_valid: 0"))
    at.see_wall()
    at.wait(0.6)
    at.see(np.zeros((0, 3)))
    assert at.plan()[0] is PlanCode.SUCCESS


# Depth images.

DEPTH = "clouds: {top: {topic: /camera/top/image_raw, cell: 0.02, least_points: 1}}"
SEEN = np.full((30, 40), 0.5)
"""Everything is 0.3 m above the base."""


def info(**changes: Any) -> CameraInfo:
    return attrs.evolve(INFO, **changes)


def k_of(fx: float, cx: float = 20.0) -> Vector:
    return np.array([fx, 0, cx, 0, 100.0, 15, 0, 0, 1])


IMAGES: dict[str, tuple[Message | None, Message | None, str]] = {
    "all zero": (depth_image(np.zeros((30, 40))), None, "of its 1200 points or pixels 0 measure"),
    "saturated": (attrs.evolve(depth_image(np.zeros((30, 40))), data=np.full(2400, 255, np.uint8)), None, "covered"),
    "NaN": (depth_image(np.full((30, 40), np.nan), "32FC1"), None, "covered"),
    "inf": (depth_image(np.full((30, 40), np.inf), "32FC1"), None, "covered"),
    "negative": (depth_image(np.full((30, 40), -1.0), "32FC1"), None, "covered"),
    "hardly any pixel": (depth_image(np.where(np.arange(1200).reshape(30, 40) < 40, 2.0, 0.0)), None, "40 measure"),
    "another size": (depth_image(np.full((20, 40), 2.0)), None, "20x40 pixels, but CameraInfo says 30x40"),
    "too few bytes": (attrs.evolve(depth_image(SEEN), data=np.zeros(3, np.uint8)), None, "has a step of 80 and 3"),
    "huge size": (attrs.evolve(depth_image(SEEN), height=10**9), None, "1000000000x40 pixels, at most"),
    "K of NaN": (None, info(k=k_of(np.nan)), "the focal lengths of its CameraInfo are nan"),
    "huge K": (None, info(k=k_of(1e300)), "the focal lengths of its CameraInfo are 1e+300"),
    "axis at NaN": (None, info(k=k_of(100.0, np.nan)), "the optical axis of its CameraInfo is at nan"),
    "axis far away": (None, info(k=k_of(100.0, 1e9)), "the optical axis of its CameraInfo is at 1e+09"),
    "no K": (None, info(k=np.zeros(0)), "the matrix k of its CameraInfo has 0 numbers"),
    "info an hour early": (None, info(header=Header(START_NS + ns(HOUR))), "its CameraInfo is 359"),
}  # fmt: skip


@pytest.mark.parametrize(("image", "changed", "told"), IMAGES.values(), ids=IMAGES)
def test_hostile_image_erases_nothing(scene, image: Message | None, changed: Message | None, told: str):
    at = scene(DEPTH)
    at.session.bus.publish("/camera/top/camera_info", stamped(INFO, START_NS), latched=True)
    at.publish(stamped(depth_image(SEEN), at.stamp(0)), "/camera/top/image_raw")
    before = at.session.bus.call(SNAPSHOT).objects["top"].shape
    for _ in range(3):
        at.wait(0.6)
        if changed is not None:
            at.session.bus.publish("/camera/top/camera_info", changed)
        at.publish(stamped(image or depth_image(np.full((30, 40), 2.0)), at.stamp(0)), "/camera/top/image_raw")
        if at.clock.now_ns() < START_NS + ns(1.0):
            assert at.session.bus.call(SNAPSHOT).objects["top"].shape is before
    code, message = at.plan()
    assert code.name == "SENSOR_INFO_STALE"
    assert told in message


def test_image_with_an_old_stamp_is_refused(scene):
    at = scene(DEPTH)
    at.session.bus.publish("/camera/top/camera_info", stamped(INFO, START_NS), latched=True)
    at.publish(stamped(depth_image(SEEN), at.stamp(0)), "/camera/top/image_raw")
    at.wait(0.6)
    at.publish(stamped(depth_image(np.full((30, 40), 2.0)), at.stamp(HOUR)), "/camera/top/image_raw")
    assert "top" in at.session.bus.call(SNAPSHOT).objects


# Frames.

STRAIGHT = Quaternion()


def transform(
    parent: str, child: str, x: float = 0.0, rotation: Quaternion = STRAIGHT, stamp_ns: int = 0
) -> TransformStamped:
    return TransformStamped(Header(stamp_ns, parent), child, Vector3(x, 0.0, 0.5), rotation)


FRAMES: dict[str, tuple[str, TFMessage, str]] = {
    "none": ("/tf_static", TFMessage(()), "no transform of frame 'lidar' to the base"),
    "NaN": ("/tf_static", TFMessage((transform("base", "lidar", np.nan),)), "its translation is (nan, 0, 0.5) m"),
    "far": ("/tf_static", TFMessage((transform("base", "lidar", 1e9),)), "its translation is (1e+09, 0, 0.5) m"),
    "no rotation": (
        "/tf_static",
        TFMessage((transform("base", "lidar", rotation=Quaternion(0.0, 0.0, 0.0, 0.0)),)),
        "its quaternion has length 0, must have 1",
    ),
    "NaN rotation": (
        "/tf_static",
        TFMessage((transform("base", "lidar", rotation=Quaternion(0.0, 0.0, 0.0, math.nan)),)),
        "its quaternion has length nan",
    ),
    "circle": ("/tf_static", TFMessage((transform("a", "lidar"), transform("lidar", "a"))), "run in a circle"),
    "another tree": ("/tf_static", TFMessage((transform("map", "lidar"),)), "its tree ends at 'map', which is not"),
    "an hour old": (
        "/tf",
        TFMessage((transform("base", "lidar", stamp_ns=START_NS - ns(HOUR)),)),
        "the nearest transform of frame 'lidar' on /tf is 360",
    ),
}


@pytest.mark.parametrize(("topic", "tf", "told"), FRAMES.values(), ids=FRAMES)
def test_cloud_whose_frame_is_unknown_refuses_plans(scene, topic: str, tf: TFMessage, told: str):
    at = scene(mounts=None)
    at.session.bus.publish(topic, tf)
    at.see_wall()
    code, message = at.plan()
    assert code.name == "SENSOR_INFO_STALE"
    assert told in message


@pytest.mark.parametrize("frame", ["base", "base_link"])
def test_cloud_in_the_base_frame_needs_no_transform(scene, frame: str):
    at = scene(mounts=None)
    at.see(WALL_POINTS + IN_LIDAR, frame=frame)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


def test_frames_may_meet_above_the_base(scene):
    at = scene(mounts=TFMessage((transform("map", "base_link", 5.0), transform("map", "lidar", 5.0))))
    at.see(WALL_POINTS + IN_LIDAR)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


def test_frame_that_moves_is_where_it_was_when_the_cloud_was_measured(scene):
    at = scene(mounts=None)
    for number in range(20):
        moved = transform("base", "lidar", 0.1 * number, stamp_ns=at.stamp(0))
        at.session.bus.publish("/tf", TFMessage((moved,)))
        at.wait(0.05)
    # Half a second ago, the sensor was at 1 m.
    at.see(WALL_POINTS - [1.0, 0.0, 0.0], age_s=0.5)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
    at.wait(1.2)
    at.see(FAR_POINTS)
    assert at.plan()[0].name == "SENSOR_INFO_STALE" or "wall" in at.plan()[1]


# Poses of objects.

CAN = "objects: {can: {shape: box, size: [0.3, 0.02, 0.3], position: [0.2, 0, 0.15], max_age: 5.0, when_stale: RULE}}"


@pytest.mark.parametrize(
    ("rule", "code"), [("refuse", "SENSOR_INFO_STALE"), ("keep", "GOAL_IN_COLLISION"), ("forget", "SUCCESS")]
)
def test_tracked_object_that_is_no_longer_seen(scene, rule: str, code: str):
    at = scene(CAN.replace("RULE", rule))
    move = {"name": "can", "position": [0.2, 0.0, 0.15]}
    for _ in range(3):
        at.wait(3.0)
        assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION
        at.session.bus.call("/world/move", move)
    at.wait(5.1)
    found, message = at.plan()
    assert found.name == code
    assert (
        not message
        or rule == "keep"
        or ("the pose of object 'can' is 5.1 s old, at most 5 s is allowed (world.objects.can.max_age)" in message)
    )
    at.session.bus.call("/world/move", move | {"stamp_ns": at.stamp(1.0)})
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


@pytest.mark.parametrize(
    ("age_s", "told"),
    [(HOUR, "is 3600.0 s old by its stamp"), (-HOUR, "is 3600.0 s in the future"), (4.0, "older than the one before")],
)
def test_pose_of_another_time_moves_no_object(scene, age_s: float, told: str):
    at = scene(CAN.replace("RULE", "refuse"))
    at.wait(2.0)
    for service, more in (("/world/move", {}), ("/world/add", {"replace": True})):
        request = {"name": "can", "stamp_ns": at.stamp(age_s), **more}
        if service == "/world/move":
            request["position"] = [0.2, 2.0, 0.15]
        else:
            request["object"] = {"shape": "sphere", "radius": 0.01, "position": [0, 2, 0], "max_age": 5.0}
        with pytest.raises(PlanningError, match=told):
            at.session.bus.call(service, request)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


def test_carried_object_does_not_age(scene):
    at = scene("objects: {cup: {shape: sphere, radius: 0.01, position: [0, 0, 0.45], max_age: 1.0}}")
    at.session.bus.call("/world/attach", {"name": "cup"})
    at.wait(10.0)
    assert at.session.bus.call(SNAPSHOT).objects["cup"].link == "hand"
    at.session.bus.call("/world/detach", {"name": "cup"})
    at.wait(0.5)
    at.session.bus.call(SNAPSHOT)
    at.wait(1.0)
    with pytest.raises(PlanningError, match=r"the pose of object 'cup' is 1\.5 s old"):
        at.session.bus.call(SNAPSHOT)
    at.session.bus.call("/world/remove", "cup")
    assert at.session.bus.call(SNAPSHOT).objects == {}


@pytest.mark.parametrize("service", ["/world/move", "/world/add", "/world/attach"])
def test_cells_of_a_cloud_cannot_be_moved_away(scene, service: str):
    at = scene()
    at.see_wall()
    request: dict[str, Any] = {"name": "lidar"}
    if service == "/world/move":
        request["position"] = [0.0, 5.0, 0.0]
    elif service == "/world/add":
        request |= {"replace": True, "object": {"shape": "sphere", "radius": 0.001, "position": [0, 5, 0]}}
    with pytest.raises(PlanningError, match="'lidar' is a cloud, whose cells come from /points"):
        at.session.bus.call(service, request)
    assert at.plan()[0] is PlanCode.GOAL_IN_COLLISION


# Who uses the world.


def test_jogs_stop_while_the_world_is_too_old(scene):
    at = scene()
    at.see_wall()
    clearance = world_clearance(at.session.bus, ARM)
    assert clearance is not None
    assert 0 < clearance(np.zeros(5)) < 1
    at.wait(2.0)
    assert clearance(np.zeros(5)) == -math.inf, "so a servo stops the tool"
    with pytest.raises(PlanningError, match="cloud 'lidar'"):
        at.session.bus.call("/world/clearance", {})
    assert list(at.session.bus.call("/world/shapes")) == [], "pages still draw it"


YAML_FAULTS = {
    "{topic: /p, max_age: 0}": "0.0 is too small, must be above 0 s",
    "{topic: /p, max_age: .nan}": "nan is too small",
    "{topic: /p, max_age: .inf}": "inf is not a finite number",
    "{topic: /p, when_stale: ignore}": "'ignore' is not one of: refuse, keep, forget",
    "{topic: /p, least_valid: 2}": "2.0 is too large",
    "{topic: /p, transform_tolerance: 0}": "0.0 is too small",
}


@pytest.mark.parametrize(("text", "told"), YAML_FAULTS.items())
def test_mistakes_in_the_rules(text: str, told: str):
    with pytest.raises(ConfigError) as failure:
        single_options(WorldOptions, (), "world", text=f"clouds: {{a: {text}}}")
    assert told in str(failure.value)


def test_limit_below_the_interval_of_updates_is_refused(tmp_path: Path):
    options = single_options(WorldOptions, (), "world", text="clouds: {a: {topic: /p, rate: 0.5}}")
    (fault,) = options.check(make_robot(tmp_path), ())
    assert fault.option == ("clouds", "a", "max_age")
    assert "1.5 s is too small for rate 0.5 Hz" in fault.message
    assert "set it above 2 s" in fault.message


# Generated clouds.

KINDS: dict[str, Callable[[Vector], Vector]] = {
    "good": lambda points: points,
    "some NaN": lambda points: np.concatenate([points, np.full((len(points), 3), np.nan)]),
    "shuffled": lambda points: points[np.random.default_rng(0).permutation(len(points))],
    "NaN": lambda points: points * np.nan,
    "one axis NaN": lambda points: points + np.array([0, np.nan, 0]),
    "inf": lambda points: points + np.inf,
    "mixed": lambda points: np.concatenate([points[:3], np.full((len(points), 3), np.inf)]),
    "zero": lambda points: np.zeros_like(points) + IN_LIDAR,
    "huge": lambda points: points * 1e25,
    "empty": lambda points: points[:0],
    "few": lambda points: points[:2],
}
GOOD = {"good", "some NaN", "shuffled"}
FEWER = np.concatenate([WALL_POINTS[::7], FAR_POINTS[::5]])
EVENTS = st.lists(
    st.tuples(
        st.sampled_from([0.1, 0.55, 0.55, 0.7, 1.6, 3.0]),
        st.one_of(st.just("good"), st.sampled_from(list(KINDS))),
        st.one_of(st.just(0.0), st.sampled_from([-YEAR, -HOUR, -1.0, -0.4, 0.2, 0.7, 1.4, 1.6, 10.0, HOUR, YEAR])),
        st.sampled_from(["lidar", "lidar", "lidar", "base", "map", "", "lidar2"]),
        st.booleans(),
    ),
    max_size=12,
)


def test_generated_clouds_keep_the_rule(scene):
    """Only a usable message, newer than the one before, changes what planners see; 200 sequences of up to 12."""
    tried = [0]

    @settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(events=EVENTS)
    def check(events: list[tuple[float, str, float, str, bool]]) -> None:
        at = scene(plans=False)
        usual: list[int] = []
        seen_ns: int | None = None
        wall, due_ns = False, 0
        for wait_s, kind, age_s, frame, with_wall in events:
            at.wait(wait_s)
            tried[0] += 1
            points = FEWER if with_wall else FAR_POINTS[::5]
            points = KINDS[kind](points + (IN_LIDAR if frame == "base" else 0))
            at.see(points, age_s, frame)
            now_ns = at.clock.now_ns()
            if now_ns >= due_ns:
                due_ns = now_ns + ns(0.5)
                measured_ns = now_ns - max(ns(age_s), 0)
                in_order = seen_ns is None or measured_ns >= seen_ns
                count = len(points) if kind == "few" else 100
                covered = kind not in (*GOOD, "few") or count < 0.05 * max(usual[-10:], default=0)
                if not covered and -0.5 <= age_s <= 1.5 and in_order and frame in ("lidar", "base"):
                    seen_ns, wall = measured_ns, with_wall
                    usual.append(count)
            try:
                found = "wall" if "lidar" in at.session.bus.call(SNAPSHOT).objects else "free"
            except PlanningError:
                found = "refused"
            fresh = seen_ns is not None and now_ns - seen_ns <= ns(1.5)
            assert found == ("refused" if not fresh else "wall" if wall else "free")
        at.world.stop()

    check()
    assert tried[0] > 500


SIZES = st.sampled_from([-1, 0, 1, 2, 3, 7, 12, 16, 255, 10**6, 10**9, 2**31, 2**32 - 1])
LAYOUTS = st.builds(
    PointCloud2,
    header=st.just(Header(0, "lidar")),
    height=SIZES,
    width=SIZES,
    fields=st.lists(
        st.builds(PointField, st.sampled_from(["x", "y", "z", "rgb", ""]), SIZES, st.integers(0, 12)), max_size=5
    ).map(tuple),
    is_bigendian=st.booleans(),
    point_step=SIZES,
    row_step=SIZES,
    data=st.binary(max_size=96).map(lambda data: np.frombuffer(data, np.uint8)),
)


@pytest.mark.parametrize("examples", [100, pytest.param(500, marks=pytest.mark.long)])
def test_generated_layouts_are_points_or_refused(scene, examples):
    """Each layout is read as points or refused; none erases the wall, and none ends the run."""
    at = scene()
    at.see_wall()
    read = [0]

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(message=LAYOUTS)
    def check(message: PointCloud2) -> None:
        try:
            points = cloud_points(message)
        except ValueError:
            pass
        else:
            assert points.shape == (message.height * message.width, 3)
            read[0] += 1
        at.wait(0.6)
        at.publish(message)
        at.clock.advance(ns(0.6))
        at.see_wall()
        assert "lidar" in at.session.bus.call(SNAPSHOT).objects

    check()


# Objects of a simulated scene.


@pytest.mark.parametrize(
    ("poses", "told"),
    [
        (np.zeros(3), "seven numbers up to 1000 begin at 0"),
        (np.full(14, np.nan), "seven numbers up to 1000 begin at 0"),
        (np.zeros(14), "its quaternion has length 0, must be 1"),
        (None, "nothing newer has come"),
    ],
)
def test_poses_of_the_scene_that_stop_or_make_no_sense_refuse_plans(make, tmp_path, poses: Vector | None, told: str):
    from .parts import POSES
    from .test_motion import robot_yaml

    runtime = make(text=robot_yaml(tmp_path) + "world: {scene: true}")
    runtime.start()
    bus = runtime.session.bus
    good = np.array([0.2, 2.0, 0.1, 1, 0, 0, 0, 0.4, 2.5, 0.6, 0, 0, 0, 1.0])
    bus.publish(POSES, Float64MultiArray(good))
    for _ in range(120):
        if poses is not None:
            bus.publish(POSES, Float64MultiArray(poses))
        elif runtime.session.clock.now_ns() == 0:
            bus.publish(POSES, Float64MultiArray(good))
        runtime.step()
    with pytest.raises(PlanningError, match=told) as refused:
        bus.call(SNAPSHOT)
    assert "the pose of object 'cube' is 1." in str(refused.value)
    assert "(world.scene_max_age)" in str(refused.value)
    bus.publish(POSES, Float64MultiArray(good))
    assert bus.call(SNAPSHOT).objects["cube"].pose.position.y == 2.0


def test_diagnostics_are_those_of_what_has_a_limit(scene):
    at = scene(CLOUD + "\nobjects: {table: {shape: plane, position: [0, 0, -0.1]}}")
    told = at.session.bus.subscribe("/diagnostics", 10)
    at.see_wall()
    at.wait(1.0)
    message = told.drain()[-1].message
    assert isinstance(message, DiagnosticArray)
    (status,) = message.status
    assert (status.level, status.name, status.message) == (DiagnosticStatus.OK, "world lidar", "")
    assert {each.key: each.value for each in status.values} == {
        "age_s": "1.00",
        "max_age_s": "1.5",
        "when_stale": "refuse",
    }
