"""The plugin's hooks: teleop `webxr`, and checks for `ibrobot doctor`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Check, Late, TeleopDescriptor, hookimpl
from ibrobot_webxr.options import WebxrOptions, check_robot

if TYPE_CHECKING:
    from ibrobot_core.api import OperatorEvent, OptionFault, Robot


def _check(options: WebxrOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    return check_robot(options, robot)


def _events(options: WebxrOptions) -> Collection[OperatorEvent]:
    return ("start", "success", "failure", "discard", "intervention")


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Drive the tool with a hand in space."""
    yield TeleopDescriptor(
        type="webxr",
        options=WebxrOptions,
        make=Late("ibrobot_webxr.teleop:WebxrTeleop"),
        check_options=_check,
        events=_events,
        peripherals=lambda options: [(("cameras", i), name) for i, name in enumerate(options.cameras)],
        label="drive with a phone or VR controller",
        summary="moves the tool with a phone, a VR controller or a hand, through a web page",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check the page's own certificate."""
    from ibrobot_webxr.certificate import checks

    return checks()
