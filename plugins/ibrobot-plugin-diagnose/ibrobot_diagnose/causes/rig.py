"""Causes in the rig at rest, compared with a reference of it: rates, calibration, zeros, leaders, servos, versions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, override

import numpy as np
from ibrobot_calibration.plausibility import oddities

from ibrobot_core.api import Contract, IbrobotError
from ibrobot_diagnose.card import Card
from ibrobot_diagnose.cause import CardCause, Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.causes.moved import Sight, sights
from ibrobot_diagnose.rig import Rig, RigCamera
from ibrobot_diagnose.window import Limits, Window, grips

_OF_RIG = frozenset({"rig", "rig card"})
_DEGREES_PER_TICK = 360.0 / 4096
_TICKS = ("homing_offset", "range_min", "range_max")
_SAME_DEGREES = 1.0
"""Difference of readings below which they count as the same."""


def name_of(key: str) -> str:
    """Name of a camera, from the key of its observation."""
    return key.rpartition(".")[2]


class RigCause(CardCause):
    """A cause that compares a rig at rest with the one in the card."""

    needs = _OF_RIG

    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        """As `test`, with both rigs."""
        raise NotImplementedError

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        assert window.rig is not None
        assert card.rig is not None
        return self.compare_rigs(window.rig, card.rig)


class OtherRobot(RigCause):
    """The reference is of another robot."""

    name, title = "other_robot", "the reference is of this robot"
    explains = frozenset({"other_contract", "other_calibration", "camera_missing"})
    remedy = "Compare with a reference of this robot: `ibrobot preflight ROBOT --take FILE` takes one."

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        differs = sorted(set(now.joints) ^ set(then.joints))
        if differs:
            text = f"The reference is of {_called(then)} with other joints: {', '.join(differs)}."
        elif now.joints != then.joints:
            text = f"The reference has the joints in another order: {', '.join(then.joints)}."
        elif then.robot and now.robot != then.robot:
            text = f"The reference is of {_called(then)}, and this is {now.robot}."
        else:
            return Evidence(f"The reference is of {_called(now)}.", 0.0, "differences", 1.0, 0.0, fails=2.0)
        number = 2.0 if differs else 1.0
        return Evidence(text, number, "differences", 1.0, likelihood(number, 0.5, 2.0), fails=2.0)


def _called(rig: Rig) -> str:
    return rig.robot or "a robot without a name"


class CameraUnknown(RigCause):
    """A camera is not in the reference."""

    name, title = "camera_unknown", "every camera is in the reference"
    remedy = "Take a reference with it: `ibrobot preflight ROBOT --take FILE`."

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        unknown = [name_of(key) for key in now.cameras if key not in then.cameras]
        number = float(len(unknown))
        if not unknown:
            return Evidence("The reference has every camera.", number, "cameras", 1.0, 0.0)
        unclear = f"{', '.join(unknown)}: not in the reference, so nothing says whether what it shows is as it was"
        return Evidence(unclear, number, "cameras", 1.0, 0.0, unclear=unclear)


class CameraMissing(RigCause):
    """A camera of the reference does not deliver pictures."""

    name, title = "camera_missing", "every camera of the reference delivers pictures"
    remedy = (
        "Plug the camera in, and choose it in the robot YAML by its name below /dev/v4l/by-id or by-path; "
        "`ibrobot camera list` shows which are there."
    )

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        missing = [name_of(key) for key in then.cameras if key not in now.cameras]
        why = "; ".join(f"{name}: {reason}" for name, reason in now.absent.items())
        if missing:
            text = f"{', '.join(missing)} of the reference deliver{'s' * (len(missing) == 1)} no picture. {why}".strip()
        else:
            text = f"All cameras of the reference deliver pictures: {len(then.cameras)}."
        number = float(len(missing))
        return Evidence(text, number, "cameras", 1.0, likelihood(number, 0.5, 1.0), fails=1.0)


class OtherResolution(RigCause):
    """A camera delivers pictures of another size."""

    name, title = "other_resolution", "pictures have the size of the reference"
    remedy = "Give the camera its `width` and `height` of the reference in the robot YAML."
    explains = frozenset({"camera_moved", "picture_blurred", "unseen_pictures"})

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        changed = [
            f"{name_of(key)} has {_size(now.cameras[key])} pixels, in the reference {_size(camera)}"
            for key, camera in then.cameras.items()
            if key in now.cameras and now.cameras[key].size != camera.size
        ]
        text = f"{'; '.join(changed)}." if changed else "All pictures have the size of the reference."
        return Evidence(text, float(len(changed)), "cameras", 1.0, likelihood(len(changed), 0.5, 1.0), fails=1.0)


def _size(camera: RigCamera) -> str:
    return f"{camera.size[1]} x {camera.size[0]}"


class CameraSlow(RigCause):
    """A camera delivers fewer pictures."""

    name, title = "camera_slow", "cameras deliver pictures at the rate of the reference"
    remedy = (
        "Give the camera a USB port of its own and `fourcc: MJPG`; a fixed exposure, too: in dim light an automatic "
        "one halves the rate."
    )

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        rates = [
            (100 * (1 - own / known), f"{name_of(key)} delivers {own:.1f} pictures/s, in the reference {known:.1f}")
            for key, camera in then.cameras.items()
            if key in now.cameras and (own := now.cameras[key].rate_hz) and (known := camera.rate_hz)
        ]
        if not rates:
            return None
        slower, text = max(rates)
        lost = max(slower, 0.0)
        details = tuple(each for _, each in sorted(rates, reverse=True)[1:])
        return Evidence(f"{text}.", lost, "%", 10.0, likelihood(lost, 10.0, 30.0), details=details, fails=25.0)


class LoopSlow(Cause):
    """The control loop does not keep its rate."""

    name, title = "loop_slow", "the control loop keeps its rate"
    needs = frozenset({"rig"})
    explains = frozenset({"ticks_missed"})
    remedy = (
        "Close what loads the machine, and give the control process its permissions: `ibrobot doctor`. On a bus of "
        "servos a hub, a long cable or a small baud rate slows it, too."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        now = window.rig
        then = reference.card.rig if reference.card is not None else None
        assert now is not None
        if now.loop_hz is None:
            return None
        known = now.asked_hz or 0.0
        wanted = f"the robot YAML asks for {known:.0f}"
        if then is not None and then.loop_hz is not None and then.loop_hz > known:
            known, wanted = then.loop_hz, f"in the reference {then.loop_hz:.1f}"
        if known <= 0:
            return None
        lost = max(0.0, 100 * (1 - now.loop_hz / known))
        text = f"Joint states come {now.loop_hz:.1f} times a second; {wanted}."
        return Evidence(text, lost, "%", 5.0, likelihood(lost, 5.0, 15.0), fails=15.0)


class CameraOptions(RigCause):
    """A camera has other options."""

    name, title = "camera_options", "cameras have the options of the reference"
    explains = frozenset({"picture_dark", "picture_bright", "white_balance"})
    remedy = "Give the cameras the options of the reference again, or take a new reference on purpose."

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        changed = [
            f"{name_of(key)}: {option} is {own.get(option)!r}, was {camera.settings.get(option)!r}"
            for key, camera in then.cameras.items()
            if key in now.cameras and (own := now.cameras[key].settings) is not None
            for option in sorted({*camera.settings, *own})
            if camera.settings.get(option) != own.get(option)
        ]
        text = f"Options of cameras differ: {'; '.join(changed)}." if changed else "Cameras have the same options."
        return Evidence(text, float(len(changed)), "options", 1.0, likelihood(len(changed), 0.5, 40.0))


def _changes(now: Mapping[str, Any], then: Mapping[str, Any]) -> Iterator[tuple[float, str]]:
    """How far the zero of each joint has moved [degrees], or 360 for another servo, and in words."""
    for joint, old in then.items():
        new = now.get(joint)
        if new is None:
            yield 360.0, f"{joint} has no calibration now"
        elif new.get("id") != old.get("id"):
            yield 360.0, f"{joint} is servo {new.get('id')}, was {old.get('id')}"
        else:
            moved = [
                float(new.get(each, 0)) - float(old.get(each, 0))
                for each in ("homing_offset", "range_min", "range_max")
            ]
            worst = max(moved, key=abs)
            if worst or new.get("drive_mode") != old.get("drive_mode") or new.get("zero_at") != old.get("zero_at"):
                yield abs(worst) * _DEGREES_PER_TICK, f"{joint} differs by {worst * _DEGREES_PER_TICK:+.1f}°"


class OtherCalibration(RigCause):
    """The arm has another calibration, or other servos."""

    name, title = "other_calibration", "the arm has the calibration of the reference"
    explains = frozenset({"zero_shifted", "other_gripper"})
    remedy = (
        "Use the calibration of the reference (`hardware: {calibration: …}`). After a new calibration, take a new "
        "reference, and know that data and models from before have other zeros."
    )

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        if not then.calibration and not now.calibration:
            return None
        joined = [
            each
            for name, joints in then.calibration.items()
            for each in _changes(now.calibration.get(name, {}), joints)
        ]
        worst = max((degrees for degrees, _ in joined), default=0.0)
        text = f"The calibration differs: {'; '.join(each for _, each in joined)}." if joined else "It is the same one."
        return Evidence(text, worst, "degrees", 0.5, likelihood(worst, 0.5, 2.0), fails=2.0)


class CalibrationOdd(Cause):
    """A calibration has numbers that no servo stores, a range past the encoder's end, or another joint's range."""

    name, title = "calibration_odd", "the calibration has offsets that servos store, and the ranges of the joints"
    needs = frozenset({"rig"})
    explains = frozenset({"zero_shifted"})
    remedy = (
        "Calibrate the joint again: begin in the middle of its range, and move it from stop to stop. If its range "
        "still passes the end of the encoder, turn the servo's horn by half a turn and mount it again."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        assert window.rig is not None
        limits = dict(zip(window.joints, window.limits, strict=True))
        odd = tuple(
            fault
            for joints in window.rig.calibration.values()
            for joint, numbers in joints.items()
            for fault in oddities(joint, numbers, _ends(limits.get(joint)))
        )
        if not window.rig.calibration:
            return None
        text = f"The calibration is odd: {odd[0]}." if odd else "The calibration has usual numbers."
        return Evidence(text, float(len(odd)), "joints", 1.0, 0.7 if odd else 0.0, details=odd[1:])


def _ends(limits: Limits | None) -> tuple[float, float] | None:
    if limits is None or not np.isfinite((limits.lower, limits.upper)).all():
        return None
    return limits.lower, limits.upper


class OtherGripper(RigCause):
    """The gripper has another range."""

    name, title = "other_gripper", "the gripper has the range of the reference"
    remedy = "Mount the gripper of the reference, or calibrate and record with the new one: a policy knows the old one."

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        worst: tuple[float, str] | None = None
        for name, joints in then.calibration.items():
            for joint, old in joints.items():
                new = now.calibration.get(name, {}).get(joint)
                if grips(joint) and new is not None:
                    own, known = (float(each["range_max"]) - float(each["range_min"]) for each in (new, old))
                    off = 100 * abs(own / known - 1) if known else 0.0
                    text = f"{joint} has a range of {own:.0f} ticks, in the reference {known:.0f}."
                    worst = max(worst or (off, text), (off, text))
        if worst is None:
            return None
        return Evidence(worst[1], worst[0], "%", 8.0, likelihood(worst[0], 8.0, 20.0), fails=15.0)


class ZeroShifted(CardCause):
    """The arm is not where its readings say."""

    name, title = "zero_shifted", "the arm is where its readings say"
    needs = _OF_RIG | {"pictures"}
    remedy = (
        "Look at this joint's horn and screws. Put the arm into the pose of the reference, and compare the readings; "
        "then calibrate again if the servo has lost its zero."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        assert window.rig is not None
        assert card.rig is not None
        if window.rig.joints != card.rig.joints:
            return None
        seen = [each for each in sights(window.rig, card.rig) if each.turned is not None]
        if not seen:
            return None
        best = max(seen, key=lambda each: each.arm_rich)
        return _zero(best, window.rig.joints)


def _zero(sight: Sight, joints: tuple[str, ...]) -> Evidence:
    turned = sight.turned
    assert turned is not None
    j = int(np.argmax(np.abs(turned)))
    degrees = float(np.degrees(np.abs(turned[j])))
    where = f"in the picture of {sight.name}"
    unclear = ""
    if not sight.stays:
        unclear = f"{sight.name} does not surely stand where it stood"
    elif sight.arm_rich < 3:
        unclear = f"the arm is hardly to be seen {where}"
    elif degrees < _SAME_DEGREES and sight.arm_found >= 0.5 * sight.arm_rich:
        text = f"The arm is where its readings say: {where} {sight.arm_found} of {sight.arm_rich} areas of it agree."
        return Evidence(text, degrees, "degrees", 1.5, 0.0, fails=5.0)
    elif degrees < _SAME_DEGREES and sight.arm_found < 0.3 * sight.arm_rich:
        text = (
            f"The readings are those of the reference, but {where} the arm is elsewhere: only {sight.arm_found} of "
            f"{sight.arm_rich} areas of it agree. The zero of a joint is shifted, or its horn has slipped."
        )
        return Evidence(text, 5.0, "degrees", 1.5, 0.9, fails=5.0)
    elif degrees >= 1.5 and sight.arm_found >= 0.7 * sight.arm_rich:
        text = (
            f"The zero of {joints[j]} is shifted by {np.degrees(turned[j]):+.1f}°: {where} the arm is where it was, "
            "but its readings are others."
        )
        return Evidence(text, degrees, "degrees", 1.5, likelihood(degrees, 1.5, 5.0), fails=5.0)
    else:
        unclear = (
            f"the arm stands elsewhere than in the reference, {joints[j]} by {degrees:.0f}°: put it into that pose to "
            "compare its readings"
        )
    return Evidence(unclear, degrees, "degrees", 1.5, 0.0, fails=5.0, unclear=unclear)


class LeaderApart(RigCause):
    """Leader and follower are apart as they were not."""

    name, title = "leader_apart", "leader and follower stand to each other as in the reference"
    remedy = (
        "Put both arms into the same pose, and compare joint by joint: `ibrobot feetech check`. A horn that has "
        "slipped, or a calibration of one of them, has shifted a zero."
    )

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        apart = [
            (abs(float(np.degrees(own - known))), device, joint, own, known)
            for device, joints in then.leaders.items()
            for joint, known in joints.items()
            if (own := now.leaders.get(device, {}).get(joint)) is not None
        ]
        missing = [device for device in then.leaders if device not in now.leaders]
        if not apart:
            why = f"{', '.join(missing)} of the reference cannot be read. {' '.join(now.notes)}".strip()
            return Evidence(why, 0.0, "degrees", 3.0, 0.0, fails=8.0, unclear=why) if missing else None
        off, device, joint, own, known = max(apart)
        text = (
            f"{device}: {joint} is {np.degrees(own):+.1f}° from the robot at rest, in the reference "
            f"{np.degrees(known):+.1f}°."
        )
        # Of arms that stand elsewhere, most joints differ; a zero that has slipped is one of them.
        elsewhere = sum(degrees > 8.0 for degrees, of, *_ in apart if of == device) > 2
        unclear = f"{device} or the robot stands elsewhere: put both arms into the pose of the reference"
        details = tuple(f"{of}: {name} {degrees:.1f}°" for degrees, of, name, *_ in sorted(apart, reverse=True)[1:4])
        if elsewhere:
            return Evidence(unclear, off, "degrees", 3.0, 0.0, details=details, fails=8.0, unclear=unclear)
        return Evidence(text, off, "degrees", 3.0, likelihood(off, 3.0, 8.0), details=details, fails=8.0)


class JointsUnwell(Cause):
    """Servos report abnormal conditions."""

    name, title = "joints_unwell", "there is no fault, and no servo is hot, overloaded or short of voltage"
    needs = frozenset({"rig"})
    explains = frozenset({"loop_slow"})
    remedy = (
        "Do what the lines say: let the arm rest, check the power supply and its cables, free a joint that is blocked."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        assert window.rig is not None
        conditions = window.rig.conditions
        faults = [each for each in conditions if str(each.get("severity", "")).lower().endswith("fault")]
        lines = tuple(str(each.get("message", "")) for each in conditions)
        text = lines[0] if lines else "No servo reports an abnormal condition."
        number = float(2 * len(faults) + (len(conditions) - len(faults)))
        likely = likelihood(number, 0.5, 1.0) if faults else 0.7 if conditions else 0.0
        return Evidence(text, number, "conditions", 1.0, likely, details=lines[1:])


class OtherContract(RigCause):
    """Observations and actions are others."""

    name, title = "other_contract", "observations and actions are those of the reference"
    remedy = "Use the contract of the reference: a policy or dataset of one contract does not fit another."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        try:
            known = Contract.from_canonical(card.contract)
            changed = window.contract.difference(known, ("now", "then")).splitlines()
        except (IbrobotError, KeyError, TypeError, ValueError) as error:  # of a card from anywhere
            changed = [f"that of the reference cannot be read: {error!r}"]
        rows = [line for line in changed if not line.startswith(" ")]
        text = (
            f"The contract differs in {', '.join(rows[:4])}." if changed else "The contract is that of the reference."
        )
        number = float(len(rows))
        return Evidence(text, number, "differences", 1.0, 0.7 if rows else 0.0, details=tuple(changed))


class OtherVersions(RigCause):
    """Packages have other versions."""

    name, title = "other_versions", "packages have the versions of the reference"
    remedy = "Know of it: if all else is equal, the difference may be there. Install those of the reference to see."

    @override
    def compare_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        if not then.versions:
            return None
        changed = [
            f"{name} {now.versions.get(name, 'is not installed')}, was {version}"
            for name, version in then.versions.items()
            if now.versions.get(name) != version
        ]
        text = f"Versions differ: {'; '.join(changed[:4])}." if changed else "All packages have their versions."
        return Evidence(text, float(len(changed)), "packages", 1.0, 0.6 if changed else 0.0, details=tuple(changed[4:]))


CAUSES: tuple[type[Cause], ...] = (
    OtherRobot, CameraMissing, CameraUnknown, OtherResolution, CameraSlow, CameraOptions, LoopSlow, OtherCalibration,
    CalibrationOdd, OtherGripper, ZeroShifted, LeaderApart, JointsUnwell, OtherContract, OtherVersions,
)  # fmt: skip
