"""Options of `type: webxr` under `teleoperation`. Nothing here imports NumPy."""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_http.addresses import check_name

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import OperatorEvent, Robot

HANDS = ("left", "right")
"""The hands of an operator, as WebXR calls them; on a phone the page asks which arm it drives."""
NONE = "none"
"""Value of `gripper` for a robot without one."""


def _check_host(instance: Any, attribute: attrs.Attribute[Any], value: str) -> None:
    if value == "localhost":
        return
    try:
        ipaddress.ip_address(value)
    except ValueError:
        raise ValueError(
            f"{value!r} is not an address of this machine: 127.0.0.1 serves this machine alone, 0.0.0.0 the network"
        ) from None


@documented
@attrs.frozen
class WebxrOptions(Options):
    """Options of `type: webxr`; the joints' own limits bound every speed."""

    host: str = option(
        "127.0.0.1",
        validator=_check_host,
        help="address to listen on: 127.0.0.1 for this machine alone, 0.0.0.0 for the network",
    )
    port: int = option(8443, ge=0, le=65535, help="port of the page; 0: any free one")
    names: tuple[str, ...] = option(
        (),
        validator=attrs.validators.deep_iterable(check_name),
        help="names and addresses under which browsers reach this machine; empty: its host name and address",
    )
    certificate: Path | None = option(
        None, help="certificate of this machine, made by `ibrobot certs`; without one, the page makes its own"
    )
    key: Path | None = option(None, help="private key of the certificate")
    cameras: tuple[str, ...] = option((), help="cameras whose images the page shows; empty: all")
    image_rate: float = option(15.0, unit="Hz", gt=0, le=60, help="images per second of each camera, at most")
    hand: str = option("any", choices=("any", *HANDS), help="the controller that moves this arm")
    gripper: str = option("gripper", help="group of joints that the trigger moves, or none; all others move the tool")
    scale: float = option(1.0, gt=0, le=10, help="distance of the tool for each metre of the hand")
    facing: float = option(
        0.0,
        unit="rad",
        ge=-7,
        le=7,
        help="direction in which the operator looks, from the robot's x axis to the left; 3.14: towards the robot",
    )
    turn: bool = option(True, help="whether the tool turns with the hand")
    tool_speed: float = option(0.5, unit="m/s", gt=0, le=1, help="highest speed of the tool")
    turn_speed: float = option(2.0, unit="rad/s", gt=0, le=6, help="highest speed of turning the tool")
    stick_speed: float = option(0.1, unit="m/s", gt=0, le=1, help="speed of the tool with an on-screen stick pushed")
    gripper_speed: float = option(2.0, unit="rad/s", gt=0, help="speed of the gripper")
    cutoff: float = option(
        4.0, unit="Hz", gt=0, le=100, help="cutoff of the One Euro filter at rest; it delays poses by 1/(2 pi cutoff)"
    )
    cutoff_slope: float = option(
        20.0, unit="Hz s/m", ge=0, help="increase of the cutoff with the speed of the hand; a turn of 1 rad is 0.2 m"
    )
    follow_time: float = option(
        0.04, unit="s", ge=0.02, le=1, help="time constant with which the tool approaches the pose of the hand"
    )
    dead_zone: float = option(0.001, unit="m", ge=0, lt=0.05, help="movement of a hand that counts as rest")
    dead_angle: float = option(0.005, unit="rad", ge=0, lt=0.2, help="turn of a hand that counts as rest")
    timeout: float = option(0.05, unit="s", ge=0.03, le=0.09, help="silence of the page after which the robot holds")
    follow: float = option(
        0.1,
        unit="rad",
        ge=0,
        help="distance from the last setpoint beyond which the clutch starts from the measured position",
    )

    def __attrs_post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both, or neither")
        if self.names and self.port == 0:
            raise ValueError("port 0, any free port, is for tests on this machine: names needs a fixed port")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the robot has a model and the gripper, and that the certificate exists."""
        if robot.description.mjcf is None:
            yield OptionFault((), "a hand moves the tool, which needs robot.description.mjcf: set it", "mjcf")
        if self.gripper not in (NONE, *robot.groups):
            known = did_you_mean(self.gripper, (*robot.groups, NONE), "the groups are")
            yield OptionFault(("gripper",), f"unknown group {self.gripper!r}{known}; `{NONE}` if nothing grips")
        for name, path in (("certificate", self.certificate), ("key", self.key)):
            if path is not None and not path.is_file():
                yield OptionFault((name,), f"{path}: no such file; `ibrobot certs` makes certificates and keys")

    def events(self) -> Collection[OperatorEvent]:
        """The buttons of the page."""
        return ("start", "success", "failure", "discard", "intervention")

    def peripherals(self) -> Iterable[tuple[tuple[str | int, ...], str]]:
        """Its cameras."""
        return [(("cameras", i), name) for i, name in enumerate(self.cameras)]
