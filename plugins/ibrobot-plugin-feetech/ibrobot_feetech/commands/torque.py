"""`ibrobot feetech torque`: switches the motors on, without a jump, or off."""

from __future__ import annotations

import click

from ibrobot_core.app import Declined, echo
from ibrobot_feetech.arm import hold, relax
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, by_servo, chosen, joints_of
from ibrobot_feetech.commands.ports import opened, port_argument
from ibrobot_feetech.protocol import MAX_ID


@click.command()
@click.argument("state", type=click.Choice(["on", "off"]))
@port_argument
@click.option("--joint", "names", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--robot", metavar="CONFIG", help="Robot YAML with the joints; by default an SO-101.")
@click.option("--id", "ids", type=click.IntRange(0, MAX_ID), multiple=True, help="Only this servo; may be repeated.")
@click.option("--yes", is_flag=True, help="Switch off without asking.")
def torque(
    state: str, port: str | None, names: tuple[str, ...], robot: str | None, ids: tuple[int, ...], yes: bool
) -> None:
    """Switch the motors on, holding the present positions, or off."""
    if ids and (names or robot):
        raise click.UsageError("--id names servos, --joint and --robot name joints: give one or the other")
    joints = [Joint(f"servo {number}", number, 0.0, 0.0) for number in ids] or chosen(joints_of(robot), names)
    with opened(port, joints=by_servo(joints)) as bus:
        if state == "on":
            for joint in joints:
                hold(bus, joint.servo)
        else:
            echo("Without torque the arm falls: hold it, or check that it rests on something.")
            if not (yes or TerminalGuide().confirm("Torque off?", flag="--yes")):
                raise Declined
            relax(bus, [joint.servo for joint in joints])
    echo(f"torque {state}: {', '.join(joint.name for joint in joints)}")
