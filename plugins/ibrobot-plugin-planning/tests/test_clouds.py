"""Point clouds and depth images of a run as cells of the world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_planning import ibrobot_sections
from ibrobot_planning.world.clouds import CLEAR, SensedWorld
from ibrobot_planning.world.objects import OBSERVED, Plane, Voxels
from ibrobot_planning.world.options import WorldOptions
from ibrobot_planning.world.voxels import cloud_points, outside
from ibrobot_testing import SectionSuite, make_session

from ibrobot_core.api import (
    CameraInfo,
    Header,
    Image,
    Message,
    MissingDependency,
    PointCloud2,
    PointField,
    Quaternion,
    TFMessage,
    TransformStamped,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import Component, ConfigError, Session, single_options

from .table_arm import make_robot

CLOUD = "clouds: {lidar: {topic: /points, cell: 0.02, least_points: 1, reach: 2.0, furthest: 3.0}}"
DEPTH = "clouds: {top: {topic: /camera/top/image_raw, cell: 0.02, least_points: 1}}"
FIELDS = tuple(PointField(axis, 4 * i, 7) for i, axis in enumerate("xyz"))
K = np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]])


def options(text: str = CLOUD) -> WorldOptions:
    return single_options(WorldOptions, (), "world", text=text)


def session_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Session:
    session = make_session(robot=make_robot(folder))
    monkeypatch.setattr(session, "measured", lambda: SimpleNamespace(position=np.zeros(6)))
    return session


class TestSensedWorld(SectionSuite):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.monkeypatch = tmp_path, monkeypatch

    @override
    def session(self) -> Session:
        return session_of(self.folder, self.monkeypatch)

    @override
    def component(self, session: Session) -> Component:
        return SensedWorld(options(), session)


def test_a_world_that_is_sensed_names_what_this_machine_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ibrobot_planning.world.engines.find_spec", lambda name: None)
    world = next(each for each in ibrobot_sections() if each.type == "world")
    with pytest.raises(MissingDependency, match=r'pip install "ibrobot-plugin-planning\[obstacles\]"'):
        world.make(options(), session_of(tmp_path, monkeypatch))


def cloud(points: Any, frame: str = "lidar") -> PointCloud2:
    data = np.asarray(points, dtype="<f4")
    return PointCloud2(
        Header(0, frame), 1, len(data), FIELDS, False, 12, 12 * len(data), data.reshape(-1).view(np.uint8)
    )


def depth_image(depth: Vector, encoding: str = "16UC1") -> Image:
    data = (1000 * depth).astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
    height, width = depth.shape
    step = width * data.itemsize
    return Image(Header(0, "top_optical_frame"), height, width, encoding, step, data.reshape(-1).view(np.uint8))


INFO = CameraInfo(Header(0, "top_optical_frame"), 30, 40, k=K.ravel())
MOUNTS = TFMessage(
    (
        TransformStamped(Header(0, "base"), "lidar", Vector3(0.0, 0.0, 0.5), Quaternion()),
        # 0.8 m above the table, looking down; the picture's right is the base's x.
        TransformStamped(Header(0, "base"), "top_frame", Vector3(0.31, 0.01, 0.8), Quaternion()),
        TransformStamped(Header(0, "top_frame"), "top_optical_frame", Vector3(), Quaternion(1.0, 0.0, 0.0, 0.0)),
    )
)


@attrs.define
class Run:
    """A keeper of a run in lockstep."""

    session: Session
    keeper: SensedWorld

    def publish(self, message: Message, topic: str = "/points") -> None:
        self.session.bus.publish(topic, message)
        self.keeper.step(0)

    def wait(self, seconds: float) -> None:
        self.session.clock.advance(ns(seconds))  # type: ignore[attr-defined]

    def cells(self, name: str = "lidar") -> Vector:
        """Centres of the occupied cells."""
        objects = self.session.bus.call(OBSERVED).world.objects
        if name not in objects:
            return np.zeros((0, 3))
        assert isinstance(objects[name].shape, Voxels)
        shape: Any = objects[name].shape
        return shape.centres


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Run]]:
    made: list[SensedWorld] = []

    def started(text: str = CLOUD, *, mounts: bool = True) -> Run:
        session = session_of(tmp_path, monkeypatch)
        if mounts:
            session.bus.publish("/tf_static", MOUNTS, latched=True)
        made.append(SensedWorld(options(text), session))
        made[-1].start()
        return Run(session, made[-1])

    yield started
    for keeper in made:
        keeper.stop()


def test_points_become_cells_in_the_base_frame(run):
    at = run()
    at.publish(cloud([[0.31, 0.21, -0.39], [0.311, 0.211, -0.388], [np.nan, 0, 0], [9.0, 0, 0]]))
    np.testing.assert_allclose(at.cells(), [[0.31, 0.21, 0.11]])


def test_depth_images_become_cells(run):
    at = run(DEPTH)
    at.session.bus.publish("/camera/top/camera_info", INFO, latched=True)
    depth = np.full((30, 40), 2.0)  # further than is asked for
    depth[15, 20], depth[5, 20] = 0.75, 0.59
    for encoding in ("16UC1", "32FC1"):
        at.publish(depth_image(depth, encoding), "/camera/top/image_raw")
        # The first on the optical axis, 5 cm above the base; the other 10 pixels, so 6 cm, up in the picture.
        np.testing.assert_allclose(at.cells("top"), [[0.31, 0.01, 0.05], [0.31, 0.07, 0.21]], atol=0.011)
        at.wait(1.0)


def test_the_arm_and_known_objects_are_left_out(run):
    known = CLOUD + "\nobjects: {table: {shape: box, size: [1, 1, 0.02], position: [0, 0, -0.01]}}"
    at = run(known)
    arm, table, other = [0.0, 0.0, -0.3], [0.3, 0.3, -0.495], [0.3, 0.3, -0.29]
    at.publish(cloud([arm, table, other]))
    np.testing.assert_allclose(at.cells(), [[0.31, 0.31, 0.21]], atol=0.011)


def test_the_newest_message_replaces_the_others(run):
    at = run()
    at.publish(cloud([[0.3, 0.2, -0.4]]))
    at.wait(0.1)
    at.publish(cloud([[0.3, -0.2, -0.4]]))
    assert at.cells()[0, 1] > 0, "at most two updates per second"
    at.wait(0.5)
    at.publish(cloud([[0.3, -0.2, -0.4]]))
    assert at.cells()[:, 1].max() < 0
    at.wait(1.0)
    at.publish(cloud([[9.0, 0.0, 0.0]]))
    assert not len(at.cells()), "nothing is near"


def test_cells_are_kept_and_cleared(run):
    at = run(CLOUD.replace("cell:", "keep: 2.0, cell:"))
    for y in (0.2, -0.2):
        at.publish(cloud([[0.3, y, -0.4]]))
        at.wait(1.0)
    assert len(at.cells()) == 2
    at.wait(0.5)
    at.publish(cloud([[0.3, -0.2, -0.4]]))
    assert len(at.cells()) == 1
    at.session.bus.call(CLEAR, None)
    assert not len(at.cells())
    at.wait(1.0)
    at.publish(cloud([[0.3, 0.3, -0.4]]))
    assert len(at.cells()) == 1


def test_cells_are_bounded(run, caplog: pytest.LogCaptureFixture):
    at = run(CLOUD.replace("cell:", "most_cells: 3, cell:"))
    at.publish(cloud([[0.3 + 0.03 * i, 0.2, -0.4] for i in range(9)]))
    np.testing.assert_allclose(at.cells()[:, 0].max(), 0.37, atol=0.011)
    assert len(at.cells()) == 3
    assert "9 occupied cells, only the nearest 3 are kept (most_cells)" in caplog.text


def test_camera_that_moves_is_followed(run):
    at = run(DEPTH)
    at.session.bus.publish("/camera/top/camera_info", INFO, latched=True)
    depth = np.full((30, 40), 2.0)
    depth[15, 20] = 0.69
    moved = attrs.evolve(MOUNTS.transforms[1], translation=Vector3(0.31, 0.21, 0.9))
    at.session.bus.publish("/tf", TFMessage((moved,)))
    at.publish(depth_image(depth), "/camera/top/image_raw")
    np.testing.assert_allclose(at.cells("top"), [[0.31, 0.21, 0.21]], atol=0.011)


def big_endian(message: PointCloud2) -> PointCloud2:
    return attrs.evolve(message, is_bigendian=True, data=message.data.view("<f4").astype(">f4").view(np.uint8))


def test_layouts_of_clouds():
    points = [[0.25, 0.5, 0.75], [1.0, 2.0, 3.0]]
    np.testing.assert_array_equal(cloud_points(big_endian(cloud(points))), points)
    # Two rows of one point, doubles, with padding in points and rows.
    fields = (PointField("intensity", 0, 7), *(PointField(axis, 8 + 8 * i, 8) for i, axis in enumerate("xyz")))
    data = np.zeros((2, 40), np.uint8)
    for row, point in enumerate(points):
        data[row, 8:32] = np.array(point).view(np.uint8)
    message = PointCloud2(Header(), 2, 1, fields, False, 32, 40, data.reshape(-1))
    np.testing.assert_array_equal(cloud_points(message), points)


ONE = cloud([[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (attrs.evolve(ONE, fields=FIELDS[:2]), "the cloud has no field z; it has: x, y"),
        (attrs.evolve(ONE, fields=()), "the cloud has no field x; it has: none"),
        (
            attrs.evolve(ONE, fields=(PointField("x", 0, 4), *FIELDS[1:])),
            "field x of the cloud has datatype 4, must be",
        ),
        (attrs.evolve(ONE, width=2), "needs rows of at least 24 bytes; this one has rows of 12 and 12 bytes"),
        (attrs.evolve(ONE, height=2), "this one has rows of 12 and 12 bytes"),
        (
            attrs.evolve(ONE, fields=(*FIELDS[:2], PointField("z", 10, 7))),
            "field z of the cloud ends beyond its points",
        ),
    ],
)
def test_malformed_clouds_are_refused(message: PointCloud2, told: str):
    with pytest.raises(ValueError, match=told):
        cloud_points(message)


@pytest.mark.parametrize(
    ("text", "message", "told"),
    [
        (
            CLOUD,
            cloud([[0.3, 0.2, 0.0]], "map"),
            "no transform of frame 'map' to the base; peripherals[].transform says",
        ),
        (CLOUD, attrs.evolve(ONE, fields=()), "cloud 'lidar' (/points): refused a message: the cloud has no field x"),
        (CLOUD, attrs.evolve(depth_image(np.ones((2, 2))), encoding="rgb8"), "got sensor_msgs/msg/Image rgb8"),
        (CLOUD, depth_image(np.ones((30, 40))), "a depth image needs the CameraInfo of its camera on /camera_info"),
    ],
)
def test_what_cannot_be_used_is_reported_once(run, text: str, message: Message, told: str, caplog):
    at = run(text)
    for _ in range(2):
        at.publish(message)
        at.wait(1.0)
    assert [told in record.getMessage() for record in caplog.records] == [True]
    assert not len(at.cells())


def test_image_of_another_size_than_its_info_is_reported(run, caplog: pytest.LogCaptureFixture):
    at = run(DEPTH)
    at.session.bus.publish("/camera/top/camera_info", INFO, latched=True)
    at.publish(depth_image(np.ones((20, 40))), "/camera/top/image_raw")
    assert "the image has 20x40 pixels, but CameraInfo says 30x40" in caplog.text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{topic: points}", "'points' is not a topic: a topic begins with /, e.g. /camera/top/image_raw"),
        ("{}", "clouds.a.topic: required key is missing"),
        ("{topic: /p, cell: 0}", "0.0 is too small, must be at least 0.002 m"),
        ("{topic: /p, rate: 100}", "100.0 is too large, must be at most 30 Hz"),
        ("{topic: /p, most_cells: 0}", "0 is too small, must be at least 1"),
        ("{topic: /p, cells: 1}", "unknown key, did you mean 'cell'?"),
    ],
)
def test_mistakes_in_the_yaml(text: str, told: str):
    with pytest.raises(ConfigError) as failure:
        options(f"clouds: {{a: {text}}}")
    assert told in str(failure.value)


def test_cloud_with_the_name_of_an_object_is_refused(tmp_path: Path):
    both = options("objects: {a: {shape: plane}}\nclouds: {a: {topic: /p}}")
    (fault,) = both.check(make_robot(tmp_path), ())
    assert (fault.option, fault.message) == (
        ("clouds", "a"),
        "there is an object 'a' already; clouds need names of their own",
    )


def test_planes_hide_what_is_below_them():
    from ibrobot_planning.world.coal_shapes import geometry

    cells = Voxels(0.02, np.array([[0, 0, -9], [0, 0, 0], [0, 0, 9]]))
    left = outside(cells, [(geometry(Plane()), np.eye(4))], 0.01)
    assert left is not None
    assert left.cells.tolist() == [[0, 0, 9]]
