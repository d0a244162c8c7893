"""Causes between the plan and the command: limits that are too low, the guard, and an operator who took over."""

from __future__ import annotations

import json
from typing import override

import numpy as np

from ibrobot_core.api import NS_PER_S
from ibrobot_diagnose.card import Card
from ibrobot_diagnose.cause import Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.course import course_of, operated_share
from ibrobot_diagnose.window import Limits, Window

_SAME = 0.2
"""Likelihood that a limit is too low that was the same when the data was recorded."""


class LimitsLow(Cause):
    """A limit keeps the arm from what the model says."""

    name = "limits_low"
    title = "limits leave the model's actions as they are"
    explains = frozenset({"smoothing_averages"})
    needs = frozenset({"chunks", "commands", "state"})
    remedy = (
        "Raise the limit of this joint in the robot YAML (`robot: {joints: …}`) to what the arm and its surroundings "
        "bear, at least to that of the recording; or train on demonstrations that stay below it."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        course = course_of(window)
        if course is None or not course.acting.any():
            return None
        limited = course.at_velocity | course.at_position
        off = np.nan_to_num(np.abs(course.command - course.planned)) * course.acting[:, None]
        touched = limited & (off > 0.02) & course.acting[:, None]
        if not touched.any():
            return None
        share = float(touched.any(axis=1).sum() / course.acting.sum())
        joint = int(np.argmax((touched * off).sum(axis=0)))
        kind = "position" if course.at_position[:, joint].sum() > course.at_velocity[:, joint].sum() else "velocity"
        furthest = float((off * touched)[:, joint].max())
        limits = window.limits[joint]
        stated = (
            f"{limits.velocity:.3g} rad/s" if kind == "velocity" else f"{limits.lower:.3g} to {limits.upper:.3g} rad"
        )
        text = (
            f"The {kind} limit of {window.joints[joint]} ({stated}) held the arm back in {100 * share:.0f} % of the "
            f"run, by up to {furthest:.2f} rad from what the model said."
        )
        since = window.since(int(course.times_ns[touched.any(axis=1).argmax()]))
        likely = likelihood(share * min(1.0, furthest / 0.05), 0.08, 0.3)
        if reference.card is not None and reference.card.joints == window.joints:
            likely = min(likely, _needed(kind, joint, limits, reference.card))
        return Evidence(text, 100 * share, "%", 8.0, likely, since)


def _needed(kind: str, joint: int, limits: Limits, card: Card) -> float:
    """Likelihood that demonstrations exceed a limit; one that they keep is not too low: the model asks for more."""
    known = Limits() if card.limits is None else card.limits[joint]
    if kind == "velocity" and known.velocity <= 1.01 * limits.velocity:
        return _SAME  # the robot had it when the data was recorded
    if kind == "position" and known.lower >= limits.lower - 0.01 and known.upper <= limits.upper + 0.01:
        return _SAME
    if kind == "velocity":
        usual = float(card.row(card.speed, 0.99)[joint])
        return likelihood(usual / max(limits.velocity, 1e-6), 1.0, 1.3)
    low, high = float(card.row(card.action, 0.01)[joint]), float(card.row(card.action, 0.99)[joint])
    return likelihood(max(high - limits.upper, limits.lower - low, 0.0), 0.03, 0.1)


class GuardHeld(Cause):
    """The guard kept the arm from where it was sent."""

    name = "guard_held"
    title = "the guard let the arm go where it was sent"
    needs = frozenset({"guard", "commands"})
    explains = frozenset({"limits_low", "stands_still"})
    remedy = (
        "Move what is in the way, or correct its place and size in the section `world`. If the arm is meant to touch "
        "it, say so: `movable` or `may_touch` of the object, or `may_touch`, `free` and `regions` of `control.guard`."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        end_ns = int(window.ticks_ns[-1]) if len(window.ticks_ns) else 0
        held: dict[str, int] = {}
        begins = [*(since for since, _ in window.guarded), end_ns]
        for (since, label), until in zip(window.guarded, begins[1:], strict=True):
            if label:
                pair = _pair(label)
                held[pair] = held.get(pair, 0) + max(0, until - since)
        if not held or not window.seconds:
            return None
        share = sum(held.values()) / NS_PER_S / window.seconds
        pairs = sorted(held, key=lambda each: -held[each])
        text = f"The guard held the arm back in {100 * share:.0f} % of the run, mostly between {pairs[0]}."
        first_ns = next(since for since, label in window.guarded if label)
        details = tuple(f"{pair}: {held[pair] / NS_PER_S:.1f} s" for pair in pairs[:5] if held[pair] >= NS_PER_S / 20)
        return Evidence(text, 100 * share, "%", 10.0, likelihood(share, 0.1, 0.2), window.since(first_ns), details)


def _pair(label: str) -> str:
    """The two things that a label names; the label if it does not."""
    try:
        read = json.loads(label)
        return f"{read['first']} and {read['second']}"
    except (LookupError, TypeError, ValueError):
        return label


class Takeover(Cause):
    """An operator had the arm."""

    name = "takeover"
    title = "the policy had the arm all the time"
    needs = frozenset({"chunks"})
    remedy = (
        "Judge the policy by the parts that it commanded; `ibrobot convert --only interventions` keeps the others for "
        "training."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        share, since = operated_share(window)
        if since is None:
            return None
        text = f"An operator commanded {100 * share:.0f} % of the run, from {since:.1f} s on."
        return Evidence(text, 100 * share, "%", 20.0, likelihood(share, 0.2, 0.8), since)


CAUSES: tuple[type[Cause], ...] = (LimitsLow, GuardHeld, Takeover)
