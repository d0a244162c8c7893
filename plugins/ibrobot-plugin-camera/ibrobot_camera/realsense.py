"""The sensor `realsense`: colour or aligned depth of an Intel RealSense, which two peripherals may share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar, override

import attrs
import numpy as np
from ibrobot_ros2.jpeg import to_jpeg
from numpy.typing import NDArray

from ibrobot_camera.calibration import load_info
from ibrobot_camera.camera import to_image
from ibrobot_camera.capture import Pixels
from ibrobot_camera.librealsense import load_library
from ibrobot_camera.options import RealSenseOptions
from ibrobot_core.api import CameraInfo, CompressedImage, Context, Header, Image, Message, Sensor, SensorError
from ibrobot_core.app import raise_thread_priority

_WAIT_MS = 200
_CLOSE_S = 5.0
_LOST_S = 5.0
"""A camera without images for this long is lost [s]."""
_SAME = 1e-6
_NS_PER_MS = 1e6


def find_device(serial: str) -> Any:
    """The RealSense with that serial number, or the only one connected.

    Raises:
        MissingDependency: as `load_library`.
        SensorError: if none is connected, or several are and no serial number is given.
    """
    rs = load_library()
    devices = {device.get_info(rs.camera_info.serial_number): device for device in rs.context().query_devices()}
    there = ", ".join(devices) or "none"
    if serial:
        if serial not in devices:
            raise SensorError(f"no RealSense with serial number {serial}; available: {there}")
        return devices[serial]
    if len(devices) != 1:
        raise SensorError(f"set serial to select a RealSense; available: {there}")
    return next(iter(devices.values()))


@attrs.define
class _Pair:
    """The newest colour and depth images and their time [ns]."""

    pictures: dict[str, Pixels]
    taken_ns: int


class _Device:
    """One open RealSense, for all peripherals that use it."""

    open_ones: ClassVar[dict[str, _Device]] = {}
    lock: ClassVar[threading.Lock] = threading.Lock()

    @classmethod
    def use(cls, options: RealSenseOptions, ctx: Context) -> _Device:
        """The device that `options` select; its first user opens it."""
        with cls.lock:
            shared = cls.open_ones.get(options.serial)
            if shared is None:
                shared = cls.open_ones[options.serial] = cls(options, ctx)
            elif shared.size != (options.width, options.height, options.fps):
                have = "{}x{} at {:g} Hz".format(*shared.size)
                raise SensorError(f"camera {ctx.name}: another peripheral has this RealSense open with {have}")
            shared.users += 1
            return shared

    def __init__(self, options: RealSenseOptions, ctx: Context) -> None:
        self._rs = rs = load_library()
        self.size = options.width, options.height, options.fps
        self.users = 0
        self.changed = threading.Condition()
        self.newest: _Pair | None = None
        self.number = 0
        self.error = ""
        self._ctx = ctx
        self._key = options.serial
        device = find_device(options.serial)
        wanted = {rs.stream.color: rs.format.bgr8, rs.stream.depth: rs.format.z16}
        self._open: list[Any] = []
        self._queue = rs.syncer()
        self._align = rs.align(rs.stream.color)
        self._ended = threading.Event()
        try:
            for sensor in device.query_sensors():
                profiles = [profile for profile in map(self._match, sensor.get_stream_profiles()) if profile]
                chosen = [p for p in profiles if wanted.get(p.stream_type()) == p.format()]
                if chosen:
                    sensor.open([chosen[0]])
                    self._open.append(sensor)
                    wanted.pop(chosen[0].stream_type())
                    if chosen[0].stream_type() == rs.stream.color:
                        self.intrinsics = chosen[0].as_video_stream_profile().get_intrinsics()
            if wanted:
                streams = " and ".join(stream.name for stream in wanted)
                size = f"{options.width}x{options.height} at {options.fps:g} Hz"
                raise SensorError(f"camera {ctx.name}: this RealSense does not offer {streams} of {size}")
            for sensor in self._open:
                sensor.start(self._queue)
        except BaseException:
            self._release()
            raise
        self._thread = threading.Thread(target=self._run, name=f"realsense {options.serial}", daemon=True)
        self._thread.start()

    def leave(self) -> None:
        """Remove a user; the last one closes the device."""
        with _Device.lock:
            self.users -= 1
            if self.users:
                return
            del _Device.open_ones[self._key]
        self._ended.set()
        self._thread.join(_CLOSE_S)
        self._release()

    def _match(self, profile: Any) -> Any:
        if not profile.is_video_stream_profile():
            return None
        video = profile.as_video_stream_profile()
        return profile if (video.width(), video.height(), float(profile.fps())) == self.size else None

    def _run(self) -> None:
        raise_thread_priority()
        rs, heard = self._rs, time.monotonic()
        while not self._ended.is_set():
            try:
                good, frames = self._queue.try_wait_for_frames(_WAIT_MS)
                if not good or frames.size() < 2:
                    if time.monotonic() - heard > _LOST_S:
                        raise RuntimeError(f"no images from the RealSense for {_LOST_S:g} s; is it plugged in?")
                    continue
                heard = time.monotonic()
                aligned = self._align.process(frames)
                colour, depth = aligned.get_color_frame(), aligned.get_depth_frame()
                pictures = {"color": np.array(colour.get_data()), "depth": _millimetres(depth)}
            except RuntimeError as error:
                with self.changed:
                    self.error = str(error)
                    self.changed.notify_all()
                return
            epoch = (rs.timestamp_domain.system_time, rs.timestamp_domain.global_time)
            now_ns = self._ctx.clock.now_ns()
            taken_ns = now_ns
            if colour.get_frame_timestamp_domain() in epoch:
                taken_ns = min(now_ns, round(colour.get_timestamp() * _NS_PER_MS))
            with self.changed:
                self.newest, self.number = _Pair(pictures, taken_ns), self.number + 1
                self.changed.notify_all()

    def _release(self) -> None:
        for sensor in self._open:
            try:
                sensor.stop()
                sensor.close()
            except RuntimeError as error:
                self._ctx.log.warning("camera %s: %s", self._ctx.name, error)
        self._open.clear()


def _millimetres(depth: Any) -> NDArray[np.uint16]:
    """Depths in mm for any unit of the device (a D405's is 0.1 mm); shape (H, W)."""
    millimetres: NDArray[np.uint16] = np.array(depth.get_data())
    unit_mm = depth.get_units() * 1e3
    if abs(unit_mm - 1.0) < _SAME:
        return millimetres
    scaled: NDArray[np.uint16] = np.rint(np.minimum(millimetres * unit_mm, np.iinfo(np.uint16).max)).astype(np.uint16)
    return scaled


class RealSenseCamera(Sensor):
    """Colour as bgr8, or depth as 16UC1 [mm], aligned to the colour images.

    Args:
        options: options from the YAML.
        ctx: name, clock and logger.

    Raises:
        MissingDependency: as `load_library`.
    """

    def __init__(self, options: RealSenseOptions, ctx: Context) -> None:
        load_library()
        self.message_type = CompressedImage if (options.encoding, options.stream) == ("jpeg", "color") else Image
        self.topic = f"/camera/{ctx.name}/image_raw"
        self._options = options
        self._ctx = ctx
        self._frame_id = options.frame_id or f"{ctx.name}_optical_frame"
        self._device: _Device | None = None
        self._number = 0
        self._last_ns = 0
        self._info: Callable[[Header], CameraInfo] | None = None

    @override
    def open(self) -> None:
        if self._device is None:
            try:
                self._info = self._calibration()
            except SensorError as error:
                raise SensorError(f"camera {self._ctx.name}: {error}") from None
            self._device = _Device.use(self._options, self._ctx)
            self._number = self._device.number

    def _calibration(self) -> Callable[[Header], CameraInfo] | None:
        if self._options.info is None:
            return None
        info, (height, width) = load_info(self._options.info), self._options.picture
        calibrated = info(Header())
        if (calibrated.width, calibrated.height) != (width, height):
            size = f"{calibrated.width}x{calibrated.height}"
            raise SensorError(f"{self._options.info}: is for images of {size}, these are {width}x{height}")
        return info

    @override
    def read(self, timeout_s: float) -> Image | CompressedImage | None:
        device = self._device
        if device is None:
            raise SensorError(f"camera {self._ctx.name}: not open")
        with device.changed:
            device.changed.wait_for(lambda: device.error or device.number > self._number, timeout_s)
            if device.number == self._number or device.newest is None:
                if device.error:
                    raise SensorError(f"camera {self._ctx.name}: {device.error}")
                return None
            self._number, newest = device.number, device.newest
        self._last_ns = max(newest.taken_ns, self._last_ns + 1)
        image = to_image(newest.pictures[self._options.stream], Header(self._last_ns, self._frame_id))
        return to_jpeg(image, self._options.jpeg_quality) if self.message_type is CompressedImage else image

    @override
    def close(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.leave()

    @override
    def latched(self) -> tuple[tuple[str, Message], ...]:
        if self._device is None:
            return ()
        header = Header(self._ctx.clock.now_ns(), self._frame_id)
        if self._info is not None:
            return ((f"/camera/{self._ctx.name}/camera_info", self._info(header)),)
        i = self._device.intrinsics
        k = np.array([i.fx, 0, i.ppx, 0, i.fy, i.ppy, 0, 0, 1], dtype=np.float64)
        p = np.insert(k, (3, 6, 9), 0.0)
        info = CameraInfo(
            header, i.height, i.width, d=np.array(i.coeffs, dtype=np.float64), k=k, r=np.eye(3).ravel(), p=p
        )
        return ((f"/camera/{self._ctx.name}/camera_info", info),)
