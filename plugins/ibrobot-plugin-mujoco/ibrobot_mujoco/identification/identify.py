"""The identification: fits, held-out errors, findings, and the file of parameters."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_mujoco.identification.baseline import fit_baseline
from ibrobot_mujoco.identification.findings import Finding, findings_of, unknown_of
from ibrobot_mujoco.identification.fit import FIRST_S, Fitted, best_start, error_of, fit, refit, rms, some
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.identification.simulation import FedArm, seconds_of
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, Identification, JointParameters

BEFORE, BASELINE, AFTER = "before", "delay_lag_bias", "after"
_PUBLISHED = JointParameters(kp=8.902, damping=0.608, frictionloss=0.0524, armature=0.0284, torque_limit=3.352)
"""An STS3215 at 7.4 V with P = 16; see `servos/so101_sts3215.yaml`."""
_HELD_OUT = 4
"""One part of so many is held out."""
_MOST_THREADS = 4
_WORSE, _RESOLUTION_RAD = 1.1, 5e-4
"""A fit is worse than another from this factor, and this difference: what an encoder with 4,096 steps adds [rad]."""
_SHOWN_S = 15.0
"""Duration of the course in the report [s]."""

type Tell = Callable[[str, float], None]
"""Receives what begins, and about which share of the work is done."""


@attrs.frozen(eq=False)
class Course:
    """A held-out stretch: what was commanded and measured, and where both simulations were [rad], shape (N, J) each."""

    times: Vector
    command: Vector
    measured: Vector
    before: Vector
    after: Vector


@attrs.frozen(eq=False)
class Result:
    """An identified arm."""

    robot: Robot
    seconds: float
    fitted: Fitted
    parameters: ArmParameters
    """What is written."""
    errors: Mapping[str, Vector]
    """Model -> rms error of each joint on what was held out [rad], shape (J,)."""
    totals: Mapping[str, float]
    """Model -> rms error over all joints [rad]."""
    rotations: Sequence[Mapping[str, float]]
    """The same for each rotation."""
    course: Course
    findings: Sequence[Finding]
    unknown: Sequence[tuple[str, str]]
    unlike: Sequence[str] = ()
    """The joints that it follows less well than the simulation before, or than delay, lag and bias alone; all if
    that is so over all."""

    def lines(self) -> list[str]:
        """The result for a terminal."""
        totals = {name: np.rad2deg(value) for name, value in self.totals.items()}
        gain = totals[BEFORE] / max(totals[AFTER], 1e-9)
        lines = [
            "On recordings that the fit has not seen, the simulated arm is "
            f"{totals[AFTER]:.2f} deg rms off the real one. Before it was {totals[BEFORE]:.2f} deg ({gain:.1f} times "
            f"as far), and with delay, lag and bias alone it would be {totals[BASELINE]:.2f} deg.",
            *(each.text for each in self.findings),
        ]
        if self.unlike:
            what, whose, more = ", ".join(self.unlike), "these", ""
            if _unlike(self.totals):
                what, whose, more = "the arm", "all", ", and are not worth using"
            lines.append(
                f"The identified simulation follows {what} less well than the one before, or delay, lag and bias "
                f"alone: the parameters of {whose} joints count as unknown{more}."
            )
        lines += [f"Unknown: {what}. To find it, {how}." for what, how in self.unknown]
        return lines

    def facts(self) -> dict[str, Any]:
        """The result as plain values."""
        return {
            "robot": self.robot.name, "seconds": round(self.seconds, 2), "lines": self.lines(),
            "held_out_rms_deg": {name: _degrees(value) for name, value in self.totals.items()},
            "held_out_rms_deg_by_joint": {
                name: dict(zip(self.robot.joint_names, map(_degrees, each.tolist()), strict=True))
                for name, each in self.errors.items()
            },
            "rotations": [{name: _degrees(value) for name, value in each.items()} for each in self.rotations],
            "parameters": [
                {
                    "joint": each.joint, "name": each.name, "unit": each.kind.unit, "value": _plain(each.value),
                    "deviation": _plain(each.deviation), "confidence": each.confidence,
                }
                for each in self.fitted.known
            ],
            "findings": [attrs.asdict(each) for each in self.findings],
            "unknown": [{"what": what, "how": how} for what, how in self.unknown],
            "course": {
                "joints": list(self.robot.joint_names),
                **{name: np.round(value, 5).tolist() for name, value in attrs.asdict(self.course).items()},
            },
        }  # fmt: skip


def _degrees(value: float) -> float:
    return round(float(np.rad2deg(value)), 4)


def _plain(value: float) -> float:
    return float(f"{value:.5g}")


def identify(
    options: MujocoOptions, robot: Robot, recordings: Sequence[Recording], last: ArmParameters | None = None,
    rotations: int = 1, tell: Tell = lambda what, share: None,
) -> Result:  # fmt: skip
    """Identify an arm.

    Args:
        options: its simulation, whose present parameters are those `before`.
        robot: the robot.
        recordings: of it.
        last: an earlier identification, to compare with.
        rotations: how often another part is held out.
        tell: receives what is done.

    Raises:
        HardwareError: if the arm cannot be simulated.
    """
    threads = min(_MOST_THREADS, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
    arm = FedArm(options, robot, threads)
    try:
        return _identify(arm, recordings, last, rotations, tell)
    finally:
        arm.close()


def _identify(
    arm: FedArm, recordings: Sequence[Recording], last: ArmParameters | None, rotations: int, tell: Tell
) -> Result:
    before = arm.present if arm.present is not arm.original else None
    candidates, parts = _candidates(arm), _parts(recordings)
    fits = min(rotations, len(parts))
    errors: dict[str, list[Vector]] = {BEFORE: [], BASELINE: [], AFTER: []}
    fitted = None
    for number in range(fits):
        held = parts[-1 - number]
        kept = [each for part in parts if part is not held for each in part]

        def said(text: str, number: int = number) -> None:
            tell(f"fit {number + 1} of {fits + 1}: {text}", (number + 0.5) / (fits + 1))

        tell(f"fit {number + 1} of {fits + 1}", number / (fits + 1))
        start = best_start(arm, some(kept, FIRST_S), candidates, said)
        fitted = fit(arm, kept, start, candidates[0], said)
        errors[BEFORE].append(error_of(arm, before, held))
        errors[AFTER].append(error_of(arm, fitted, held))
        errors[BASELINE].append(fit_baseline(kept).errors(held))
        if number == 0:
            course = _course(arm, before, fitted, held)
    assert fitted is not None
    tell("all recordings", fits / (fits + 1))
    every = {name: np.concatenate(each) for name, each in errors.items()}
    totals = {name: rms(each) for name, each in every.items()}
    by_joint = {name: np.sqrt(np.mean(each**2, axis=0)) for name, each in every.items()}
    apart = [dict(zip(by_joint, each, strict=True)) for each in zip(*by_joint.values(), strict=True)]
    whole = _unlike(totals)
    unlike = [joint for joint, each in zip(arm.robot.joint_names, apart, strict=True) if whole or _unlike(each)]
    final = refit(arm, recordings, fitted, candidates[0]).without(unlike)
    grips = dict(zip(arm.robot.joint_names, arm.robot.grips.tolist(), strict=True))
    findings = findings_of(final, grips, last)
    return Result(
        arm.robot, seconds_of(recordings), final, _written(arm.robot, final, recordings, totals),
        by_joint, totals,
        [{name: rms(each[number]) for name, each in errors.items()} for number in range(fits)],
        course, findings, unknown_of(final), tuple(unlike),
    )  # fmt: skip


def _unlike(errors: Mapping[str, float]) -> bool:
    """Whether the fit is further off than the simulation before, or than delay, lag and bias alone; by rms errors."""
    return errors[AFTER] > _WORSE * min(errors[BEFORE], errors[BASELINE]) + _RESOLUTION_RAD


def _candidates(arm: FedArm) -> list[ArmParameters]:
    """Where fits begin: the present parameters, those of the MJCF, and the published servo."""
    published = attrs.evolve(
        arm.original,
        joints={
            name: attrs.evolve(_PUBLISHED, torque_limit=_PUBLISHED.torque_limit if each.torque_limit else None)
            for name, each in arm.original.joints.items()
        },
    )
    return [published, arm.original, *([arm.present] if arm.present is not arm.original else [])]


def _parts(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """The recordings in up to `_HELD_OUT` parts; a long one, or a single one, is divided in time."""
    if len(recordings) >= _HELD_OUT:
        edges = np.linspace(0, len(recordings), _HELD_OUT + 1).round().astype(int)
        return [list(recordings[begin:end]) for begin, end in pairwise(edges)]
    parts: list[list[Recording]] = [[] for _ in range(_HELD_OUT)]
    for each in recordings:
        edges_s = np.linspace(0, each.seconds + 1e-6, _HELD_OUT + 1)
        for part, (begin, end) in zip(parts, pairwise(edges_s), strict=True):
            part.append(each.cut(float(begin), float(end)))
    return parts


def _course(arm: FedArm, before: ArmParameters | None, after: ArmParameters, held: Sequence[Recording]) -> Course:
    one = max(held, key=lambda each: each.seconds)
    shown = one.times <= _SHOWN_S
    newest = np.searchsorted(one.command_times, one.times, side="right") - 1
    every = max(1, int(shown.sum() / 450))
    rows = [
        one.times[:, None], one.commands[np.maximum(newest, 0)], one.measured,
        arm.run(before, [one], np.inf)[0], arm.run(after, [one], np.inf)[0],
    ]  # fmt: skip
    times, *others = [each[shown][::every] for each in rows]
    return Course(times[:, 0], *others)


def _written(
    robot: Robot, fitted: Fitted, recordings: Sequence[Recording], totals: Mapping[str, float]
) -> ArmParameters:
    deviations: dict[str, dict[str, float]] = {}
    for each in fitted.known:
        deviations.setdefault(each.joint, {})[each.name] = each.deviation
    return attrs.evolve(
        fitted.parameters,
        robot=robot.name,
        identified=Identification(
            episodes=tuple(each.name for each in recordings),
            seconds=seconds_of(recordings),
            made=datetime.now(UTC).date().isoformat(),
            held_out_rms=totals,
            deviations=deviations,
            unknown=tuple(f"{each.joint}.{each.name}" for each in fitted.known if each.confidence == "unknown"),
        ),
    )
