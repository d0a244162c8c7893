"""Causes in the model's data and training: prompt, starts, speeds, statistics, idle beginnings, a success not seen."""

from __future__ import annotations

from typing import override

import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.card import Card, moving_speed, speed_of
from ibrobot_diagnose.cause import CardCause, Cause, Evidence, in_digits, likelihood
from ibrobot_diagnose.causes.pictures import Pair, pairs
from ibrobot_diagnose.course import begins_to_move
from ibrobot_diagnose.pictures import Shown
from ibrobot_diagnose.window import Times, Window, grips


class OtherPrompt(CardCause):
    """The model was given a task that is not in its data."""

    name = "other_prompt"
    title = "the task is one of the data's"
    explains = frozenset({"stands_still"})
    remedy = "Give the model a task of its data, in the same words: `inference: {prompt: …}`."
    for_episodes = "Drop it, unless the dataset is to teach this task, too: then record some more of it."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        known = [text for text in card.prompts if text]
        if "demonstration" in window.streams:  # the others of a dataset may have the same fault
            most = max(card.prompts.values(), default=0)
            if most < 2:
                return None  # each of the others has a task of its own
            known = [text for text in known if card.prompts[text] > 0.1 * most]
        if not window.prompt or not known or window.prompt in known:
            return None
        asked = any(each.answer.prompt for each in window.asked)
        shown = "; ".join(repr(text) for text in known[:3])
        of_data = f"none of the {len(known)} tasks" if len(known) > 1 else "not the task"
        text = f"The task is {window.prompt!r}, {of_data} of the data: {shown}."
        like = {_plain(text) for text in known}
        return Evidence(text, 1.0, "tasks", 0.5, 0.6 if not asked or _plain(window.prompt) in like else 0.9)


def _plain(text: str) -> str:
    return " ".join(text.lower().replace(".", " ").split())


class UnseenStart(CardCause):
    """The run begins where no demonstration begins."""

    name = "unseen_start"
    title = "the run begins where demonstrations begin"
    needs = frozenset({"motion", "state", "card"})
    explains = frozenset({"unseen_states", "stands_still"})
    remedy = "Bring the arm to the start of the demonstrations before each run, or record episodes that begin here."
    for_episodes = "Drop it, unless runs begin here, too: then record some more that do."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        known = np.flatnonzero(np.isfinite(window.states).all(axis=1))
        if window.joints != card.joints or not len(known):
            return None
        if "demonstration" in window.streams and len(card.starts) < 2:
            return None  # two episodes say nothing of where others begin
        start = window.states[known[0]]
        few = 0.03 if len(card.starts) >= 30 else 0.0  # of many, some begin anywhere
        low, high = np.quantile(card.starts, (few, 1 - few), axis=0)
        # What a policy never saw it has to guess; an episode that begins elsewhere than a few others is usual.
        share = _room(len(card.starts)) if "demonstration" in window.streams else _ROOM
        room = share * (high - low)
        off = np.maximum(np.maximum(low - room - start, start - high - room), 0.0)
        j = int(np.argmax(off))
        text = (
            f"{window.joints[j]} begins at {in_digits(start[j])} rad, {off[j]:.2f} rad outside of the {card.episodes} "
            "demonstrations, "
            f"which begin from {low[j]:.2f} to {high[j]:.2f} rad."
        )
        return Evidence(text, float(off[j]), "rad", 0.1, likelihood(float(off[j]), 0.1, 0.25), 0.0)


_ROOM = 0.25
"""How far beyond the range of the starts a run may begin, as a share of that range."""


def _room(count: int) -> float:
    """How far beyond the range of a few starts the next one may lie, as a share of that range.

    Of starts that are spread evenly, the next one lies farther outside in one case of a hundred: the chance is
    2 / (count + 1) to lie outside at all, and falls with the power count - 1 of the range with its room.
    """
    return max(_ROOM, float((200 / (count + 1)) ** (1 / (count - 1))) - 1)


class UnseenStates(CardCause):
    """The run leaves what the data shows."""

    name = "unseen_states"
    title = "the arm stays where the data was"
    weak = True
    needs = frozenset({"motion", "state", "card"})
    remedy = (
        "See what led the arm there, at the time that is given. If nothing else is wrong, record episodes that begin "
        "there and end well: `ibrobot record` with corrections."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if window.joints != card.joints:
            return None
        low, high = card.row(card.state, 0.0), card.row(card.state, 1.0)
        room = np.maximum(0.15 * (high - low), 0.05)
        states = np.nan_to_num(window.states, nan=float(low.mean()))
        known = np.isfinite(window.states).all(axis=1)
        outside = ((states < low - room) | (states > high + room)) & known[:, None]
        share = float(outside.any(axis=1).mean())
        if not outside.any():
            return None
        j = int(outside.sum(axis=0).argmax())
        since = window.since(int(window.ticks_ns[outside.any(axis=1).argmax()]))
        text = (
            f"{window.joints[j]} left the range of the data ({in_digits(low[j])} to {in_digits(high[j])} rad) from "
            f"{since:.1f} s on; the arm was outside in {100 * share:.0f} % of the run."
        )
        return Evidence(text, 100 * share, "%", 15.0, likelihood(share, 0.15, 0.6), since)


class OtherSpeed(CardCause):
    """The arm moves faster or slower than in the data."""

    name = "other_speed"
    title = "the arm moves as fast as in the data"
    needs = frozenset({"motion", "commands", "card"})
    explains = frozenset({"limits_low", "smoothing_averages"})
    remedy = (
        "Execute chunks at the rate of the data: `contract: {rate_hz: …}` of the robot and of the recordings must "
        "agree; look for a policy that was trained on data that was sampled at another rate."
    )
    for_episodes = "Drop it, unless the task may take as long: a policy learns the speeds of all."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        arm, low, high = moving_speed(window), card.quantile("moving_speed", 0.05), card.quantile("moving_speed", 0.95)
        if window.joints != card.joints or arm <= 0 or low <= 0:
            return None
        model = _chunk_speed(window)
        slow = low / arm > max(arm, model) / high
        factor = low / arm if slow else max(arm, model) / high
        who = "The arm moves" if slow or arm >= model else "The model's answers move the arm"
        text = (
            f"{who} too {'slowly' if slow else 'fast'}: {arm if slow else max(arm, model):.2f} rad/s over all joints, "
            f"in the data {low:.2f} to {high:.2f}."
        )
        return Evidence(
            text, factor, "times", 1.45, likelihood(factor, 1.45, 2.2), explains=frozenset() if slow else None,
            follows=_SLOWS if slow else frozenset(),
        )  # fmt: skip


def _chunk_speed(window: Window) -> float:
    """Speed of the model's answers over the joints, see `speed_of` [rad/s]; 0 without any."""
    speeds = [
        np.abs(np.diff(each.chunk, axis=0)).sum(axis=1) * (1e9 / each.answer.step_ns)
        for each in window.asked
        if each.used and each.answer.joint_names == window.joints
    ]
    return speed_of(np.concatenate([np.zeros(1), *speeds]))


_SLOWS = frozenset({
    "limits_low", "smoothing_averages", "arm_not_following", "plan_dry", "answers_slow", "requests_fail",
    "checkpoint_early",
})  # fmt: skip
"""What makes an arm slow."""


class Statistics(CardCause):
    """The model's actions are not in the range of its data."""

    name = "statistics"
    title = "the model's actions are in the range of its data"
    needs = frozenset({"chunks", "state", "card"})
    explains = frozenset({
        "unseen_states", "limits_low", "arm_not_following", "other_speed", "joint_zero", "gripper_scaled",
        "smoothing_averages", "guard_held",
    })  # fmt: skip
    remedy = (
        "Use the statistics that lie beside the checkpoint: a model that is normalised with the ones of another "
        "dataset, or not at all, acts like this. Export or download the checkpoint again, whole."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        used = [each for each in window.asked if each.used and each.answer.joint_names == card.joints]
        if not used or window.joints != card.joints:
            return None
        chunks = np.concatenate([each.chunk for each in used])
        low, high = card.row(card.action, 0.0), card.row(card.action, 1.0)
        room = np.maximum(0.25 * (high - low), 0.1)
        outside = ((chunks < low - room) | (chunks > high + room)).mean(axis=0)
        first = used[0]
        state = window.state.at(np.array([first.answer.observed_ns]))[0]
        jump = np.abs(first.chunk[0] - state)
        usual = np.maximum(2.0 * card.row(card.lead, 0.99), 0.15)
        ratio = np.nan_to_num(jump / usual)
        begins_inside = bool(((state > low - room) & (state < high + room)).all())
        j = int(np.argmax(ratio))
        text = (
            f"The model's first answer begins {jump[j]:.2f} rad away from where {window.joints[j]} is; in its data "
            "actions are "
            f"up to {card.row(card.lead, 0.99)[j]:.2f} rad away. {100 * outside.max():.0f} % of its actions are "
            "outside of "
            "those of the data."
        )
        details = tuple(
            f"{joint}: answers {a:.2f} to {b:.2f} rad, in the data {c:.2f} to {d:.2f}"
            for joint, a, b, c, d in zip(
                window.joints, chunks.min(axis=0), chunks.max(axis=0), low.tolist(), high.tolist(), strict=True
            )
        )
        number = float(ratio[j]) if begins_inside else 0.0
        likely = min(likelihood(number, 1.5, 3.0), likelihood(float(outside.max()), 0.05, 0.25))
        return Evidence(text, number, "times", 1.5, likely, 0.0, details)


class IdleData(CardCause):
    """Demonstrations begin with time in which nothing moves, and the policy has learned to stand still."""

    name = "idle_data"
    title = "demonstrations begin to move soon"
    needs = frozenset({"card", "commands", "chunks"})
    explains = frozenset({"stands_still"})
    remedy = (
        "Cut the idle beginnings of the demonstrations (`ibrobot episodes trim`, or `ibrobot datasets check` for a "
        "list), and "
        "train again."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        idle, still = card.quantile("idle_start_s", 0.5), begins_to_move(window)
        text = (
            f"Demonstrations stand still for {idle:.1f} s at their beginning, and the policy did for {still:.1f} s: "
            "from a "
            "picture in which nothing happens it has learned to wait."
        )
        both = min(likelihood(idle, 1.2, 2.5), likelihood(still, 2.0, 5.0))
        return Evidence(text, idle, "s", 1.2, both, 0.0)


class CheckpointEarly(CardCause):
    """The model has seen its data too few times."""

    name = "checkpoint_early"
    title = "the model has been trained long enough"
    needs = frozenset({"training card"})
    explains = frozenset({"smoothing_averages", "stands_still"})
    remedy = "Train on: the same `ibrobot train` with more --steps continues from the newest checkpoint."

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        assert card.trained is not None
        try:
            step, steps, batch = (float(card.trained[name]) for name in ("step", "steps", "batch_size"))
        except (KeyError, TypeError, ValueError):
            return None
        passes = step * batch / max(card.frames, 1)
        text = (
            f"The checkpoint is of step {step:.0f} of {steps:.0f}: the model has seen each frame of its data "
            f"{passes:.1f} times; "
            "below 2 is too early."
        )
        return Evidence(text, passes, "times", 2.0, likelihood(passes, 2.0, 0.7))


class UnseenSuccess(CardCause):
    """The run looks like a success, but was judged a failure."""

    name = "unseen_success"
    title = "the judgement agrees with the pictures"
    needs = frozenset({"outcome", "pictures", "card pictures"})
    remedy = (
        "Look at the pictures at that time: if the task was done, the judge is wrong (a threshold of the scene, an "
        "operator's key): `ibrobot episodes mark EPISODE success`."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if window.outcome != "failure" or window.joints != card.joints:
            return None
        best: tuple[float, Pair, int, int] | None = None
        for pair in pairs(window, card):
            owners = [name for name, _ in pair.card.places]
            firsts = [i for i, name in enumerate(owners) if not i or owners[i - 1] != name]
            lasts = [i for i, name in enumerate(owners) if i + 1 == len(owners) or owners[i + 1] != name]
            values = pair.card.thumbnails.astype(np.float32).reshape(len(owners), -1)
            begin, end = values[firsts], values[lasts]
            way = np.median(end, axis=0) - np.median(begin, axis=0)
            way[np.abs(way) < 12.0] = 0.0
            size = float((way**2).sum())
            if size < 400.0 or len(firsts) < 5:
                continue
            scores = [(each - np.median(begin, axis=0)) @ way / size for each in (begin, end)]
            apart = (scores[1].mean() - scores[0].mean()) / (scores[0].std() + scores[1].std() + 1e-3)
            if apart <= 3.0:
                continue
            ended = self._ended(window, card, np.array(pair.camera.times_ns, np.int64))
            shown = pair.camera.small.reshape(len(pair.camera.small), -1)
            along = (shown - np.median(begin, axis=0)) @ way / size
            if ended.any():
                i = int(np.argmax(np.where(ended, along, -np.inf)))
                score = float(np.median(along[ended & (np.abs(np.arange(len(along)) - i) < _BESIDE)]))
                if best is None or score > best[0]:
                    best = score, pair, i, lasts[0]
        if best is None or not _handled(window, card):
            return None
        score, pair, i, last = best
        camera, at_s = pair.camera, window.since(pair.camera.times_ns[i])
        text = (
            f"The run was judged a failure, but at {at_s:.1f} s the arm stands as at the ends of successful episodes, "
            f"and {camera.name} sees what it saw there ({100 * score:.0f} % of the way from their beginnings)."
        )
        kept = min(camera.kept, key=lambda each: abs(each - i))
        beside = (
            Shown(f"{camera.name} at {window.since(camera.times_ns[kept]):.1f} s of this run", camera.kept[kept]),
            Shown(f"{camera.name} at the end in the data: {pair.card.places[last][0]}", pair.card.thumbnails[last]),
        )
        return Evidence(text, 100 * score, "%", 80.0, likelihood(max(score, 0.0), 0.8, 0.95), at_s, pictures=beside)

    @staticmethod
    def _ended(window: Window, card: Card, times_ns: Times) -> NDArray[np.bool_]:
        """At which times the arm stands where episodes of the data end."""
        states = window.state.at(times_ns)
        low, high = card.ends.min(axis=0), card.ends.max(axis=0)
        room = 0.05 + 0.25 * (high - low)
        with np.errstate(invalid="ignore"):
            result: NDArray[np.bool_] = ((states >= low - room) & (states <= high + room)).all(axis=1)
        return result


_BESIDE = 3
"""Pictures before and after the one that looks most like an end, of which the middle one counts."""
_GAP = 0.05
"""How far a gripper that holds something stays from its command [rad]."""


def _handled(window: Window, card: Card) -> bool:
    """Whether the gripper held something, if it does in the data: an arm that ends there with nothing has done nothing.

    A gripper that holds something does not reach its command.
    """
    for j in (i for i, joint in enumerate(card.joints) if grips(joint)):
        usual = float(card.row(card.lead, 0.95)[j])
        if usual < _GAP:
            continue
        gaps = np.abs(window.commands[:, j] - window.states[:, j])
        gaps = gaps[np.isfinite(gaps)]
        if not len(gaps) or float((gaps > 0.5 * usual).mean()) < _HELD:
            return False
    return True


_HELD = 0.05
"""Share of a run from which a gripper has held something, and not only moved."""


CAUSES: tuple[type[Cause], ...] = (
    OtherPrompt, UnseenStart, UnseenStates, OtherSpeed, Statistics, IdleData, CheckpointEarly, UnseenSuccess,
)  # fmt: skip
