"""`ibrobot feetech torque`: switches the motors on, without a jump, or off."""

from __future__ import annotations

import attrs
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo
from ibrobot_feetech.arm import hold, relax
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, by_servo, chosen, joints_of
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.protocol import MAX_ID


@attrs.frozen(kw_only=True)
class Torque(OnPort):
    """Switch the motors on, holding the present positions, or off."""

    state: str = option(typed="on|off", choices=["on", "off"], help="on or off")
    names: tuple[str, ...] = option((), typed="--joint NAME", help="only this joint; may be repeated")
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    ids: tuple[int, ...] = option((), typed="--id", ge=0, le=MAX_ID, help="only this servo; may be repeated")
    yes: bool = option(False, help="switch off without asking")

    def __call__(self) -> None:
        if self.ids and (self.names or self.robot):
            raise RequestError("--id names servos, --joint and --robot name joints: give one or the other")
        joints = [Joint(f"servo {number}", number, 0.0, 0.0) for number in self.ids] or chosen(
            joints_of(self.robot), self.names
        )
        with opened(self.port, joints=by_servo(joints)) as bus:
            if self.state == "on":
                for joint in joints:
                    hold(bus, joint.servo)
            else:
                echo("Without torque the arm falls: hold it, or check that it rests on something.")
                if not (self.yes or TerminalGuide().confirm("Torque off?", flag="--yes")):
                    raise Declined
                relax(bus, [joint.servo for joint in joints])
        echo(f"torque {self.state}: {', '.join(joint.name for joint in joints)}")
