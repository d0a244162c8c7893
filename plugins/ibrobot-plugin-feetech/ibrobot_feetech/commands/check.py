"""`ibrobot feetech check`: compares the servos with their calibration file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
from ibrobot_calibration import Calibration, load_calibration
from ibrobot_terminal import Guide
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import option
from ibrobot_core.app import Unsuccessful
from ibrobot_feetech.arm import calibrated_registers, relax, write_eprom
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, arm_of, joints_of
from ibrobot_feetech.commands.measure import turned_by_hand
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.commands.zero import zero_text
from ibrobot_feetech.errors import NoReply
from ibrobot_feetech.options import TOOL, FollowerOptions
from ibrobot_feetech.registers import MODEL_STS3215
from ibrobot_feetech.supply import supply
from ibrobot_feetech.usb import check_adapter

_TUNING = ("p_coefficient", "i_coefficient", "d_coefficient")


@attrs.frozen
class Difference:
    """A register whose value differs from the expected one."""

    joint: str
    servo: int
    register: str
    found: str
    wanted: str
    remedy: str
    """Remedy; empty if `--write` fixes it."""
    matters: bool = True


@attrs.frozen(kw_only=True)
class CheckArm(OnPort):
    """Compare the servos with a calibration. If they differ, print a table and exit with 1."""

    name: str = option("so101_follower", help="name of the calibration, or a path")
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    write: bool = option(False, help="write the file's values to servos that differ; switches their torque off")
    check_signs: bool = option(False, help="ask to turn each joint in its positive direction, and compare")
    yes: bool = option(False, help="write without asking")

    def __call__(self) -> None:
        if not check_arm(
            TerminalGuide(), self.port, self.name, robot=self.robot, write=self.write, signs=self.check_signs,
            yes=self.yes,
        ):  # fmt: skip
            raise Unsuccessful


def check_arm(
    guide: Guide, port: str | None, name: str, *, robot: str | None = None, write: bool = False, signs: bool = False,
    yes: bool = False,
) -> bool:  # fmt: skip
    """Compare the servos with a calibration, and return whether they match; the arguments are those of the command.

    Raises:
        CalibrationError: if the calibration cannot be read.
        Declined: if the operator does not let it write.
        HardwareError: if a servo answers wrongly, or the port is gone.
    """
    joints = joints_of(robot, name)
    calibration = load_calibration(name, [joint.name for joint in joints], tool=TOOL, device=port or "")
    guide.say(
        f"{calibration.path}: arm {calibration.robot or 'unnamed'}, made {calibration.date or 'at an unknown time'}"
    )
    guide.say(zero_text(calibration))
    for odd in odd_ranges(
        calibration, joints, leader=calibration.path is not None and calibration.path.stem.endswith("leader")
    ):
        guide.say(f"warning: {odd}", warning=True)
    with opened(port, joints={joint.id: each for each, joint in calibration.joints.items()}) as bus:
        check_adapter(calibration, bus.port.path)
        differing = list(differences(bus, calibration))
        if write and (wrong := [each for each in differing if not each.remedy]):
            _print(guide, differing)
            servos = sorted({each.servo for each in wrong})
            guide.say("The torque of these servos will be switched off, and the arm may fall: hold it.")
            if not (yes or guide.confirm(f"Write to servos {', '.join(map(str, servos))}?", flag="--yes")):
                raise Declined
            for servo in servos:
                write_eprom(bus, servo, {each.register: int(each.wanted) for each in wrong if each.servo == servo})
            differing = list(differences(bus, calibration))
        reversed_ = list(_reversed(bus, guide, joints, calibration, yes=yes)) if signs else []
    for text in reversed_:
        guide.say(f"error: {text}", warning=True)
    if differing:
        _print(guide, differing)
    if reversed_ or any(each.matters for each in differing):
        return False
    guide.say(f"{counted(len(calibration.joints), 'servo')} as in the calibration")
    return True


def odd_ranges(calibration: Calibration, joints: Sequence[Joint], *, leader: bool = False) -> Iterator[str]:
    """What is odd about a calibration; the gripper of a leader is not compared, since its range is another one."""
    limits = {joint.name: (joint.lower, joint.upper) for joint in joints if not (leader and joint.anchored)}
    return arm_of(joints, calibration).oddities(limits)


def _reversed(
    bus: FeetechBus, guide: Guide, joints: Sequence[Joint], calibration: Calibration, *, yes: bool
) -> Iterator[str]:
    """Ask to turn each joint, whose torque is switched off, and compare the direction with the file."""
    guide.say("The torque will be switched off, and the arm will fall: hold it.")
    if not (yes or guide.confirm("Go on?", flag="--yes", default=True)):
        raise Declined
    relax(bus, [calibration.joints[joint.name].id for joint in joints])
    for joint in joints:
        numbers = calibration.joints[joint.name]
        turned = turned_by_hand(bus, guide, joint.name, numbers.id)
        if (turned < 0) != numbers.inverted:
            yield (
                f"{joint.name}: it turned by {turned:+d} ticks in its positive direction, and drive_mode "
                f"{numbers.drive_mode} in the file means {'fewer' if numbers.inverted else 'more'}: it is reversed; "
                "`ibrobot feetech calibrate` with --check-signs measures the directions again"
            )


def differences(bus: FeetechBus, calibration: Calibration) -> Iterator[Difference]:
    """Yield all differences, servo by servo.

    Raises:
        FeetechError: if a servo answers wrongly, or the port is gone.
    """
    options = attrs.fields_dict(FollowerOptions)
    versions: dict[str, str] = {}
    for joint, numbers in calibration.joints.items():
        servo = numbers.id
        try:
            model = bus.read_faulty(servo, "model_number")
        except NoReply:
            yield Difference(joint, servo, "", "no reply", "", "check power, cable, id")
            continue
        if model != MODEL_STS3215:
            yield Difference(joint, servo, "model_number", str(model), str(MODEL_STS3215), "is it the right arm?")
        power = supply(bus, servo)
        if not power.fits:
            measured = f"{power.measured:.1f} V"
            yield Difference(joint, servo, "present_voltage", measured, power.limits, power.remedy)
        versions[joint] = bus.firmware(servo)
        for register, value in {**calibrated_registers(numbers), "operating_mode": 0}.items():
            if (stored := bus.read_faulty(servo, register)) != value:
                yield Difference(joint, servo, register, str(stored), str(value), "")
        for register in _TUNING:
            if (stored := bus.read_faulty(servo, register)) != options[register].default:
                default = str(options[register].default)
                yield Difference(joint, servo, register, str(stored), default, "set at each start", matters=False)
    common = max(versions.values(), key=list(versions.values()).count, default="")
    for joint, version in versions.items():
        if version != common:
            servo = calibration.joints[joint].id
            yield Difference(joint, servo, "firmware", version, common, "update the older servos")


def _print(guide: Guide, wrong: list[Difference]) -> None:
    rows = [
        (str(each.servo), each.joint, each.register, each.found, each.wanted, each.remedy or "--write")
        for each in wrong
    ]
    guide.show((">id", "joint", "register", ">servo", ">file", "remedy"), rows)
