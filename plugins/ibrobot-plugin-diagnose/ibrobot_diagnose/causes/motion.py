"""Causes in the motion: an arm that does not follow, chunks that average two intentions, a policy that stands still."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_diagnose.cause import Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.course import CONFLICT, begins_to_move, chance_of_noise, conflict_of, course_of, delay_of
from ibrobot_diagnose.window import Floats, Window, holds


class ArmNotFollowing(Cause):
    """The arm does not go where its commands say."""

    name = "arm_not_following"
    title = "the arm follows its commands"
    explains = frozenset({"guard_held"})  # not the other way: the guard holds commands back, and the arm follows these
    needs = frozenset({"commands", "state"})
    remedy = (
        "Look at this joint: something in its way, a load, a loose horn, a low supply voltage, a gain that is too "
        "small. Switch the torque off and turn it by hand; then `ibrobot doctor`."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        delays, rests = delay_of(window)
        ranges, asked = _ranges(window.states), _ranges(window.commands)
        for gripper in (i for i, joint in enumerate(window.joints) if holds(joint)):
            if ranges[gripper] > 0.1 * asked[gripper]:  # it holds something
                rests[gripper] = np.nan
        if not np.isfinite(rests).any():
            return None
        usual = np.full(len(rests), 0.07)
        if reference.card is not None and len(reference.card.following) == len(rests):
            known = np.array([each if each is not None else 0.035 for each in reference.card.following])
            usual = np.maximum(0.035, 1.3 * known)
        ratio = np.nan_to_num(rests / usual, nan=-1.0)  # one that is unknown is never the worst
        j = int(np.argmax(ratio))
        joint, rest, delay = window.joints[j], float(rests[j]), float(delays[j])
        state, command = window.states[:, j], window.commands[:, j]
        known = np.isfinite(state) & np.isfinite(command)
        moved, told = float(np.ptp(state[known])), float(np.ptp(command[known]))
        details = [f"{joint} moved by {moved:.2f} rad, its commands by {told:.2f} rad; delay {1e3 * delay:.0f} ms"]
        error = (state - command)[known]
        if moved < 0.2 * told:
            details.append("it hardly moves: blocked, without torque, or a cable that is loose")
        elif abs(float(np.median(error))) > 0.6 * rest:
            side = "below" if np.median(error) < 0 else "above"
            details.append(f"it stays {abs(float(np.median(error))):.2f} rad {side} its commands: a load, or its gain")
        else:
            details.append("it is off while it moves: slack, friction, a low voltage, or a limit inside the motor")
        text = (
            f"{joint} was {rest:.2f} rad (rms) off its commands, even with its delay of {1e3 * delay:.0f} ms taken "
            "out; "
            f"{usual[j]:.2f} rad are usual."
        )
        return Evidence(
            text, rest, "rad", float(usual[j]), likelihood(float(ratio[j]), 1.0, 2.0), details=tuple(details)
        )


def _ranges(values: Floats) -> Floats:
    """How far each joint moves [rad], shape (J,); 0 for one that is unknown."""
    known = np.isfinite(values)
    low, high = (np.where(known, values, bound) for bound in (np.inf, -np.inf))
    result: Floats = np.maximum(high.max(axis=0, initial=-np.inf) - low.min(axis=0, initial=np.inf), 0.0)
    return result


class SmoothingAverages(Cause):
    """Blending averages answers that intend different things."""

    name = "smoothing_averages"
    title = "blended chunks agree with each other"
    needs = frozenset({"chunks", "commands", "state"})
    remedy = (
        "Do not blend: `dispatch: {strategy: replace}`, or `rtc` for a policy that can continue its plan. Chunks that "
        "disagree are those of a policy with several ways; see also whether it changes its mind without reason."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        course = course_of(window)
        if course is None or not course.acting.any():
            return None
        conflict = conflict_of(course)[course.acting]
        torn = conflict > CONFLICT
        share = float(torn.mean())
        if not torn.any():
            return None
        text = (
            f"In {100 * share:.0f} % of the run the blended plan was {float(np.median(conflict[torn])):.2f} rad from "
            "every answer that it blends: they disagree, and their mean is none of them."
        )
        since = window.since(int(course.times_ns[course.acting][torn.argmax()]))
        # Answers that drift one way, or a few times make up for a change, are those of a policy that errs.
        likely = likelihood(share, 0.15, 0.4) * (1.0 if chance_of_noise(window) < _CHANCE else 0.4)
        return Evidence(text, 100 * share, "%", 15.0, likely, since)


_CHANCE = 0.1
"""Chance below which answers that go to and fro are not those of one intention; see `chance_of_noise`."""


class StandsStill(Cause):
    """The policy does not begin to move."""

    name = "stands_still"
    title = "the policy moves the arm"
    needs = frozenset({"chunks", "commands"})
    remedy = (
        "Begin the run where the demonstrations begin, and look at what the model sees; if its answers hardly move "
        "either, cut the time at the beginning of demonstrations in which nothing moves: `ibrobot datasets check`."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        first = next(each.answer.header.stamp_ns for each in window.asked if each.used)
        waited = max(0.0, (first - int(window.command.times_ns[0])) / 1e9)  # for the first answer
        still = max(0.0, begins_to_move(window) - waited)
        threshold = 2.0
        if reference.card is not None:
            threshold = max(threshold, 1.5 * reference.card.quantile("idle_start_s", 0.95))
        whole = still + waited >= window.seconds - 0.1
        text = (
            f"The policy never moved the arm in {window.seconds:.1f} s."
            if whole
            else f"The policy kept the arm still for the first {still:.1f} s; at most {threshold:.1f} s are usual."
        )
        strength = likelihood(still, threshold, 2.5 * threshold)
        return Evidence(text, still, "s", threshold, max(strength, 0.9) if whole and still > 1.0 else strength)


class AnswersTremble(Cause):
    """The model answers with noise around a motion."""

    name = "answers_tremble"
    title = "the model's answers are motions"
    weak = True
    needs = frozenset({"chunks"})
    explains = frozenset({
        "other_speed", "limits_low", "smoothing_averages", "unseen_states", "arm_not_following",
        "guard_held",  # such answers lead into the table
    })  # fmt: skip
    remedy = (
        "Train longer, on more data; for a diffusion policy look at its denoising steps, too. Nothing of the arm makes "
        "answers like these; pictures that the model has never seen may."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        net = way = 0.0
        for each in (one for one in window.asked if one.used):
            back = max(1, round(0.2e9 / each.answer.step_ns))
            steps = np.abs(np.diff(each.chunk, axis=0))
            if len(steps) < 2 * back:
                continue
            net += float(np.abs(each.chunk[back:] - each.chunk[:-back]).sum())
            total = np.cumsum(np.concatenate([np.zeros((1, steps.shape[1])), steps]), axis=0)
            way += float((total[back:] - total[:-back]).sum())
        if way < 0.1:
            return None
        share = net / way
        text = (
            f"The model's answers tremble: of the way that they go in 0.2 s, only {100 * share:.0f} % leads anywhere; "
            "of a motion it is more than half."
        )
        return Evidence(text, 100 * share, "%", 50.0, likelihood(share, 0.5, 0.3))


CAUSES: tuple[type[Cause], ...] = (ArmNotFollowing, SmoothingAverages, StandsStill, AnswersTremble)
