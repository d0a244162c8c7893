"""Simulated cameras: conformance, which state becomes a picture, calibration, and that pictures show the scene."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from importlib import import_module
from types import SimpleNamespace
from typing import Any, cast, override

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics.poses import matrix
from ibrobot_mujoco import gl
from ibrobot_mujoco.camera import MujocoCamera
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.model import build_spec
from ibrobot_mujoco.options import CameraOptions, MujocoOptions
from ibrobot_mujoco.render import Renderer
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import PHYSICS_TOPIC, DrawnWorld
from ibrobot_mujoco.world import World
from ibrobot_ros2.jpeg import to_jpeg
from ibrobot_testing import SensorSuite, control_context, host_context

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Context,
    EpisodeSetup,
    Float64MultiArray,
    Image,
    Pose,
    Sensor,
    SensorError,
    TFMessage,
    Vector,
)
from ibrobot_core.app import installed_plugins

MISSING = installed_plugins().missing("sensor", "mujoco")
pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))

ROBOT = so101()
OPTIONS = MujocoOptions()
SMALL = CameraOptions(width=64, height=48)
TICK_NS = 10_000_000
SLOT_NS = 33_333_333


def scene_state(stamp_ns: int, cube: tuple[float, float] | None = None) -> Vector:
    """The physics state of the scene as an episode begins, with the cube somewhere else if asked."""
    ctx = control_context(robot=ROBOT)
    ctx.clock.sleep_until(stamp_ns)
    hardware = MujocoHardware(OPTIONS, ctx)
    hardware.connect()
    hardware.reset(EpisodeSetup(0))
    out = np.empty(hardware.signals[0].size)
    hardware.read_signal(0, out)
    out[:2] = divmod(stamp_ns, 1_000_000_000)
    if cube is not None:
        out[8:10] = cube
    return out


STATE = scene_state(0)


def publish(ctx: Context, stamp_ns: int, cube: tuple[float, float] | None = None) -> None:
    assert ctx.bus is not None
    state = np.concatenate([divmod(stamp_ns, 1_000_000_000), STATE[2:]])
    if cube is not None:
        state[8:10] = cube
    ctx.bus.publish(PHYSICS_TOPIC, Float64MultiArray(state))


def watched_context(name: str = "top") -> Context:
    """The context of a camera whose pictures have a receiver."""
    ctx = host_context(name, robot=ROBOT, simulation=OPTIONS)
    assert ctx.bus is not None
    ctx.bus.subscribe(f"/camera/{name}/image_raw", 1)
    return ctx


class TestConformance(SensorSuite):
    @override
    def context(self) -> Context:
        return watched_context()

    @override
    def make(self, ctx: Context) -> MujocoCamera:
        return MujocoCamera(SMALL, ctx)

    @override
    def trigger(self, sensor: Sensor, ctx: Context) -> None:
        for _ in range(4):
            ctx.clock.sleep_until(ctx.clock.now_ns() + TICK_NS)
            publish(ctx, ctx.clock.now_ns())


@pytest.fixture
def ctx() -> Context:
    return watched_context()


@pytest.fixture
def camera(ctx: Context) -> Iterator[MujocoCamera]:
    camera = MujocoCamera(SMALL, ctx)
    camera.open()
    yield camera
    camera.close()


def test_lockstep_renders_what_a_receiver_gets() -> None:
    """Pictures are the same whoever came and went before; without a receiver, nothing renders."""
    pictures = []
    for watched in ((True, True, True, True), (False, True, False, True), (False, False, False, True)):
        ctx = host_context("top", robot=ROBOT, simulation=OPTIONS)
        assert ctx.bus is not None
        camera = MujocoCamera(SMALL, ctx)
        camera.open()
        try:
            for i, is_watched in enumerate(watched):
                receiver = ctx.bus.subscribe(camera.topic, 1) if is_watched else None
                publish(ctx, i * SLOT_NS + 1, cube=(0.2, 0.02 * i))
                image = camera.read(0)
                assert (image is not None) == is_watched
                assert camera.idle != is_watched
                if receiver is not None:
                    receiver.close()
            assert isinstance(image, CompressedImage)
            assert image.header.stamp_ns == 3 * SLOT_NS + 1
            assert camera.skipped == 0
            pictures.append(image.data.tobytes())
        finally:
            camera.close()
    assert len(set(pictures)) == 1


def red_of(image: object) -> np.ndarray:
    """Rows and columns of the red pixels of a raw picture, shape (N, 2)."""
    assert isinstance(image, Image)
    pixels = image.data.reshape(image.height, image.width, 3).astype(int)
    return np.argwhere((pixels[..., 0] > 2 * pixels[..., 1]) & (pixels[..., 0] > 2 * pixels[..., 2]))


@pytest.mark.parametrize("name", ["top", "wrist"])
def test_pose_of_the_camera_comes_with_its_picture(name: str) -> None:
    """A cube where the axis of the pose meets the table is in the middle of the picture, also to one side of it."""
    ctx = watched_context(name)
    assert ctx.bus is not None
    camera = MujocoCamera(CameraOptions(width=320, height=240, encoding="raw"), ctx)
    camera.open()
    try:
        publish(ctx, 1)
        assert camera.read(0) is not None, "nobody listens to /tf"
        transforms = ctx.bus.subscribe("/tf", 5)
        publish(ctx, 2 * SLOT_NS)
        picture = camera.read(0)
        assert isinstance(picture, Image)
        (received,) = transforms.drain()
        assert isinstance(received.message, TFMessage)
        (placed,) = received.message.transforms
        assert (placed.header.frame_id, placed.child_frame_id) == ("base_link", picture.header.frame_id)
        assert placed.header.stamp_ns == picture.header.stamp_ns
        pose = matrix(Pose(placed.translation, placed.rotation))
        at, ahead = pose[:3, 3], pose[:3, 2]
        assert ahead[2] < 0, "it looks down"
        x, y, _ = at + ahead * (0.0125 - at[2]) / ahead[2]
        ((_, info),) = camera.latched()
        assert isinstance(info, CameraInfo)
        for slot, shift in ((3, (0.0, 0.0)), (4, (0.015, 0.0)), (5, (0.0, 0.015))):
            publish(ctx, slot * SLOT_NS, cube=(x + shift[0], y + shift[1]))
            there = np.linalg.inv(pose)[:3] @ (x + shift[0], y + shift[1], 0.0125, 1.0)
            column, row, _ = info.k.reshape(3, 3) @ (there / there[2])
            assert np.hypot(*(red_of(camera.read(0)).mean(axis=0) - (row, column))) < 6.0, shift
    finally:
        camera.close()


def test_pose_that_the_robot_yaml_has_is_left_alone() -> None:
    mounted = {"top": SimpleNamespace(transform=object())}
    session = cast("Any", SimpleNamespace(config=SimpleNamespace(peripherals=mounted)))
    ctx = attrs.evolve(watched_context(), session=session)
    assert ctx.bus is not None
    transforms = ctx.bus.subscribe("/tf", 5)
    camera = MujocoCamera(SMALL, ctx)
    camera.open()
    try:
        publish(ctx, 1)
        assert camera.read(0) is not None
        assert transforms.drain() == []
    finally:
        camera.close()


def test_reading_without_waiting(ctx: Context, camera: MujocoCamera) -> None:
    assert camera.read(0) is None, "nothing was published"
    publish(ctx, 10 * SLOT_NS)
    image = camera.read(0)
    assert image is not None
    assert image.header.stamp_ns == 10 * SLOT_NS
    assert camera.read(0) is None, "the same state twice"
    publish(ctx, 11 * SLOT_NS - 1)
    assert camera.read(0) is None, "the next picture is not due yet"
    publish(ctx, 11 * SLOT_NS)
    image = camera.read(0)
    assert image is not None
    assert image.header.stamp_ns == 11 * SLOT_NS


def test_of_many_states_the_newest_is_drawn_and_the_others_are_counted(ctx: Context, camera: MujocoCamera) -> None:
    for slot in (10, 11, 12, 15):
        publish(ctx, slot * SLOT_NS)
    image = camera.read(0)
    assert image is not None
    assert image.header.stamp_ns == 15 * SLOT_NS
    assert camera.skipped == 0, "before the first picture none was due"
    publish(ctx, 18 * SLOT_NS)
    assert camera.read(0) is not None
    assert camera.skipped == 2
    assert ctx.bus is not None
    assert ctx.bus.dropped() == {}


def test_thirty_pictures_a_second_of_simulated_time(ctx: Context, camera: MujocoCamera) -> None:
    stamps = []
    for tick in range(1, 101):
        publish(ctx, 1_700_000_000_000_000_000 + tick * TICK_NS)
        image = camera.read(0)
        if image is not None:
            stamps.append(image.header.stamp_ns)
    assert len(stamps) in (30, 31)
    assert set(np.diff(stamps)) <= {3 * TICK_NS, 4 * TICK_NS}
    assert camera.skipped == 0


def test_waits_for_a_state_that_is_due(ctx: Context, camera: MujocoCamera) -> None:
    publish(ctx, 10 * SLOT_NS)
    assert camera.read(0) is not None
    publish(ctx, 10 * SLOT_NS + 1)  # too early: read must wait on
    later = threading.Timer(0.02, publish, (ctx, 11 * SLOT_NS))
    later.start()
    image = camera.read(5.0)
    later.join()
    assert image is not None
    assert image.header.stamp_ns == 11 * SLOT_NS


def test_calibration_follows_the_field_of_view(camera: MujocoCamera) -> None:
    ((topic, info),) = camera.latched()
    assert topic == "/camera/top/camera_info"
    assert isinstance(info, CameraInfo)
    k = info.k.reshape(3, 3)
    assert 2 * np.degrees(np.arctan(24 / k[1, 1])) == pytest.approx(42.0)
    np.testing.assert_allclose(k[:2, 2], [31.5, 23.5])


def test_calibration_projects_the_cube_to_where_it_is_seen(ctx: Context) -> None:
    """From directly above, forward (x) is up in the image and left (y) is left."""
    camera = MujocoCamera(CameraOptions(encoding="raw"), ctx)
    camera.open()
    try:
        assert ctx.bus is not None
        x, y = 0.2, -0.1
        ctx.bus.publish(PHYSICS_TOPIC, Float64MultiArray(scene_state(SLOT_NS, cube=(x, y))))
        image = camera.read(0)
        ((_, info),) = camera.latched()
    finally:
        camera.close()
    assert isinstance(info, CameraInfo)
    rows, columns = red_of(image).T
    focal, depth = info.k[0], 0.80 - 0.025  # the camera's height less the cube's top
    assert columns.mean() == pytest.approx(319.5 - focal * (y - 0.04) / depth, abs=3)
    assert rows.mean() == pytest.approx(239.5 - focal * (x - 0.16) / depth, abs=3)


def test_the_wrist_camera_is_found_by_its_peripherals_name() -> None:
    ctx = watched_context("wrist")
    camera = MujocoCamera(SMALL, ctx)
    camera.open()
    try:
        publish(ctx, SLOT_NS)
        image = camera.read(0)
    finally:
        camera.close()
    assert image is not None
    assert camera.topic == "/camera/wrist/image_raw"
    assert image.header.frame_id == "wrist_optical_frame"


def test_an_unknown_camera_is_named(ctx: Context) -> None:
    camera = MujocoCamera(CameraOptions(camera="bottom"), ctx)
    with pytest.raises(SensorError, match=r"camera 'top': no bottom in the scene; its cameras are: .*wrist_cam"):
        camera.open()


@pytest.mark.parametrize("simulation", [None, "other"])
def test_needs_a_simulation(simulation: object) -> None:
    camera = MujocoCamera(SMALL, host_context("top", robot=ROBOT, simulation=simulation))
    with pytest.raises(SensorError, match=r"camera 'top': type mujoco needs a running simulation: \{type: mujoco\}"):
        camera.open()


def test_pictures_are_jpeg_of_what_was_rendered(ctx: Context, camera: MujocoCamera) -> None:
    raw = MujocoCamera(attrs.evolve(SMALL, encoding="raw"), ctx)
    raw.open()
    try:
        publish(ctx, SLOT_NS)
        exact, message = raw.read(0), camera.read(0)
    finally:
        raw.close()
    assert isinstance(exact, Image)
    assert isinstance(message, CompressedImage)
    assert message == to_jpeg(exact, 90)
    assert message.data.size < exact.data.size / 4


def test_low_poly_looks_like_the_full_meshes(ctx: Context) -> None:
    camera = MujocoCamera(attrs.evolve(SMALL, encoding="raw"), ctx)
    camera.open()
    try:
        publish(ctx, SLOT_NS)
        image = camera.read(0)
    finally:
        camera.close()
    assert isinstance(image, Image)
    spec, made = build_spec(OPTIONS, ROBOT)
    spec.visual.quality.offsamples = 0
    full = spec.compile()
    drawn = DrawnWorld(World.of(full), made)
    drawn.follow(STATE)
    renderer = Renderer(full, full.camera("top").id, 64, 48, shadows=False)
    try:
        expected = renderer.render(drawn.data).astype(int)
    finally:
        renderer.close()
    low_poly = image.data.reshape(48, 64, 3).astype(int)
    yellow = [(p[..., 0] > 1.5 * p[..., 2]) & (p[..., 1] > 1.3 * p[..., 2]) for p in (low_poly, expected)]
    assert yellow[1].sum() > 50, "no arm in the picture"
    overlap = (yellow[0] & yellow[1]).sum() / (yellow[0] | yellow[1]).sum()
    assert overlap > 0.9
    assert np.abs(low_poly - expected).mean() < 4


def drawn_and_closed(frames: list[Any]) -> None:
    """Make, use and close a renderer, and append what it drew."""
    drawn = DrawnWorld.of(OPTIONS, ROBOT)
    renderer = Renderer(drawn.model, drawn.model.camera("top").id, 64, 48, shadows=False)
    try:
        drawn.follow(STATE)
        frames.append(renderer.render(drawn.data))
    finally:
        renderer.close()


@pytest.mark.parametrize("step", ["making", "reading", "freeing"])
def test_renderers_of_two_threads_never_use_opengl_at_once(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    frames: list[Any] = []
    overlaps: list[bool] = []
    entered = threading.Event()
    other = threading.Thread(target=drawn_and_closed, args=(frames,))
    context = import_module(f"mujoco.{gl.choose()}").GLContext
    steps: tuple[tuple[str, Any, str], ...] = (
        ("making", mujoco, "MjrContext"),
        ("reading", mujoco, "mjr_readPixels"),
        ("freeing", context, "free"),
    )

    def watch(name: str, original: Any) -> Any:
        def watched(*arguments: Any) -> Any:
            if threading.current_thread() is other:
                entered.set()
            elif name == step and other.ident is None:
                other.start()
                overlaps.append(entered.wait(0.5))
            return original(*arguments)

        return watched

    for name, owner, attribute in steps:
        monkeypatch.setattr(owner, attribute, watch(name, getattr(owner, attribute)))
    drawn_and_closed(frames)
    other.join()
    assert overlaps == [False]
    assert np.array_equal(*frames)


def test_depth_is_the_distance_along_the_optical_axis() -> None:
    ctx = watched_context()
    camera = MujocoCamera(CameraOptions(stream="depth"), ctx)
    camera.open()
    try:
        assert ctx.bus is not None
        x, y = 0.2, -0.1
        ctx.bus.publish(PHYSICS_TOPIC, Float64MultiArray(scene_state(SLOT_NS, cube=(x, y))))
        image = camera.read(0)
        ((_, info),) = camera.latched()
    finally:
        camera.close()
    assert isinstance(image, Image)
    assert isinstance(info, CameraInfo)
    assert (image.encoding, image.height, image.width, image.step) == ("16UC1", 480, 640, 1280)
    depth = image.data.view("<u2").reshape(480, 640)
    # The camera hangs 0.80 m above the table; the cube is 25 mm high.
    row, column = round(239.5 - info.k[0] * (x - 0.16) / 0.775), round(319.5 - info.k[0] * (y - 0.04) / 0.775)
    assert depth[row, column] == pytest.approx(775, abs=2)
    assert depth[row - 60, column] == pytest.approx(800, abs=2)
