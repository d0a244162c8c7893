"""The device process: has one device of LeRobot's and answers requests, until its parent ends it or dies.

Started by `DeviceLink` as `python -m ibrobot_lerobot_devices.device CHANNEL PICTURES`. PICTURES is a pipe for the
pictures of cameras. LeRobot's calls may block; a thread takes the requests meanwhile, and keeps the newest action.
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

from ibrobot_core.app import Channel, ComponentFailed, Failure, open_parent
from ibrobot_lerobot_devices.stand_in import replace_torch
from ibrobot_lerobot_devices.units import driven

_FAREWELL_S = 1.0
"""How long a call may go on after the parent has ended or died [s]."""
_SILENCE_S = 0.25
"""A base that drives stands again when no action has come for this long [s]."""
_NICE = -10
_PICTURE_MS = 200
"""Longest time to wait for a picture before an answer without one [ms]."""
READY, ANSWER, DONE, TRAFFIC = "ready", "answer", "done", "traffic"
"""Events: it is connected; a reading or why there is none; a request is carried out; what its ports received."""
_END: dict[str, Any] = {"do": "end"}
_STAND: dict[str, Any] = {"do": "stand"}


@attrs.define
class Traffic:
    """What the present call of LeRobot's has received from serial ports."""

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
    """Requests of the parent, in order; of actions and of requests to read only the newest counts."""

    channel: Channel
    traffic: Traffic = attrs.field(factory=Traffic)
    _waiting: queue.SimpleQueue[dict[str, Any]] = attrs.field(factory=queue.SimpleQueue)
    _newest: dict[str, dict[str, Any]] = attrs.field(factory=dict)
    ended: threading.Event = attrs.field(factory=threading.Event)

    def start(self) -> None:
        """Take requests in a thread, which ends the process if a call outlives the parent."""
        threading.Thread(target=self._take, daemon=True).start()

    def next(self, timeout_s: float | None) -> dict[str, Any]:
        """The next request; one to stand if none comes within `timeout_s` [s], which is unlimited if it is None."""
        while True:
            try:
                request = self._waiting.get(timeout=timeout_s)
            except queue.Empty:
                return _STAND
            if request["do"] not in ("act", "read"):
                return request
            newest = self._newest.pop(request["do"], None)
            if newest is not None:
                return newest

    def _take(self) -> None:
        try:
            while True:
                for request in self.channel.wait(None):
                    if request["do"] == "end":
                        raise ComponentFailed("ended")
                    if request["do"] == TRAFFIC:  # whatever LeRobot's call does
                        self.channel.send({"event": TRAFFIC, **attrs.asdict(self.traffic)})
                        continue
                    if request["do"] in ("act", "read"):
                        self._newest[request["do"]] = request
                    self._waiting.put(request)
        except ComponentFailed:
            self._waiting.put(_END)
            if not self.ended.wait(_FAREWELL_S):
                os._exit(1)


class Device:
    """A connected device of LeRobot's, of any kind.

    Args:
        order: its kind, type and config.
        pictures: the pipe for pictures.
    """

    def __init__(self, order: Mapping[str, Any], pictures: int) -> None:
        from ibrobot_lerobot_devices import library

        self._library = library
        self._order = order
        self._pictures = pictures
        self._device: Any = None
        self._driving: dict[str, float] = {}
        """The last action, if a base drives by it."""
        self._acted_s = 0.0

    def make(self) -> dict[str, Any]:
        """Make LeRobot's object; return what it says about itself without being connected."""
        order = self._order
        self._device = device = self._library.make(order["kind"], order["type"], order["config"])
        if order["kind"] == "camera":
            return {}
        return self._library.facts(device)

    def connect(self) -> dict[str, Any]:
        """Make and connect the device; return what it says about itself."""
        found = self.make()
        if self._order["kind"] == "camera":
            self._device.connect()
            return found
        device = self._device
        device.connect(calibrate=False)
        if not device.is_calibrated:
            self._device.disconnect()
            raise self._library.DeviceError(
                f"is not calibrated: LeRobot finds no calibration that fits its motors; its file is "
                f"{device.calibration_fpath}"
            )
        return found | {"motors": self._library.motors(device)}

    def read(self) -> dict[str, float]:
        """The plain values of an observation, or of an action of a teleoperator."""
        get = self._device.get_observation if self._order["kind"] == "robot" else self._device.get_action
        return self._library.numbers(get())

    def picture(self) -> dict[str, Any]:
        """Send the newest picture, once it is there, through the pipe; return its shape and type."""
        import numpy as np

        pixels = np.ascontiguousarray(self._device.async_read(timeout_ms=_PICTURE_MS))
        age_s = self._library.picture_age_s(self._device)
        made_ns = time.monotonic_ns() - round(age_s * 1e9)
        content = memoryview(pixels).cast("B")
        return {
            "shape": list(pixels.shape), "type": str(pixels.dtype), "made_ns": made_ns, "size": content.nbytes,
            "content": content,
        }  # fmt: skip

    def act(self, action: Mapping[str, float]) -> dict[str, Any]:
        """Send an action."""
        self._driving, self._acted_s = {}, time.monotonic()
        if any(action[name] for name in driven(list(action)).values()):
            self._driving = dict(action)
        self._device.send_action(dict(action))
        return {}

    @property
    def patience_s(self) -> float | None:
        """How long a base may still drive without another action [s]; None if it stands."""
        return max(0.0, self._acted_s + _SILENCE_S - time.monotonic()) if self._driving else None

    def stand(self) -> dict[str, Any]:
        """Let the base stand."""
        if self._driving:
            self.act(self._driving | dict.fromkeys(driven(list(self._driving)).values(), 0.0))
        return {}

    def relax(self) -> dict[str, Any]:
        """Switch the torque off."""
        for owner in self._library.torque_switches(self._device):
            owner.disable_torque()
        return {}

    def hold(self) -> dict[str, Any]:
        """Switch the torque on, with the present positions as goals."""
        features = self._device.action_features
        here = {name: value for name, value in self.read().items() if name in features}
        self.act(here | dict.fromkeys(driven(list(features)).values(), 0.0))
        for owner in self._library.torque_switches(self._device):
            owner.enable_torque()
        return {}

    def reconnect(self) -> dict[str, Any]:
        """Connect again, e.g. after a cable was out."""
        self.disconnect()
        return self.connect()

    def disconnect(self) -> None:
        """Release the device; its torque stays as it is."""
        with contextlib.suppress(Exception):  # e.g. since its cable is out
            self.stand()
        with contextlib.suppress(Exception):  # also since it is not connected
            self._device.disconnect()


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if type(error).__name__ == "DeviceError" else f"{type(error).__name__}: {text}"


def serve(device: Device, requests: Requests) -> None:
    """Carry requests out until the parent ends or dies."""
    channel = requests.channel
    while (request := requests.next(device.patience_s))["do"] != "end":
        what = request["do"]
        requests.traffic.reads = requests.traffic.received = 0
        begun_ns = time.monotonic_ns()
        answer: dict[str, Any] = {"event": ANSWER if what in ("read", "picture") else DONE, "id": request.get("id")}
        try:
            found: dict[str, Any] = device.act(request["action"]) if what == "act" else getattr(device, what)()
        except Exception as error:  # noqa: BLE001 - contained: the answer has the error
            channel.send(answer | {"do": what, "error": _one_line(error)})
            continue
        if what == "picture":
            content = found.pop("content")
            channel.send(answer | found)
            _send(device._pictures, content)
        elif what == "read":
            channel.send(answer | {"values": found, "made_ns": (begun_ns + time.monotonic_ns()) // 2})
        elif what not in ("act", "stand"):
            channel.send(answer | {"do": what, "found": found})


def _send(pipe: int, content: memoryview) -> None:
    while content:
        content = content[os.write(pipe, content) :]


def prefer() -> None:
    """Run before other programs, as far as the machine permits it, but not in real time, as the parent may.

    LeRobot's buses spin while they wait for replies: in real time they would keep the kernel from passing these on.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(_NICE - os.nice(0))
        Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")  # Linux compares sessions first


def main(parent: int, pictures: int) -> int:
    """Run with the parent's channel; returns the exit status."""
    prefer()
    channel = open_parent(parent)
    order = channel.wait(None)[0]
    requests = Requests(channel)
    try:
        if not order["torch"]:
            replace_torch()
        if order["kind"] == "describe":
            from ibrobot_lerobot_devices import library

            channel.send({"event": READY, "found": library.describe()})
            return 0
        device = Device(order, pictures)
        if order["only_make"]:
            channel.send({"event": READY, "found": device.make()})
            return 0
        requests.traffic.watch()
        requests.start()
        try:
            found = device.connect()
            channel.send({"event": READY, "found": found})
            serve(device, requests)
        finally:
            device.disconnect()
    except Exception as error:  # noqa: BLE001 - the parent reports it
        channel.report(Failure(_one_line(error)))
        return 1
    finally:
        channel.flush()
        requests.ended.set()
    return 0


if __name__ == "__main__":
    status = main(*(int(argument) for argument in sys.argv[1:]))
    sys.stdout.flush()
    os._exit(status)  # threads of LeRobot's devices may never end
