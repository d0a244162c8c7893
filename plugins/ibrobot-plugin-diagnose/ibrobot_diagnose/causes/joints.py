"""Causes in the joints: units, zeros, their order, and the gripper, in comparison with the model's data."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.card import LEVELS, Card
from ibrobot_diagnose.cause import CardCause, Cause, Evidence, Reference, in_digits, likelihood
from ibrobot_diagnose.causes.pictures import Pair, pairs
from ibrobot_diagnose.pictures import descriptors, nearest
from ibrobot_diagnose.window import Floats, Window, grips

_MIDDLE = slice(1, -1)
"""Levels of the quantiles that are compared."""
_MOST_JOINTS = 64
_LIKE = 1.2
"""How far pictures that look the same are from each other at most, in times of the usual distance."""
_STEP = 0.05
"""How far poses are from each other that count as two [rad]."""
_REPEATS = 0.6
"""Usual distance up to which pictures of a camera repeat, so that they say something of the pose."""
_CONSEQUENCES = frozenset({
    "unseen_start", "unseen_states", "other_speed", "statistics", "limits_low", "stands_still", "arm_not_following",
    "guard_held", "saturated", "odd_length", "odd_path", "idle_start", "idle_end",
})  # fmt: skip
"""Causes that seem to apply if the readings are in a wrong unit or order."""


def _known(window: Window) -> Floats:
    result: Floats = window.states[np.isfinite(window.states).all(axis=1)]
    return result


def _same(window: Window, card: Card) -> bool:
    return window.joints == card.joints and len(_known(window)) > 1


def _span(card: Card) -> Floats:
    result: Floats = np.maximum(card.row(card.state, 1.0) - card.row(card.state, 0.0), 0.1)
    return result


def _costs(states: Floats, card: Card) -> NDArray[np.float64]:
    """How far the quantiles of each joint of the window, by row, are from those of each joint of the card."""
    own = np.quantile(states, LEVELS, axis=0)[_MIDDLE]
    differences = np.abs(own[:, :, None] - card.state[_MIDDLE][:, None, :]).mean(axis=0)
    result: NDArray[np.float64] = differences / _span(card)[None]
    return result


def _repeats(pair: Pair) -> bool:
    """Whether pictures of a camera repeat, so that they say something of the pose."""
    return pair.card.usual_distance <= _REPEATS


@attrs.frozen
class LikePoses:
    """Positions of the joints in the window, and in the data at pictures that look the same."""

    own: Floats
    """[rad], shape (N, J)."""
    theirs: Floats
    """[rad], shape (N, J)."""
    weights: Floats
    """The more alike the pictures, the more a pose weighs; shape (N,)."""
    begins: NDArray[np.bool_]
    """Which ones are the pose in which the run began; shape (N,)."""


def like_poses(window: Window, card: Card) -> LikePoses:
    """Poses at pictures that look the same, each a step from the camera's others, in the window and in the data.

    An arm that stands still or trembles where the data never was, and so resembles one other pose of the data, says no
    more than one that passes it.
    """
    size = len(window.joints)
    own: list[Floats] = [np.empty((0, size))]
    theirs: list[Floats] = [np.empty((0, size))]
    weights: list[Floats] = [np.empty(0)]
    begins: list[NDArray[np.bool_]] = [np.empty(0, np.bool_)]
    for pair in pairs(window, card):
        if not _repeats(pair):
            continue
        times = np.array(pair.camera.times_ns, np.int64)
        index = np.unique(np.linspace(0, len(times) - 1, min(120, len(times))).round().astype(int))
        distance, near = nearest(descriptors(pair.camera.small[index]), pair.card.vectors)
        states, data = window.state.at(times[index]), pair.card.poses[near]
        alike = 1.0 - distance / max(_LIKE * pair.card.usual_distance, 1e-6)
        known = np.isfinite(states).all(axis=1)
        begin = int(known.argmax())  # the first pictures may come before the first reading
        kept: list[int] = []
        for i in (begin, *np.argsort(-alike).tolist()):
            if alike[i] > 0 and known[i] and _away(states, i, kept) and _away(data, i, kept):
                kept.append(i)
        own.append(states[kept])
        theirs.append(data[kept])
        weights.append(np.square(alike[kept], dtype=np.float64))
        begins.append(np.array(kept) == begin)
    return LikePoses(np.concatenate(own), np.concatenate(theirs), np.concatenate(weights), np.concatenate(begins))


def _away(poses: Floats, i: int, kept: list[int]) -> bool:
    """Whether a pose is a step away from those that are kept."""
    return not kept or bool(np.abs(poses[kept] - poses[i]).max(axis=1).min() >= _STEP)


def _weighted_quantile(values: Floats, weights: Floats, share: float) -> Floats:
    """The value of each column up to which that share of the weights lies; shape (J,)."""
    order = np.argsort(values, axis=0)
    sums = np.cumsum(weights[order], axis=0)
    row = (sums < share * sums[-1]).sum(axis=0)
    columns = np.arange(values.shape[1])
    result: Floats = values[order[row, columns], columns]
    return result


def usual_offsets(card: Card) -> Floats:
    """How far the positions of an episode of the data are from those of the others at pictures that look the same.

    Of nearly all episodes [rad], shape (J,): a joint that the cameras hardly see differs from episode to episode.
    """
    offsets = []
    for camera in card.cameras.values():
        if camera.usual_distance > _REPEATS:
            continue
        owners = np.array([name for name, _ in camera.places])
        for owner in np.unique(owners).tolist():
            own, others = owners == owner, owners != owner
            if not others.any():
                continue
            distance, near = nearest(camera.vectors[own], camera.vectors[others])
            good = distance < 1.5 * camera.usual_distance
            if good.any():
                offsets.append(np.median(camera.poses[own][good] - camera.poses[others][near[good]], axis=0))
    size = len(card.joints)
    result: Floats = np.quantile(np.abs(offsets), 0.95, axis=0) if offsets else np.zeros(size)
    return result


class ReadingsMissing(Cause):
    """Positions are no numbers."""

    name = "readings_missing"
    title = "each joint has a position in every reading"
    needs = frozenset({"motion", "state"})
    explains = _CONSEQUENCES | {"unseen_success", "joint_order", "joint_zero"}
    remedy = (
        "Check this joint's cable and motor, and the program that delivers its positions; they were recorded as they "
        "came. Statements about the motion hold for the other readings only, and no training can use such numbers."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        wanted = {name.removeprefix("position.") for part in window.contract.observation_parts for name in part.select}
        worst = 0.0, "", ""
        for what, track in (("readings", window.state), ("commands", window.command)):
            for joint, values in zip(window.joints, track.values.T, strict=True):
                known = np.isfinite(values)
                if len(known) and (known.any() or (what == "readings" and joint in wanted)):
                    # A joint may come first a little later than the others.
                    worst = max(worst, (float(1 - known[known.argmax() :].mean()), joint, what))
        share, joint, what = worst
        if share <= 0:
            return None
        text = f"{joint} has no position in {100 * share:.0f} % of the {what}, or one that is not a finite number."
        return Evidence(text, 100 * share, "%", 2.0, likelihood(share, 0.02, 0.1))


class OtherUnits(CardCause):
    """Positions are in another unit."""

    name = "other_units"
    title = "joint positions are in the unit of the data"
    needs = frozenset({"motion", "state", "card"})
    explains = _CONSEQUENCES | {"joint_order", "joint_zero", "gripper_scaled", "gripper_reversed"}
    remedy = (
        "Deliver the joints in radians, as every driver here does (LeRobot's deliver degrees or -100 to 100), and give "
        "the model the unit of its training: `models: {…: {norm_mode: …}}`."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if not _same(window, card):
            return None
        states, usual = _known(window), np.abs(card.state).max()
        largest = float(np.quantile(np.abs(states), 0.99))
        ratio = max(largest / usual, 0.33 * usual / max(largest, 1e-6))
        # The median over joints: a gripper may have a different unit.
        costs = {unit: float(np.median(np.diag(_costs(each, card)))) for unit, each in self._in_units(window, states)}
        best = min(costs, key=lambda unit: costs[unit])
        plain = float(np.median(np.diag(_costs(states, card))))
        unit = best if costs[best] < 0.3 * plain else "an unknown unit"
        text = (
            f"The joint positions reach {largest:.3g}, where those of the data reach {usual:.3g} rad: they are in "
            f"{unit}."
        )
        return Evidence(text, ratio, "times", 4.0, likelihood(ratio, 4.0, 8.0))

    @staticmethod
    def _in_units(window: Window, states: Floats) -> Iterator[tuple[str, Floats]]:
        """Each unit that the positions may have, with the positions converted from it to radians."""
        yield "degrees", states * np.pi / 180
        yield "radians, the data in degrees", states * 180 / np.pi
        lower = np.array([each.lower for each in window.limits])
        upper = np.array([each.upper for each in window.limits])
        if np.isfinite(lower).all() and np.isfinite(upper).all():
            yield "-100 to 100", lower + (upper - lower) * (states + 100) / 200


class OtherNormMode(CardCause):
    """The model is given another unit than that of its training."""

    name = "other_norm_mode"
    title = "the model gets the unit of its training"
    explains = _CONSEQUENCES
    remedy = "Set `norm_mode` of the model in the robot YAML to the unit of its training."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        model = (window.document.get("models") or {}).get(window.policy.get("model", ""), {})
        given = model.get("norm_mode") if isinstance(model, dict) else None
        if given is None or card.norm_mode is None or given == card.norm_mode:
            return None
        text = f"The robot YAML gives the model its joints in {given}, but it was trained on {card.norm_mode}."
        return Evidence(text, 1.0, "difference", 0.5, 0.98)


class JointOrder(CardCause):
    """Joints have each other's place."""

    name = "joint_order"
    title = "the joints are in the order of the data"
    needs = frozenset({"motion", "state", "card"})
    explains = _CONSEQUENCES | {"joint_zero", "gripper_scaled", "gripper_reversed"}
    remedy = (
        "Compare the order of `joints` in the robot YAML with that of the data (`ibrobot datasets info`), and the "
        "motors' numbers with their joints: move one by hand, and see which number changes."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        size = len(window.joints)
        if not _same(window, card) or size > _MOST_JOINTS:
            return None
        costs = _costs(_known(window), card)
        starts = _known(window)[:1].T - np.median(card.starts, axis=0)[None]
        costs = costs + 0.5 * np.abs(starts) / _span(card)[None]
        order = _assignment(costs)
        plain, best = float(costs.diagonal().sum()), float(costs[np.arange(size), order].sum())
        ratio = (plain + 0.1) / (best + 0.1 * size**0.5)
        matches = np.abs(_known(window)[0] - np.median(card.starts, axis=0)).max() < 0.1
        ratio *= (0.7 if matches else 1.0) * (0.7 if (order != np.arange(size)).sum() > 2 else 1.0)
        if (pair := _exchanged(_known(window)[0], np.median(card.starts, axis=0))) is not None:
            order, ratio = np.arange(size), max(ratio, 4.0)
            order[list(pair)] = order[list(pair[::-1])]
        pairs_of = [f"{window.joints[i]} behaves as {card.joints[j]}" for i, j in enumerate(order) if i != j]
        if not pairs_of or len(pairs_of) < 2:
            return None
        text = (
            f"Joints are exchanged: {', '.join(pairs_of)} in the data; exchanged back, they fit the data {ratio:.1f} "
            "times as well."
        )
        return Evidence(text, ratio, "times", 1.8, likelihood(ratio, 1.8, 3.0))


def _exchanged(start: Floats, usual: Floats) -> tuple[int, int] | None:
    """The two joints with which a start that is far from the usual one is exactly that."""
    if np.abs(start - usual).max() < 0.5:
        return None
    for a, b in itertools.combinations(range(len(start)), 2):
        swapped = start.copy()
        swapped[[a, b]] = swapped[[b, a]]
        if np.abs(swapped - usual).max() < 0.1:
            return a, b
    return None


def _assignment(costs: NDArray[np.float64]) -> NDArray[np.intp]:
    """The joint of the card for each joint of the window with the smallest sum of costs, by exchanging pairs."""
    size = len(costs)
    order = np.arange(size)
    if size <= 6:
        rows = np.arange(size)
        return np.array(min(itertools.permutations(range(size)), key=lambda each: costs[rows, each].sum()))
    improved = True
    while improved:
        improved = False
        for a, b in itertools.combinations(range(size), 2):
            gain = costs[a, order[a]] + costs[b, order[b]] - costs[a, order[b]] - costs[b, order[a]]
            if gain > 1e-9:
                order[[a, b]], improved = order[[b, a]], True
    return order


class JointZero(CardCause):
    """The zero of a joint is shifted."""

    name = "joint_zero"
    title = "the zeros of the joints are those of the data"
    needs = frozenset({"motion", "state", "card pictures", "pictures"})
    explains = frozenset({"unseen_start", "unseen_states"})
    remedy = (
        "Calibrate the arm again, or choose its own calibration (`hardware: {calibration: …}`): put it into the pose "
        "of the two pictures of the report (`--out`), and compare the numbers."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if not _same(window, card):
            return None
        poses = like_poses(window, card)
        if len(poses.own) < 5:
            return None
        differences = poses.own - poses.theirs
        middle = _weighted_quantile(differences, poses.weights, 0.5)
        # Of three quarters: a gripper that is open in half of the pictures, and shut in the other, has no zero.
        spread = 0.87 * _weighted_quantile(np.abs(differences - middle), poses.weights, 0.75)
        sure = np.abs(middle) / (0.04 + 0.5 * spread + usual_offsets(card))
        j = int(np.argmax(sure))
        others = np.delete(sure, j)
        text = (
            f"The zero of {window.joints[j]} is shifted by {middle[j]:+.2f} rad ({np.degrees(middle[j]):+.0f}°): at "
            "pictures that look the same, the data has other positions of this joint."
        )
        details = tuple(
            f"{joint}: {off:+.3f} rad, scattered by {width:.3f}"
            for joint, off, width in zip(window.joints, middle.tolist(), spread.tolist(), strict=True)
        )
        number = float(sure[j])
        if others.max(initial=0.0) >= 0.7 * number:  # two that make up for each other look the same in pictures
            number *= 0.45
        if (np.abs(differences[poses.begins, j]) < 0.5 * abs(middle[j])).any():
            number *= 0.4  # before the policy moved the arm, it stood where the data says
        if spread[j] > 0.6 * abs(middle[j]):
            number *= 0.5
        start = float(_known(window)[0, j] - np.median(card.starts[:, j]))
        if abs(start - middle[j]) < 0.5 * abs(middle[j]):  # an arm that begins in its rest pose is off by as much
            number *= 1.5
        likely = likelihood(number, 2.0, 3.5)
        shown = next((each.beside() for each in pairs(window, card) if _repeats(each)), ()) if likely > 0.4 else ()
        return Evidence(text, number, "times", 2.0, likely, details=details, pictures=shown)


def _gripper(window: Window) -> int | None:
    names = [i for i, joint in enumerate(window.joints) if grips(joint)]
    return names[0] if len(names) == 1 else None


class GripperScaled(CardCause):
    """The gripper has another range."""

    name = "gripper_scaled"
    title = "the gripper has the range of the data"
    needs = frozenset({"motion", "state", "card"})
    explains = frozenset({"unseen_states", "unseen_start", "arm_not_following", "guard_held"})
    remedy = "Calibrate the gripper from shut to open; a percentage is no angle, and another jaw has another range."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        j = _gripper(window)
        if j is None or not _same(window, card):
            return None
        own = _known(window)[:, j]
        low, high = float(card.row(card.state, 0.01)[j]), float(card.row(card.state, 0.99)[j])
        begin, end = np.quantile(own, (0.01, 0.99)).tolist()
        factor = (end - begin) / max(high - low, 0.05)
        # Only a range that is too large is sure: a gripper that never opens is one of a policy that does not act.
        reach = max(factor, abs(end) / max(abs(high), 0.05)) if factor > 1 else 1.0
        start = float(np.median(card.starts[:, j]))
        if abs(own[0] - start) > 0.4 * max(high - low, 0.05) and abs(own[0] - reach * start) > 0.3 * reach * abs(start):
            reach = 1.0  # it begins where no factor brings it
        text = (
            f"The gripper reaches from {in_digits(begin)} to {in_digits(end)} rad; in the data from {in_digits(low)} "
            f"to {in_digits(high)} rad."
        )
        return Evidence(text, reach, "times", 1.5, likelihood(reach, 1.5, 2.2))


class GripperReversed(CardCause):
    """Open is shut."""

    name = "gripper_reversed"
    title = "open is open, and shut is shut"
    needs = frozenset({"motion", "state", "card"})
    explains = _CONSEQUENCES | {"joint_zero", "joint_order"}
    remedy = (
        "Calibrate the gripper again, with its ends and its sign as in the recordings: now open and shut are exchanged."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        j = _gripper(window)
        if j is None or not _same(window, card):
            return None
        own = _known(window)[:, j : j + 1]
        mirrored = own[0, 0] + float(np.median(card.starts[:, j])) - own
        levels = card.state[_MIDDLE, j]
        span = float(_span(card)[j])
        costs = [
            float(np.abs(np.quantile(each[:, 0], LEVELS)[_MIDDLE] - levels).mean()) / span for each in (own, mirrored)
        ]
        start = float(np.median(card.starts[:, j]))
        first = [abs(float(each[0, 0]) - start) / span for each in (own, mirrored)]
        plain, other = (cost + begin for cost, begin in zip(costs, first, strict=True))
        ratio = (plain + 0.08) / (other + 0.08) if plain > 0.35 and first[0] > 0.25 else 0.5
        rest = np.delete(np.abs(_known(window)[0] - np.median(card.starts, axis=0)), j)
        exact = abs(self._turned(window, card, j, float(own[0, 0])) - start) / span
        if first[0] > 0.5 and exact < 0.05 and rest.max(initial=0.0) < 0.1:
            # All other joints begin as usual, and this one exactly where its two ends exchanged put its start.
            ratio = max(ratio, (first[0] + 0.08) / (exact + 0.08))
        text = (
            f"The gripper is reversed: it begins at {own[0, 0]:.2f} rad where the data begins at {start:.2f}, and the "
            f"mirror image of its way is {ratio:.1f} times as close to the data."
        )
        return Evidence(text, ratio, "times", 2.0, likelihood(ratio, 2.0, 3.5))

    @staticmethod
    def _turned(window: Window, card: Card, j: int, position: float) -> float:
        """A position with the two ends exchanged: those of the joint's limits, else those of the data [rad]."""
        limits = window.limits[j]
        if np.isfinite(limits.lower) and np.isfinite(limits.upper):
            return limits.lower + limits.upper - position
        return float(card.row(card.state, 0.0)[j] + card.row(card.state, 1.0)[j]) - position


CAUSES: tuple[type[Cause], ...] = (
    ReadingsMissing, OtherUnits, OtherNormMode, JointOrder, JointZero, GripperScaled, GripperReversed,
)  # fmt: skip
