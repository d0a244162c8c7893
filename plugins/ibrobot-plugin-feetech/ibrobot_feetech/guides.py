"""Guides for pages: the port of an arm, its motors, its calibration, and whether its servos match it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ibrobot_terminal import Guide, Question

from ibrobot_core.api import HardwareError
from ibrobot_feetech.calibration import ZERO_AT
from ibrobot_feetech.commands.calibrate import calibrate_arm
from ibrobot_feetech.commands.check import check_arm
from ibrobot_feetech.commands.compare import compare_arms
from ibrobot_feetech.commands.find_port import find_arm, list_ports
from ibrobot_feetech.commands.find_stops import TORQUE
from ibrobot_feetech.commands.joints import SO101
from ibrobot_feetech.commands.setup_motors import set_up_motors
from ibrobot_feetech.usb import usb_ports

Answered = Mapping[str, str | bool]
_FOLLOWER, _LEADER = "so101_follower", "so101_leader"
_ALL = "all, one after the other"


def list_all(answers: Answered, guide: Guide) -> None:
    """Show the USB serial ports."""
    list_ports(guide)


def find(answers: Answered, guide: Guide) -> None:
    """Find the port of an arm by its cable."""
    find_arm(guide, list_ports(guide))


def port_question() -> Question:
    """The port, with the adapters of SO-101 as suggestions."""
    arms = tuple(port.stable or port.path for port in usb_ports() if port.is_arm)
    return Question("port", "Port of the arm", arms[0] if arms else "", arms, open=True)


def setup_questions() -> Sequence[Question]:
    """Port and joint."""
    return (port_question(), Question("joint", "Joint", _ALL, (_ALL, *SO101)))


def set_up(answers: Answered, guide: Guide) -> None:
    """Set the servos up, one at a time."""
    joint = str(answers["joint"])
    set_up_motors(guide, _port(answers), () if joint == _ALL else (joint,))


def calibration_questions() -> Sequence[Question]:
    """Port, arm, name, and where 0 rad is."""
    return (
        port_question(),
        Question("leader", "It is a leader arm, which is moved by hand", False),
        Question("name", f"Name of the calibration; empty for {_FOLLOWER}, or {_LEADER} of a leader arm"),
        Question("zero_at", "Position of 0 rad", next(iter(ZERO_AT)), tuple(ZERO_AT)),
        Question("auto", "The motors find the ends at low torque; never tried on real servos", False),
    )


def calibrate(answers: Answered, guide: Guide) -> None:
    """Calibrate an arm."""
    calibrate_arm(
        guide, _port(answers), _name(answers), leader=bool(answers["leader"]), zero_at=str(answers["zero_at"]),
        torque=TORQUE if answers.get("auto") else None,
    )  # fmt: skip


def check_questions() -> Sequence[Question]:
    """Port and calibration."""
    return (
        port_question(),
        Question("name", "Name of the calibration", _FOLLOWER, (_FOLLOWER, _LEADER), open=True),
        Question("write", "Write the file's values to servos that differ", False),
        Question("signs", "Turn each joint by hand, to compare its direction", False),
    )


def check(answers: Answered, guide: Guide) -> None:
    """Compare the servos with their calibration."""
    if not check_arm(
        guide, _port(answers), _name(answers), write=bool(answers["write"]), signs=bool(answers.get("signs"))
    ):
        raise HardwareError("the servos do not match the calibration")


def compare_questions() -> Sequence[Question]:
    """Ports and calibrations."""
    arms = port_question().choices
    return (
        Question("port", "Port of the follower", "", arms, open=True),
        Question("leader_port", "Port of the leader", "", arms, open=True),
        Question("name", "Calibration of the follower", _FOLLOWER, (_FOLLOWER,), open=True),
        Question("leader_name", "Calibration of the leader", _LEADER, (_LEADER,), open=True),
    )


def compare(answers: Answered, guide: Guide) -> None:
    """Compare leader and follower."""
    leader_port = str(answers["leader_port"]).strip()
    if not leader_port:
        raise HardwareError("give the port of the leader")
    leader = _name({"name": answers["leader_name"], "leader": True})
    if not compare_arms(guide, _port(answers), leader_port, _name(answers), leader):
        raise HardwareError("leader and follower do not match")


def _port(answers: Answered) -> str | None:
    return str(answers["port"]).strip() or None


def _name(answers: Answered) -> str:
    given = str(answers["name"]).strip()
    if "/" in given or given.endswith(".json"):
        raise HardwareError(f"calibration {given!r}: give a name, not a path, e.g. {_FOLLOWER}")
    return given or (_LEADER if answers.get("leader") else _FOLLOWER)
