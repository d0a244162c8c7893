"""Options of the viewer `web` and of the teleop `web`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
from ibrobot_http.addresses import check_name, is_loopback

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

LEAST_PASSWORD = 12
"""Shortest password of a page on the network [characters]."""


@documented
@attrs.frozen
class WebOptions(Options):
    """Options of the viewer `type: web`."""

    host: str = option(
        "127.0.0.1", validator=check_name, help="address of the page; beyond this machine it needs certificate and key"
    )
    port: int = option(8080, ge=0, le=65535, help="port of the page; 0: any free port")
    names: tuple[str, ...] = option(
        (),
        validator=attrs.validators.deep_iterable(check_name),
        help="further host names of this machine in browsers, e.g. robot.local",
    )
    certificate: Path | None = option(None, help="TLS certificate, with the chain of its authority")
    key: Path | None = option(None, help="private key of the certificate")
    password: str | None = option(
        None, secret=True, help=f"password in place of the link's token; {LEAST_PASSWORD} characters or more"
    )
    browser: bool = option(True, help="whether to open the page in the browser of this desktop")
    rate_hz: float = option(30.0, unit="Hz", gt=0, le=60, help="highest rate of robot states and pictures")

    def __attrs_post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together; give both, or none of them")
        if not is_loopback(self.host) and self.certificate is None:
            raise ValueError(
                f"host {self.host} can be reached from the network, which needs TLS: give certificate and key, or use "
                "127.0.0.1 and an SSH tunnel"
            )
        if self.password is not None and len(self.password) < LEAST_PASSWORD:
            raise ValueError(f"password must have at least {LEAST_PASSWORD} characters")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the files of the certificate exist."""
        for name, path in (("certificate", self.certificate), ("key", self.key)):
            if path is not None and not path.is_file():
                yield OptionFault((name,), f"{path}: no such file")


@documented
@attrs.frozen
class WebTeleopOptions(Options):
    """Options of the teleop `type: web`; the joints' limits bound every speed."""

    joint_speed: float = option(0.8, unit="rad/s", gt=0, help="speed of joints")
    tool_speed: float = option(0.15, unit="m/s", gt=0, help="speed of the tool")
    turn_speed: float = option(0.8, unit="rad/s", gt=0, help="speed of turning the tool")
    gripper: str = option("gripper", help="joint group of the gripper; all other joints are the arm")
    follow: float = option(
        0.15, unit="rad", gt=0, help="how far a joint at rest may be from its setpoint; more than its sag under load"
    )
    timeout: float = option(
        0.2, unit="s", gt=0, le=0.2, help="time without a message of the page that releases the deadman"
    )
