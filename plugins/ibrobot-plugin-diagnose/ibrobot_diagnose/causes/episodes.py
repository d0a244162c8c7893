"""Causes in demonstrations: idle time, stalls, jerk, saturation, black pictures, gaps, odd lengths and ways."""

from __future__ import annotations

from typing import ClassVar, override

import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.card import Card, jerk_of, rests_of, series_of, way_of
from ibrobot_diagnose.cause import CardCause, Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.window import Floats, Window, grips, holds

_SHOWN = frozenset({"demonstration", "state"})
_SLOW = 0.003
"""Motion between two samples up to which it counts as noise [rad]."""
_GOES_ON = 0.2
"""Share of its largest speed with which a joint goes on moving; scripted motions have at most 0.04 where they stop."""
_AT_ONCE = 0.1
"""Share of its largest speed from which a joint stops or starts at once."""


class _Still(CardCause):
    """Nothing moves for a time."""

    needs = _SHOWN | {"card"}
    series: ClassVar[str]
    least_s: ClassVar[float] = 1.0
    where: ClassVar[str]

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        start, end, stall, begin = rests_of(window)
        seconds = {"idle_start_s": start, "idle_end_s": end, "stall_s": stall}[self.series]
        usual = max(self.least_s, 1.3 * card.quantile(self.series, 0.75) + 0.3)
        text = f"Nothing moves for {seconds:.1f} s {self.where}; up to {usual:.1f} s are usual in the other episodes."
        since = {"idle_start_s": 0.0, "idle_end_s": window.seconds - end, "stall_s": begin}[self.series]
        return Evidence(text, seconds, "s", usual, likelihood(seconds, usual, 2.0 * usual), since)


class IdleStart(_Still):
    """The episode begins with time in which nothing moves."""

    name, title, series, where = (
        "idle_start",
        "the arm moves soon after the beginning",
        "idle_start_s",
        "at the beginning",
    )
    explains = frozenset({"stands_still"})
    mends = "trim start"
    remedy = "Cut it: `ibrobot episodes trim EPISODE --from SECONDS`; a policy learns to wait from it."


class IdleEnd(_Still):
    """The episode ends with time in which nothing moves."""

    name, title, series, where = "idle_end", "the episode ends soon after the motion", "idle_end_s", "at the end"
    mends = "trim end"
    remedy = "Cut it: `ibrobot episodes trim EPISODE --to SECONDS`."


class Stall(_Still):
    """The arm stands in the middle."""

    name, title, series, where = "stall", "the arm goes on moving", "stall_s", "in the middle"
    least_s = 1.2
    explains = frozenset({"odd_length"})
    remedy = "Drop the episode, or keep the part before or after: `ibrobot episodes trim`."


class Jerk(CardCause):
    """The motion is jerky."""

    name, title = "jerk", "the motion is as smooth as in the other episodes"
    needs = _SHOWN | {"card"}
    explains = frozenset({"other_speed", "odd_path", "answers_tremble"})
    remedy = "Drop the episode; look for a leader that sticks, a device with gaps, or a control rate that is too low."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        jerk, usual = jerk_of(window), 1.3 * card.quantile("jerk", 0.95)
        text = (
            f"The motion is jerky: its speed changes by {jerk:.1f} times itself per second; up to {usual:.1f} are "
            "usual."
        )
        return Evidence(text, jerk, "1/s", usual, likelihood(jerk / max(usual, 1e-6), 1.0, 1.6)) if usual > 0 else None


class Saturated(Cause):
    """A joint stands at the end of its range."""

    name, title = "saturated", "no joint stands at the end of its range"
    needs = _SHOWN
    remedy = "Calibrate the whole range of the joint, on the leader, too; drop the episode if the motion is cut off."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        values = window.commands if "commands" in window.streams else window.states
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) < 10:
            return None
        steps = np.abs(np.diff(values, axis=0))
        moving = steps.max(axis=1, initial=0.0) > 0.002
        shares = np.zeros(len(window.joints))
        for joint in np.flatnonzero(np.ptp(values, axis=0) >= 0.1):
            for extreme in (values[:, joint].min(), values[:, joint].max()):
                still = np.abs(values[:, joint] - extreme) < 1e-4
                cut = _cut_off(still, steps[:, joint], np.delete(steps, joint, axis=1))
                shares[joint] = max(shares[joint], (cut[1:] & moving).sum() / max(1, int(moving.sum())))
        # A gripper that is shut stands at its end, too.
        shares = np.array([0.0 if holds(joint) else share for joint, share in zip(window.joints, shares, strict=True)])
        j = int(np.argmax(shares))
        text = (
            f"{window.joints[j]} stands at the end of its range for {100 * shares[j]:.0f} % of the motion: it is cut "
            "off."
        )
        return Evidence(text, 100 * float(shares[j]), "%", 12.0, likelihood(float(shares[j]), 0.12, 0.3))


def _cut_off(still: NDArray[np.bool_], own: Floats, others: Floats) -> NDArray[np.bool_]:
    """At which of the times in `still`, at which a joint stands at its extreme, it is cut off; both have shape (T,).

    It is cut off if it stops or starts at once (by `own`, its motion between two samples) while other joints keep
    moving (by `others`). In a planned motion that merely ends at the extreme, all joints stop and start together; a
    joint that comes to rest there by itself slows down before.
    """
    pace = (others / np.maximum(others.max(axis=0, initial=0.0), _SLOW)).max(axis=1, initial=0.0)
    speed = own / max(float(own.max(initial=0.0)), _SLOW)
    edges = np.flatnonzero(np.diff(still.astype(int), prepend=0, append=0))
    cut = np.zeros_like(still)
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        cut[begin:end] = any(
            pace[max(0, at - 3) : at + 2].min() > _GOES_ON and beside.max(initial=0.0) > _AT_ONCE
            for at, beside in ((begin, speed[max(0, begin - 3) : begin]), (end, speed[end - 1 : end + 2]))
            if 0 < at < len(still)
        )
    return cut


class PictureBlack(Cause):
    """Pictures are black."""

    name, title = "picture_black", "no picture is black"
    needs = frozenset({"pictures"})
    explains = frozenset({
        "picture_dark", "picture_frozen", "picture_blurred", "picture_covered", "unseen_pictures", "white_balance",
    })  # fmt: skip
    remedy = "Drop the episode, and look at the camera's cable, its cover, and the light."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        shares = {
            camera.name: float(np.mean([each.brightness < 6 and each.contrast < 4 for each in camera.pictures]))
            for camera in window.cameras.values()
            if camera.pictures
        }
        name = max(shares, key=lambda each: shares[each])
        text = f"{100 * shares[name]:.0f} % of the pictures of {name} are black."
        return Evidence(text, 100 * shares[name], "%", 2.0, likelihood(shares[name], 0.02, 0.1))


class PictureGaps(Cause):
    """Pictures come late, or with gaps."""

    name, title = "picture_gaps", "pictures come in their rate"
    needs = frozenset({"pictures"})
    remedy = "Drop the episode if it moves meanwhile; see which camera or disk is too slow: `ibrobot episodes verify`."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        worst = (0.0, "", 0.0, 0)
        for camera in window.cameras.values():
            if window.sampled or len(camera.times_ns) < 10:
                continue
            gaps = np.diff(camera.times_ns) / 1e9
            i = int(np.argmax(gaps))
            ratio = float(gaps[i] / max(np.median(gaps), 1e-3))
            worst = max(worst, (ratio, camera.name, float(gaps[i]), camera.times_ns[i]))
        ratio, name, gap, begin = worst
        if not name:
            return None
        text = f"The pictures of {name} pause for {gap:.2f} s, {ratio:.0f} times their usual distance."
        return Evidence(text, ratio, "times", 6.0, likelihood(ratio, 6.0, 15.0), window.since(begin))


class GripperIdle(CardCause):
    """The gripper never acts."""

    name, title = "gripper_idle", "the gripper acts"
    needs = _SHOWN | {"card"}
    explains = frozenset({"joint_zero"})
    remedy = "Drop the episode if the task needs the gripper; look at its motor, and at the leader's handle."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        grippers = [j for j, joint in enumerate(window.joints) if grips(joint)]
        known = window.states[np.isfinite(window.states).all(axis=1)]
        usual = card.row(card.state, 0.95) - card.row(card.state, 0.05)
        grippers = [j for j in grippers if usual[j] > 0.15]
        if not grippers or not len(known):
            return None
        shares = [float(np.ptp(known[:, j]) / usual[j]) for j in grippers]
        j, share = grippers[int(np.argmin(shares))], min(shares)
        text = f"{window.joints[j]} moves by {100 * share:.0f} % of what is usual: it never acts."
        return Evidence(text, 100 * share, "%", 20.0, likelihood(share, 0.2, 0.06))


class _Odd(CardCause):
    """A number of the episode lies far from those of the others."""

    needs = _SHOWN | {"card"}
    series: ClassVar[str]
    words: ClassVar[tuple[str, str]]
    unit: ClassVar[str]

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        value = series_of(window)[self.series]
        low, middle, high = (card.quantile(self.series, level) for level in (0.05, 0.5, 0.95))
        if middle <= 0 or low <= 0:
            return None
        factor = max(value / high, low / max(value, 1e-6))
        long, short = self.words
        text = f"The {long if value > high else short}: {value:.3g} {self.unit}; {low:.3g} to {high:.3g} are usual."
        return Evidence(text, factor, "times", 1.6, likelihood(factor, 1.6, 2.5))


class OddLength(_Odd):
    """The episode is far longer or shorter than the others."""

    name, title, series, unit = "odd_length", "the episode is as long as the others", "seconds", "s"
    words = ("episode is too long", "episode is too short")
    remedy = "Look at it: drop what was begun or ended in the wrong moment."


class OddPath(_Odd):
    """The arm goes a far longer or shorter way than in the others."""

    name, title, series, unit = "odd_path", "the arm goes as far as in the others", "path", "rad"
    words = ("way of the arm is too long", "way of the arm is too short")
    remedy = "Look at it: something went wrong, or another task was done."


class Duplicate(CardCause):
    """The episode is a copy of another one."""

    name, title = "duplicate", "the episode is no copy of another one"
    needs = _SHOWN | {"card"}
    remedy = "Drop it: copies make the others count less, and a test on one of the two means nothing."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if not np.isfinite(window.states).all(axis=1).any() or not len(card.ways):
            return None
        distances = np.abs(card.ways - way_of(window)[None]).max(axis=1)
        near = int(distances.argmin())
        distance, other = float(distances[near]), card.way_names[near] if card.way_names else "another episode"
        text = f"The arm moves as in {other}, within {distance:.4f} rad: this episode is a copy of it, or nearly."
        return Evidence(text, distance, "rad", 0.004, likelihood(distance, 0.004, 0.001))


class NotJudged(Cause):
    """Nobody judged the episode."""

    name, title = "not_judged", "the episode is judged"
    needs = frozenset({"demonstration"})
    mends = "judge"
    remedy = "Look at it and judge it: `ibrobot episodes mark EPISODE success`."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        if window.sampled or window.outcome != "unknown":
            return None
        return Evidence("Nobody judged this episode.", 1.0, "episodes", 0.5, 0.51)


CAUSES: tuple[type[Cause], ...] = (
    IdleStart, IdleEnd, Stall, Jerk, Saturated, PictureBlack, PictureGaps, GripperIdle, OddLength, OddPath, Duplicate,
    NotJudged,
)  # fmt: skip
