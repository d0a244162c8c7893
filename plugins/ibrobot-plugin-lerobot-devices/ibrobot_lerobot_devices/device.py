"""The device process: has one device of LeRobot's and answers requests, until its parent ends it or dies.

Started by `DeviceLink` as `python -m ibrobot_lerobot_devices.device CHANNEL`. LeRobot's calls may block; a thread takes
the requests meanwhile, and keeps the newest action.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.app import Channel, ComponentFailed, run_child
from ibrobot_lerobot_devices.stand_in import replace_torch
from ibrobot_lerobot_devices.units import driven

_SILENCE_S = 0.25
"""How old the newest action that a base drives by may get; then it stands [s]."""
_AGAIN_S = 0.05
"""Time between attempts to let a base stand [s]."""
_NICE = -10
_PICTURE_MS = 200
"""Longest time to wait for a picture before an answer without one [ms]."""
_EARLY = 0.9
"""How early a picture may be taken, as a share of the camera's period."""
_LOOK_S = 0.004
"""Time between looks for a new picture, at a camera that does not wait for one [s]."""
READY, ANSWER, DONE, TRAFFIC, END = "ready", "answer", "done", "traffic", "end"
"""Events: it is connected; a reading or why there is none; a request is carried out; what its ports received; the
device is released, and a base stands."""
STAND = "stand"
"""The request to let a base stand."""
CONNECT = "connect"
"""The request to connect, to a process that has imported what it needs and waits."""
_END: dict[str, Any] = {"do": "end"}
_OVERDUE: dict[str, Any] = {"do": "overdue"}
_NEWEST = ("act", "read", STAND)
"""Requests of which only the newest counts."""


@attrs.define
class Traffic:
    """Traffic from serial ports during the present call of LeRobot's."""

    reads: int = 0
    received: int = 0
    """[bytes]."""

    def watch(self) -> None:
        """Count what every serial port of this process receives; LeRobot's buses all use pyserial."""
        try:
            import serial
        except ImportError:
            return
        port_class: Any = serial.Serial
        read = port_class.read

        def counting(port: Any, size: int = 1) -> Any:
            content = read(port, size)
            self.reads += 1
            self.received += len(content)
            return content

        port_class.read = counting


@attrs.define
class Requests:
    """Requests of the parent, in order; of actions, and of requests to read or to stand, only the newest counts."""

    channel: Channel
    farewell_s: float
    """How long a call may go on after the parent has ended or died [s]."""
    traffic: Traffic = attrs.field(factory=Traffic)
    _waiting: queue.SimpleQueue[dict[str, Any]] = attrs.field(factory=queue.SimpleQueue)
    _newest: dict[str, dict[str, Any]] = attrs.field(factory=dict)
    ended: threading.Event = attrs.field(factory=threading.Event)

    def start(self) -> None:
        """Take requests in a thread, which ends the process if a call outlives the parent."""
        threading.Thread(target=self._take, daemon=True).start()

    def next(self, timeout_s: float | None) -> dict[str, Any]:
        """The next request; `_OVERDUE` if none comes within `timeout_s` [s], which is unlimited if it is None."""
        while True:
            try:
                request = self._waiting.get(timeout=timeout_s)
            except queue.Empty:
                return _OVERDUE
            if request["do"] not in _NEWEST:
                return request
            newest = self._newest.pop(request["do"], None)
            if newest is not None:
                return newest

    def put(self, request: dict[str, Any]) -> None:
        """Take a request."""
        if request["do"] == TRAFFIC:  # whatever LeRobot's call does
            self.channel.send({"event": TRAFFIC, **attrs.asdict(self.traffic)})
            return
        if request["do"] in _NEWEST:
            self._newest[request["do"]] = request
        self._waiting.put(request)

    def _take(self) -> None:
        while (request := self.channel.next(None)) is not None and request["do"] != "end":
            self.put(request)
        self._waiting.put(_END)
        if not self.ended.wait(self.farewell_s):
            os._exit(1)


@attrs.define
class Pictures:
    """Finds the new ones among the pictures that a camera gives, which may be the same one again."""

    fps: float | None
    _pixels: Any = None
    """Pixels of the newest picture, shape (H, W) or (H, W, C)."""
    _taken_s: float | None = None

    def is_new(self, pixels: Any, taken_s: float | None) -> bool:
        """Whether a picture is another one than the one before, and not the same one again.

        Equal pixels are a new picture only if the camera says that it took them, at least one period later: some
        say for each request that they have just taken what they give.

        Args:
            pixels: shape (H, W) or (H, W, C); kept, so nobody may write to them.
            taken_s: when it was taken [s]; None if the camera does not say it.
        """
        import numpy as np

        if taken_s is not None and taken_s == self._taken_s:
            return False
        if self._pixels is not None and np.array_equal(pixels, self._pixels):
            since_s = None if taken_s is None or self._taken_s is None else taken_s - self._taken_s
            if self.fps is None or since_s is None or since_s < _EARLY / self.fps:
                return False
        self._pixels, self._taken_s = pixels, taken_s
        return True


class Device:
    """A connected device of LeRobot's, of any kind.

    Args:
        order: its kind, type and config.
    """

    def __init__(self, order: Mapping[str, Any]) -> None:
        from ibrobot_lerobot_devices import library

        self._library = library
        self._order = order
        self._device: Any = None
        self._seen = Pictures(None)
        self._color = ""
        self._acted: dict[str, float] = {}
        """The last action."""
        self._until_s: float | None = None
        """When a base that drives must stand, unless a new action comes [s]; None if it stands."""
        self.failures = 0
        """How many actions in a row LeRobot has not carried out."""

    def prepare(self) -> None:
        """Import what the device needs, without touching it."""
        self._library.choices(self._order["kind"], self._order["type"])

    def make(self) -> dict[str, Any]:
        """Make LeRobot's object; return what it says about itself without being connected."""
        order = self._order
        self._device = device = self._library.make(order["kind"], order["type"], order["config"])
        if order["kind"] == "camera":
            return {}
        return self._library.facts(device)

    def connect(self) -> dict[str, Any]:
        """Make and connect the device; return what it says about itself."""
        made = self.make()
        if self._order["kind"] == "camera":
            self._color = self._library.color_order(self._device)
            self._device.connect()
            self._seen = Pictures(self._library.fps(self._device))
            return made
        device = self._device
        device.connect(calibrate=False)
        if not device.is_calibrated:
            self._device.disconnect()
            raise self._library.DeviceError(
                f"is not calibrated: LeRobot finds no calibration that fits its motors; its file is "
                f"{device.calibration_fpath}"
            )
        self.stand()  # the motors may have kept their velocities from an earlier process
        return made | {"motors": self._library.motors(device)}

    def read(self) -> dict[str, float]:
        """The plain values of an observation, or of an action of a teleoperator."""
        get = self._device.get_observation if self._order["kind"] == "robot" else self._device.get_action
        return self._library.numbers(get())

    def picture(self) -> dict[str, Any]:
        """The next new picture, once it is there: its shape, type, colours and content."""
        import numpy as np

        deadline_s = time.monotonic() + _PICTURE_MS / 1000
        while True:
            pixels = np.array(self._device.async_read(timeout_ms=_PICTURE_MS), order="C")
            taken_s = self._library.taken_s(self._device)
            if self._seen.is_new(pixels, taken_s):
                break
            if time.monotonic() >= deadline_s:
                raise TimeoutError("the camera gives the same picture again")
            time.sleep(_LOOK_S)
        age_s = 0.0 if taken_s is None else max(0.0, time.perf_counter() - taken_s)
        made_ns = time.monotonic_ns() - round(age_s * 1e9)
        return {
            "shape": list(pixels.shape), "type": str(pixels.dtype), "color": self._color, "made_ns": made_ns,
            "content": memoryview(pixels),
        }  # fmt: skip

    def act(self, action: Mapping[str, float], made_ns: int) -> None:
        """Send an action, which was made at `made_ns` (`time.monotonic_ns`); an old one lets the base stand."""
        axes = driven(list(action)).values()
        until_s = made_ns / 1e9 + _SILENCE_S
        if until_s <= time.monotonic():  # e.g. since this process was stopped
            action = {**action, **dict.fromkeys(axes, 0.0)}
        drives = any(action[name] for name in axes)
        if drives and self._until_s is None:  # also if LeRobot fails: some motors may have received it
            self._until_s = until_s
        self._acted = dict(action)
        self.failures += 1
        self._device.send_action(dict(action))
        self.failures = 0
        self._until_s = until_s if drives else None

    @property
    def patience_s(self) -> float | None:
        """How long a base may still drive without another action [s]; None if it stands."""
        return None if self._until_s is None else max(0.0, self._until_s - time.monotonic())

    @property
    def is_overdue(self) -> bool:
        """Whether a base drives by an action that is too old."""
        return self.patience_s == 0.0

    def stand(self) -> dict[str, Any]:
        """Let the base stand, by the first means that works.

        Raises:
            DeviceError: if none does.
        """
        axes = driven(list(self._device.action_features)).values() if self._order["kind"] == "robot" else ()
        if not axes:
            return {}
        why = ""
        for mean in (self._stand_by_action, self._stand_by_lerobot, self._stand_without_torque):
            try:
                if mean(dict.fromkeys(axes, 0.0)):
                    self._until_s = None
                    return {}
            except Exception as error:  # noqa: BLE001 - of LeRobot's; another means may work
                why = why or _one_line(error)
        if self._until_s is not None:
            self._until_s = time.monotonic() + _AGAIN_S
        raise self._library.DeviceError(f"LeRobot cannot stop the base: {why}")

    def _stand_by_action(self, rest: Mapping[str, float]) -> bool:
        """Stop by an action that leaves the arm where it was sent, or where it is."""
        features = self._device.action_features
        arm = self._acted or {name: value for name, value in self.read().items() if name in features}
        self._device.send_action({**arm, **rest})
        return True

    def _stand_by_lerobot(self, rest: Mapping[str, float]) -> bool:
        """Stop by LeRobot's own call, if the robot has one, as LeKiwi."""
        return bool(self._library.stop_base(self._device))

    def _stand_without_torque(self, rest: Mapping[str, float]) -> bool:
        """Stop by switching off the torque of the wheels."""
        wheels = self._library.wheels(self._device)
        for bus, names in wheels:
            bus.disable_torque(names)
        return bool(wheels)

    def relax(self) -> dict[str, Any]:
        """Switch the torque off."""
        for owner in self._library.torque_switches(self._device):
            owner.disable_torque()
        return {}

    def hold(self) -> dict[str, Any]:
        """Switch the torque on, with the present positions as goals."""
        features = self._device.action_features
        here = {name: value for name, value in self.read().items() if name in features}
        self.act(here | dict.fromkeys(driven(list(features)).values(), 0.0), time.monotonic_ns())
        for owner in self._library.torque_switches(self._device):
            owner.enable_torque()
        return {}

    def reconnect(self) -> dict[str, Any]:
        """Connect again, e.g. after a cable was out."""
        self.disconnect()
        return self.connect()

    def disconnect(self) -> bool:
        """Release the device; its torque stays as it is. Returns whether a base stands."""
        stands = False
        with contextlib.suppress(Exception):  # e.g. since its cable is out
            self.stand()
            stands = True
        with contextlib.suppress(Exception):  # also since it is not connected
            self._device.disconnect()
        return stands


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if type(error).__name__ == "DeviceError" else f"{type(error).__name__}: {text}"


def serve(device: Device, requests: Requests) -> None:
    """Carry requests out until the parent ends or dies."""
    while serve_next(device, requests, device.patience_s):
        pass


def serve_next(device: Device, requests: Requests, timeout_s: float | None) -> bool:
    """Carry the next request out, and let a base that is overdue stand before; False at the end."""
    request = requests.next(timeout_s)
    requests.traffic.reads = requests.traffic.received = 0
    if device.is_overdue:  # e.g. since this process was stopped and goes on
        with contextlib.suppress(Exception):  # it tries again, and the parent finds that actions fail
            device.stand()
    if request is not _OVERDUE and request["do"] != "end":
        carry_out(device, request, requests.channel)
    return bool(request["do"] != "end")


def carry_out(device: Device, request: Mapping[str, Any], channel: Channel) -> None:
    """Carry a request out, and answer it."""
    what = request["do"]
    begun_ns = time.monotonic_ns()
    answer: dict[str, Any] = {
        "event": ANSWER if what in ("read", "picture") else DONE, "do": what, "id": request.get("id"),
    }  # fmt: skip
    try:
        if what == "act":
            device.act(request["action"], request["made_ns"])
            return
        values: dict[str, Any] = getattr(device, what)()
    except Exception as error:  # noqa: BLE001 - contained: the answer has the error
        channel.send(answer | {"error": _one_line(error), "times": device.failures})
        return
    if what == "picture":
        content = values.pop("content")
        channel.send(answer | values, content)
    elif what == "read":
        channel.send(answer | {"values": values, "made_ns": (begun_ns + time.monotonic_ns()) // 2})
    else:
        channel.send(answer | {"found": values})


def prefer() -> None:
    """Run before other programs, as far as the machine permits it, but not in real time, as the parent may.

    LeRobot's buses spin while they wait for replies: in real time they would keep the kernel from passing these on.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(_NICE - os.nice(0))
        Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")  # Linux compares sessions first


def run(channel: Channel, order: Mapping[str, Any]) -> None:
    """Run with the parent's channel.

    Raises:
        ComponentFailed: with LeRobot's error in one line.
    """
    requests = Requests(channel, order["farewell_s"])
    try:
        _run(channel, order, requests)
    except Exception as error:  # noqa: BLE001 - of LeRobot, whatever it is
        raise ComponentFailed(_one_line(error)) from None
    finally:
        requests.ended.set()


def _run(channel: Channel, order: Mapping[str, Any], requests: Requests) -> None:
    if not order["torch"]:
        replace_torch()
    if order["kind"] == "describe":
        from ibrobot_lerobot_devices import library

        channel.send({"event": READY, "found": library.describe()})
        return
    device = Device(order)
    if order["only_make"]:
        channel.send({"event": READY, "found": device.make()})
        return
    requests.start()
    if order["waits"]:
        device.prepare()
        if requests.next(None)["do"] != CONNECT:
            return
    requests.traffic.watch()
    try:
        description = device.connect()
        channel.send({"event": READY, "found": description})
        serve(device, requests)
    finally:
        if device.disconnect():
            channel.send({"event": END})


if __name__ == "__main__":
    prefer()
    status = run_child(run)
    sys.stdout.flush()
    os._exit(status)  # threads of LeRobot's devices may never end
