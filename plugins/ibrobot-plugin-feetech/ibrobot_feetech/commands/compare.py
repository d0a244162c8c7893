"""`ibrobot feetech compare`: compares the zeros and directions of two arms in three poses, set by hand."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from ibrobot_calibration import load_calibration
from ibrobot_terminal import Guide
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import HardwareError, Vector, option
from ibrobot_core.app import Unsuccessful
from ibrobot_feetech.arm import find_servos, relax
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, arm_of, joints_of
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.options import TOOL
from ibrobot_feetech.usb import check_adapter

POSES = ("at rest, folded", "in the middle pose", "stretched out forward and turned to a side")
"""Three poses that differ in every joint."""
_WARNS_DEG, _FAILS_DEG = 3.0, 8.0
"""Distances of zeros, as those of the cause `leader_apart`."""
_MOVED_DEG = 15.0
"""A joint that moved by less between the poses tells nothing about directions."""
_COLUMNS = ("joint", ">pose 1", ">pose 2", ">pose 3", ">zero off", "verdict")


@attrs.frozen(kw_only=True)
class CompareArms(OnPort):
    """Compare a leader with its follower in three poses, set by hand.

    PORT is that of the follower. The torque of both arms is switched off. A joint whose zero differs by 8 degrees, or
    that turns the other way, fails, and the command exits with 1.
    """

    leader_port: str = option(help="serial port of the leader")
    name: str = option("so101_follower", help="calibration of the follower, by name or path")
    leader_name: str = option("so101_leader", help="calibration of the leader, likewise")
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    yes: bool = option(False, help="switch the torque off without asking")

    def __call__(self) -> None:
        if not compare_arms(
            TerminalGuide(), self.port, self.leader_port, self.name, self.leader_name, robot=self.robot, yes=self.yes
        ):
            raise Unsuccessful


def compare_arms(
    guide: Guide, port: str | None, leader_port: str, name: str, leader_name: str, *, robot: str | None = None,
    yes: bool = False,
) -> bool:  # fmt: skip
    """Compare two arms, and return whether no joint fails; the arguments are those of the command.

    Raises:
        CalibrationError: if a calibration cannot be read.
        Declined: if the operator does not go on.
        HardwareError: if a servo does not answer, or both ports are the same.
    """
    joints = joints_of(robot, name)
    names = tuple(joint.name for joint in joints)
    follower, leader = (load_calibration(each, names, tool=TOOL) for each in (name, leader_name))
    if leader.path == follower.path:
        raise HardwareError(f"{leader.path}: is the calibration of both arms; give that of the leader by --leader-name")
    guide.say("The torque of both arms will be switched off, and they will fall: hold them.")
    if not yes and not guide.confirm("Go on?", flag="--yes", default=True):
        raise Declined
    poses: list[tuple[Vector, Vector]] = []
    ours, theirs = arm_of(joints, follower), arm_of(joints, leader)
    with opened(port, joints=ours.names) as bus, opened(leader_port, joints=theirs.names) as other:
        arms = [(bus, ours), (other, theirs)]
        for each, arm in arms:
            check_adapter(arm.calibration, each.port.path)
            find_servos(each, arm)
            relax(each, arm.servos)
        for pose in POSES:
            guide.wait(f"Put both arms into the same pose: {pose}.")
            read = [
                arm.radians(np.array(list(each.sync_read("present_position", arm.servos).values()), np.float64))
                for each, arm in arms
            ]
            poses.append((read[0], read[1]))
    verdicts = [_verdict(joint, column, poses) for column, joint in enumerate(joints)]
    guide.show(_COLUMNS, [row for row, _ in verdicts])
    for _, text in verdicts:
        if text:
            guide.say(text, warning=True)
    fails = sum(row[-1] == "FAIL" for row, _ in verdicts)
    if not fails:
        guide.say(f"{counted(len(joints), 'joint')} compared in {counted(len(POSES), 'pose')}: none fails")
    return not fails


def _verdict(joint: Joint, column: int, poses: Sequence[tuple[Vector, Vector]]) -> tuple[tuple[str, ...], str]:
    """The row of a joint, and what is to be said of it."""
    ours, theirs = (np.degrees([each[arm][column] for each in poses]) for arm in (0, 1))
    apart = theirs - ours
    cells = (joint.name, *(f"{each:+.1f}°" for each in apart.tolist()))
    moved = float(np.ptp(ours))
    if joint.anchored:  # another handle, another range
        return (*cells, "", "not compared"), ""
    middle = float(np.median(apart))
    row = (*cells, f"{middle:+.1f}°")
    if moved >= _MOVED_DEG and float(np.ptp(ours + theirs)) < 0.5 * float(np.ptp(apart)):
        text = (
            f"{joint.name}: as the follower turned by {moved:.0f} deg, the leader turned the other way: one of them is "
            "reversed; `ibrobot feetech check` with --check-signs says which, or name it in `inverted` of the leader"
        )
        return (*row, "FAIL"), text
    if float(np.ptp(apart)) > _FAILS_DEG:
        text = (
            f"{joint.name}: both arms are {apart.min():+.1f} to {apart.max():+.1f} deg apart in the poses, which "
            f"differ by more than {_FAILS_DEG:.0f}: the poses were not the same, or a horn slips; repeat it"
        )
        return (*row, "?"), text
    if abs(middle) < _WARNS_DEG:
        return (*row, "ok"), ""
    text = (
        f"{joint.name}: the zeros are {middle:+.1f} deg apart (warns from {_WARNS_DEG:.0f}, fails from "
        f"{_FAILS_DEG:.0f}): look at the horns and screws of both, and calibrate the arm again whose angle is wrong"
    )
    return (*row, "FAIL" if abs(middle) >= _FAILS_DEG else "warn"), text
