"""The plugin's hooks: teleop `webxr`, and checks for `ibrobot doctor`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Check, Late, TeleopDescriptor, hookimpl
from ibrobot_webxr.options import WebxrOptions


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Drive the tool with a hand in space."""
    yield TeleopDescriptor(
        type="webxr",
        options=WebxrOptions,
        make=Late("ibrobot_webxr.teleop:WebxrTeleop"),
        label="drive with a phone or VR controller",
        summary="moves the tool with a phone, a VR controller or a hand, through a web page",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check the page's own certificate."""
    from ibrobot_webxr.certificate import checks

    return checks()
