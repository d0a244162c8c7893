"""Causes: what they need, and what they find."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast, override

import attrs

from ibrobot_core.api import Descriptor, Options

if TYPE_CHECKING:
    from ibrobot_diagnose.ask_again import Examined
    from ibrobot_diagnose.card import Card
    from ibrobot_diagnose.pictures import Shown
    from ibrobot_diagnose.window import Window

KIND = "cause"
"""The kind of plugin, with the hook `ibrobot_causes`."""
ARM_VIEW = "arm_view"
"""The kind of what draws the arm in a camera, with the hook `ibrobot_arm_views`; see `arm_view.ArmView`.

Its `make` takes a `RobotConfig`, the name of a camera's peripheral, its `CameraInfo` or None, and height and width of
the pictures [pixels]. It returns an `ArmView`, or raises an `IbrobotError` that says what is missing.
"""
DEVICE_POSE = "device_pose"
"""The kind of what tells where a teleoperation device stands, by the type of the device; hook `ibrobot_device_poses`.

Its `make` takes the options of the device and a context with the part of the robot that it moves. It returns joint of
the robot -> position [rad], or raises an `IbrobotError`.
"""
ACCUSED = 0.5
"""Likelihood from which a cause is named."""
_FAILED = 0.85
"""Likelihood from which a rig fails, for causes that state no number for it."""
OWN_NAMES = frozenset({
    "answers_slow", "answers_tremble", "arm_not_following", "bgr", "calibration_odd", "camera_ignored",
    "camera_missing", "camera_moved", "camera_options", "camera_slow", "camera_unknown", "cameras_exchanged",
    "checkpoint_early", "duplicate", "gripper_idle", "gripper_reversed", "gripper_scaled", "guard_held",
    "idle_data", "idle_end", "idle_start", "jerk", "joint_order", "joint_zero", "joints_unwell", "leader_apart",
    "limits_low", "loop_slow", "not_judged", "observation_late", "odd_length", "odd_path", "other_calibration",
    "other_contract", "other_gripper", "other_model", "other_norm_mode", "other_prompt", "other_rate",
    "other_resolution", "other_robot", "other_speed", "other_units", "other_versions", "picture_black",
    "picture_blurred", "picture_bright", "picture_covered", "picture_dark", "picture_flipped", "picture_frozen",
    "picture_gaps", "plan_dry", "readings_missing", "requests_fail", "saturated", "smoothing_averages", "stall",
    "stands_still", "statistics", "takeover", "ticks_missed", "unseen_pictures", "unseen_start", "unseen_states",
    "unseen_success", "white_balance", "zero_shifted",
})  # fmt: skip
"""Names of the causes of this package, which no other can have. Discovery needs them, and imports no cause."""
type Verdict = Literal["ok", "warn", "fail", "cannot tell"]


_text: Any = attrs.validators.instance_of(str)
_number: Any = attrs.validators.instance_of(cast(Any, Real))


@attrs.frozen(eq=False)
class Evidence:
    """What a cause found. A field of another type is a TypeError."""

    text: str = attrs.field(validator=_text)
    """One sentence with the number; it begins the report if the cause is the most probable one."""
    number: float = attrs.field(validator=_number)
    unit: str = attrs.field(validator=_text)
    threshold: float = attrs.field(validator=_number)
    """The cause is accused if the number is on the wrong side of it."""
    likelihood: float = attrs.field(validator=_number)
    """0 to 1; from 0.5 on the cause is named."""
    since_s: float | None = attrs.field(default=None, validator=attrs.validators.optional(_number))
    """From when on [s], since the beginning of the window; None if it applies throughout."""
    details: tuple[str, ...] = attrs.field(
        default=(), validator=attrs.validators.deep_iterable(_text, attrs.validators.instance_of((tuple, list)))
    )
    """Further evidence, a line each."""
    explains: frozenset[str] | None = None
    """In place of those of the cause, if they depend on what was found."""
    follows: frozenset[str] = frozenset()
    """Names of further causes that bring this about."""
    pictures: tuple[Shown, ...] = ()
    fails: float | None = None
    """The number from which a rig is not fit to be used; None if the likelihood says it."""
    unclear: str = ""
    """Why it is uncertain; empty if it is not."""

    @property
    def verdict(self) -> Verdict:
        """What it says of a rig."""
        if self.unclear:
            return "cannot tell"
        if self.likelihood < ACCUSED:
            return "ok"
        failed = self.likelihood >= _FAILED if self.fails is None else self.number >= self.fails
        return "fail" if failed else "warn"


@attrs.frozen(eq=False)
class Reference:
    """What a window is compared with."""

    card: Card | None = None
    """The card of the model's data, or of the other episodes of a dataset."""
    model: Examined | None = None
    """What the model answers when it is asked again."""

    @property
    def streams(self) -> frozenset[str]:
        """Names of what it has, as in `Cause.needs`."""
        card = self.card
        has = {
            "card": card is not None, "card pictures": card is not None and bool(card.cameras),
            "training card": card is not None and card.trained is not None, "model": self.model is not None,
            "rig card": card is not None and card.rig is not None,
        }  # fmt: skip
        return frozenset(name for name, there in has.items() if there)


class Cause(ABC):
    """A reason why a run goes wrong, or an episode is bad.

    It does not know whether the window is a live rig, a recording or an episode of a dataset.
    """

    name: ClassVar[str]
    """Its name in JSON, e.g. `camera_moved`."""
    title: ClassVar[str]
    """The condition in which nothing is wrong, for the list of what is healthy, e.g. `cameras stand as in training`."""
    needs: ClassVar[frozenset[str]] = frozenset()
    """The streams of the window and the reference that it needs: `state`, `commands`, `answers`, `chunks` (used ones),
    `pictures`, `guard`, `outcome`, `demonstration`, `motion`, `rig` (at rest); `card`, `card pictures`, `rig card`,
    `training card`; `model`."""
    explains: ClassVar[frozenset[str]] = frozenset()
    """Names of causes that this one brings about: those are consequences if this one is found."""
    weak: ClassVar[bool] = False
    """Whether it speaks of a policy that errs, and not of the set-up: more or better data is what helps."""
    mends: ClassVar[Literal["drop", "trim start", "trim end", "judge"]] = "drop"
    """What mends an episode of a dataset with it."""
    remedy: ClassVar[str]
    """What to do, in the imperative."""
    for_episodes: ClassVar[str] = ""
    """What to do with an episode of a dataset, if it is not the remedy."""

    @classmethod
    def to_do_with_episode(cls) -> str:
        """What to do with an episode of a dataset that has this cause."""
        if cls.for_episodes or "demonstration" in cls.needs:
            return cls.for_episodes or cls.remedy
        return f"Drop it, unless the runs will be like it. Before the next recordings: {cls.remedy}"

    @abstractmethod
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        """Evidence for this cause; None if nothing points to it."""


class CardCause(Cause):
    """A cause that compares a window with the card of the model's data."""

    needs = frozenset({"card"})

    @abstractmethod
    def compare(self, window: Window, card: Card) -> Evidence | None:
        """As `test`, with the card."""

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        assert reference.card is not None
        return self.compare(window, reference.card)


class ModelCause(Cause):
    """A cause that looks at what the model answers when it is asked again."""

    needs = frozenset({"model"})

    @abstractmethod
    def compare(self, window: Window, model: Examined) -> Evidence | None:
        """As `test`, with the answers."""

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        assert reference.model is not None
        return self.compare(window, reference.model)


@attrs.frozen
class CauseDescriptor(Descriptor[Cause]):
    """A cause of another package. Its type is the `name` of the cause; a cause has no options."""

    make: Callable[[], Cause] = attrs.field(kw_only=True)  # type: ignore[assignment]

    @override
    def mistakes(self) -> Iterator[str]:
        yield from super().mistakes()
        if self.type in OWN_NAMES:
            yield "ibrobot-plugin-diagnose has a cause of this name: give yours another"
        if self.options is not Options:
            yield "options: nothing sets options of a cause; leave them out, and make its numbers constants"


@attrs.frozen(eq=False)
class Finding:
    """A cause with its evidence."""

    cause: Cause
    evidence: Evidence

    @property
    def name(self) -> str:
        """Name of the cause."""
        return self.cause.name

    def explains(self, other: Finding) -> bool:
        """Whether it brings the other one about."""
        known = self.cause.explains if self.evidence.explains is None else self.evidence.explains
        return other.name in known or self.name in other.evidence.follows


@attrs.frozen(eq=False)
class Diagnosis:
    """The result for a window."""

    findings: tuple[Finding, ...]
    """The accused causes, most probable first."""
    healthy: tuple[tuple[str, str], ...]
    """Name and title of the causes that were tested and not accused."""
    untested: tuple[tuple[str, str], ...]
    """Name of the causes that could not be tested, and why."""
    measured: tuple[Finding, ...] = ()
    """The evidence of healthy causes, as far as there is any."""
    broken: tuple[tuple[str, str], ...] = ()
    """Those of the untested that have a mistake, and the plugins that failed, which may offer causes."""

    def source_of(self, number: int) -> int | None:
        """Index of the first earlier finding that explains this one; None if there is none."""
        finding = self.findings[number]
        return next((i for i, each in enumerate(self.findings[:number]) if each.explains(finding)), None)

    @property
    def first(self) -> str:
        """Name of the most probable cause; empty if none is accused."""
        return self.findings[0].name if self.findings else ""


def in_digits(angle: float) -> str:
    """An angle with two digits, and no sign if these are zero."""
    return f"{round(float(angle), 2) + 0.0:.2f}"


_SLOPE = math.log(0.95 / 0.05)


def likelihood(number: float, threshold: float, certain: float) -> float:
    """Likelihood of a number: 0.5 at the threshold, 0.95 where it is `certain`, logistic in their logarithms.

    `certain` below the threshold means that small numbers are suspicious.
    """
    if not math.isfinite(number):
        return 0.0
    tiny = 1e-9
    place = math.log(max(number, tiny) / threshold) / math.log(certain / threshold)
    return 1 / (1 + math.exp(-_SLOPE * max(-20.0, min(20.0, place))))
