"""`ibrobot feetech calibrate`: measures each joint's middle and range, and saves them in a file and in the servos."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import attrs
from ibrobot_calibration import Calibration, JointCalibration, calibration_path
from ibrobot_terminal import Guide
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import HardwareError, IbrobotError, option
from ibrobot_feetech.arm import calibrated_registers, relax, write_eprom
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.calibration import ZERO_AT, save_calibration
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.find_stops import TORQUE, UNTRIED, StopFinder, missing_servos, offsets_of
from ibrobot_feetech.commands.joints import Joint, by_servo, joints_of
from ibrobot_feetech.commands.measure import Answers, Measurement, as_calibration
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.commands.zero import zero_text
from ibrobot_feetech.usb import usb_port

FULL_TURN = ("wrist_roll",)
"""Joints of an SO-101 that can make a full turn."""


@attrs.frozen(kw_only=True)
class Calibrate(OnPort):
    """Calibrate an arm, moving its joints by hand.

    Put it in its middle pose, then move each joint to both ends of its range.

    Nothing is written to the servos or to disk before everything is measured.

    With --auto the motors find the ends at low torque, one joint after the other, and whatever ends it restores the
    servos. This was tried on the emulator alone, never on real servos.
    """

    name: str | None = option(
        None, help="name of the calibration, or a path; by default so101_follower, or so101_leader"
    )
    leader: bool = option(
        False, help="a leader arm, whose gripper has a different range; default if --name ends in leader"
    )
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    arm: str | None = option(None, help="name of the arm, for the records; by default the adapter's serial number")
    full_turn: tuple[str, ...] = option(FULL_TURN, help="joint that can make a full turn")
    zero_at: str = option(
        "pose",
        choices=tuple(ZERO_AT),
        help="0 rad: the middle pose, set by hand, or the middle of each range, as in LeRobot",
    )
    prefix: str = option("", help="prefix of the joints' names, e.g. left_ for one of two arms")
    check_signs: bool = option(False, help="ask to turn each joint in its positive direction")
    middle_now: bool = option(False, help="the arm is in its middle pose: do not ask")
    range_seconds: float | None = option(None, ge=0.1, help="measure the ranges for this long, not until Enter")
    accept_ranges: bool = option(False, help="accept ranges that differ from the joints' limits")
    auto: bool = option(False, help="find the ends by motor, at low torque; never tried on real servos")
    torque: float = option(TORQUE, ge=0.05, le=0.5, help="with --auto, share of the full torque that no servo exceeds")
    yes: bool = option(False, help="switch torque off and overwrite without asking; the old file is kept")

    def __call__(self) -> None:
        name = self.name or ("so101_leader" if self.leader else "so101_follower")
        calibrate_arm(
            TerminalGuide(), self.port, name, leader=self.leader or name.endswith("leader"), robot=self.robot,
            arm=self.arm, full_turn=self.full_turn, zero_at=self.zero_at, prefix=self.prefix, yes=self.yes,
            answers=Answers(self.middle_now, self.range_seconds, self.accept_ranges, self.check_signs),
            torque=self.torque if self.auto else None,
        )  # fmt: skip


def calibrate_arm(
    guide: Guide, port: str | None, name: str, *, leader: bool = False, robot: str | None = None,
    arm: str | None = None, full_turn: Sequence[str] = FULL_TURN, zero_at: str = "pose", prefix: str = "",
    yes: bool = False, answers: Answers | None = None, torque: float | None = None,
) -> None:  # fmt: skip
    """Calibrate an arm with an operator; the arguments are those of the command.

    With `torque`, the motors find the ends of the ranges, with at most this share of their torque.

    Raises:
        CalibrationError: if the measured values are impossible.
        Declined: if the operator does not go on.
        HardwareError: if a servo does not answer, or is in another mode.
    """
    joints = joints_of(robot, name, prefix)
    path = calibration_path(name)
    if path.exists() and not yes and not guide.confirm(f"{path} exists already. Calibrate again?", flag="--yes"):
        raise Declined
    compared = [joint.name for joint in joints if not (leader and joint.anchored)]
    turning = [
        joint.name for joint in joints if joint.name in full_turn or joint.name.removeprefix(prefix) in full_turn
    ]
    answers = answers or Answers()
    with opened(port, joints=by_servo(joints)) as bus:
        if torque is not None:
            measured = measure_by_motor(
                bus, guide, joints, full_turn=turning, compared=compared, zero_at=zero_at, torque=torque, yes=yes,
                answers=answers,
            )  # fmt: skip
        else:
            _prepare(bus, guide, yes)
            try:
                measured = Measurement(
                    bus, guide, joints, full_turn=turning, compared=compared, zero_at=zero_at, answers=answers
                ).run()
            except BaseException:
                unchanged = "Nothing was written. The torque is off, and the servos' calibration is unchanged."
                guide.say(unchanged, warning=True)
                raise
        usb = usb_port(bus.port.path)
        adapter = usb.serial_number if usb is not None else ""
        date = datetime.now(UTC).isoformat(timespec="seconds")
        if kept := backup(path):
            guide.say(f"the old file is kept: {kept}")
        made = Calibration(measured, robot=arm or adapter or Path(name).stem, date=date, adapter=adapter)
        save_calibration(made, path, overwrite=True)
        guide.say(f"saved: {path}")
        guide.say(zero_text(made))
        _write(bus, guide, measured, name)
    guide.say(f"written to servos {', '.join(str(joint.servo) for joint in joints)}")


def measure_by_motor(
    bus: FeetechBus, guide: Guide, joints: Sequence[Joint], *, full_turn: Sequence[str], compared: Sequence[str],
    zero_at: str, torque: float, yes: bool, answers: Answers, clock: Callable[[], float] = time.monotonic,
) -> dict[str, JointCalibration]:  # fmt: skip
    """Measure an arm by its motors; the servos are as they were when it ends.

    Raises:
        CalibrationError: if what was found cannot be the joints' ranges.
        Declined: if the operator does not go on, or stops the arm.
        HardwareError: if a servo does not answer or obey, or is not well.
    """
    guide.say(UNTRIED, warning=True)
    if not yes and not guide.confirm(
        f"No servo will exceed {100 * torque:.0f} % of its torque. Find the stops?", flag="--yes"
    ):
        raise Declined
    missing_servos(bus, joints)
    finder = StopFinder(
        bus, guide, joints, measured=[joint for joint in joints if joint.name not in full_turn], compared=compared,
        zero_at=zero_at, torque=torque, asks=not yes, signs=answers.check_signs, clock=clock,
    )  # fmt: skip
    try:
        with finder.restoring():
            _prepare(bus, guide, yes)
            if not answers.middle_now:
                guide.wait("Put the arm into its middle pose, standing upright.", flag="--middle-now")
            offsets = offsets_of(bus, joints)
            finder.begin(offsets)
            ranges, inverted = finder.run()
    except BaseException:
        restored = "" if finder.unrestored else " The servos have the registers and the torque that they had."
        guide.say(f"Nothing was saved.{restored}", warning=True)
        raise
    return as_calibration(joints, offsets, ranges, inverted, zero_at)


def backup(path: Path) -> Path | None:
    """Copy an existing calibration to a name with its date, and return that."""
    if not path.exists():
        return None
    date = datetime.fromtimestamp(path.stat().st_mtime, UTC).strftime("%Y%m%dT%H%M%SZ")
    for suffix in (".json", ".meta.json"):
        former = path.with_suffix(suffix)
        if former.exists():
            shutil.copy2(former, path.with_name(f"{path.stem}.{date}{suffix}"))
    return path.with_name(f"{path.stem}.{date}.json")


def _prepare(bus: FeetechBus, guide: Guide, yes: bool) -> None:
    """Check that every servo answers and is in position mode, and switch its torque off."""
    servos = list(bus.joints)
    for servo in servos:
        if (mode := bus.read(servo, "operating_mode")) != 0:
            raise HardwareError(
                f"{bus.place(servo, 'operating_mode')}: it is {mode} and must be 0 (position); "
                f"`ibrobot feetech setup-motors --joint {bus.joints[servo]}` sets it"
            )
    if any(bus.sync_read("torque_enable", servos).values()) and not yes:
        guide.say("The torque will be switched off, and the arm will fall: hold it.")
        if not guide.confirm("Go on?", flag="--yes", default=True):
            raise Declined
    relax(bus, servos)


def _write(bus: FeetechBus, guide: Guide, measured: dict[str, JointCalibration], name: str) -> None:
    done: list[str] = []
    try:
        for joint, numbers in measured.items():
            write_eprom(bus, numbers.id, calibrated_registers(numbers))
            done.append(joint)
    except (IbrobotError, KeyboardInterrupt):
        left = ", ".join(joint for joint in measured if joint not in done)
        guide.say(
            f"The file is saved, but not all servos have it (not: {left}). "
            f"`ibrobot feetech check {bus.port.path} --name {name} --write` writes the rest.",
            warning=True,
        )
        raise
