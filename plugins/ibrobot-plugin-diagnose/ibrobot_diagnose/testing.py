"""For tests of causes: windows from arrays, the conformance suite, and a small cause; they need `ibrobot-testing`."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from ibrobot_testing.suite import Suite
from numpy.typing import ArrayLike, NDArray

from ibrobot_core.api import (
    JOINT_STATES,
    MODEL_ANSWERS,
    NS_PER_S,
    ActionPart,
    CameraInfo,
    Context,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    Feature,
    Float64MultiArray,
    Header,
    Image,
    JointState,
    Message,
    ModelAnswer,
    ObservationPart,
    Options,
    Recorded,
    TopicSummary,
    Vector,
    ns,
)
from ibrobot_core.app import Align, RobotConfig
from ibrobot_diagnose.cause import ACCUSED, Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.diagnosis import STREAMS, diagnose
from ibrobot_diagnose.window import Track, Window, read_window

START_NS = 1_700_000_000 * NS_PER_S
_COMMANDS = "/commands"


@attrs.frozen(eq=False)
class Answer:
    """What a model answered to a request."""

    tick: int
    """Number of the tick whose observations it saw, from 0."""
    chunk: NDArray[np.float64]
    """The actions from that tick on [rad], shape (N, J)."""
    latency: float = 0.05
    """Time from the tick until the answer came [s]."""
    outcome: str = "used"


def make_window(
    states: ArrayLike, commands: ArrayLike | None = None, *, joints: Sequence[str] = (), rate_hz: float = 30.0,
    answers: Sequence[Answer] = (), pictures: Mapping[str, NDArray[np.uint8]] | None = None,
    document: Mapping[str, Any] | None = None, outcome: str = "failure", name: str = "made",
) -> Window:  # fmt: skip
    """The window of a recording with these numbers, one at each tick.

    Args:
        states: measured positions [rad], shape (T, J).
        commands: commands [rad], shape (T, J); None for those that are measured.
        joints: their names; `joint1`, `joint2`, … if empty.
        rate_hz: rate of the contract [Hz].
        answers: of a model; none for a demonstration.
        pictures: camera -> its pictures, shape (T, H, W, 3), RGB.
        document: the robot YAML as plain values, e.g. with limits of the joints and the mode `work`.
        outcome: `success`, `failure` or `unknown`.
        name: of the recording.
    """
    measured = np.asarray(states, np.float64)
    commanded = measured if commands is None else np.asarray(commands, np.float64)
    if measured.ndim != 2 or commanded.shape != measured.shape:
        raise ValueError(f"states and commands must have one shape (T, J), got {measured.shape} and {commanded.shape}")
    names = tuple(joints) or tuple(f"joint{i + 1}" for i in range(measured.shape[1]))
    contract = _contract(names, rate_hz, pictures or {})
    messages = sorted(_messages(contract, names, measured, commanded, answers, pictures or {}), key=lambda m: m[0])
    metadata = {
        "contract": json.dumps(contract.canonical()), "config": json.dumps(dict(document or {})), "mode": "work",
    }  # fmt: skip
    return read_window(_Made(name, messages, metadata, outcome), name)


def _contract(joints: Sequence[str], rate_hz: float, pictures: Mapping[str, NDArray[np.uint8]]) -> Contract:
    state = ObservationPart(
        "observation.state", JOINT_STATES, JointState.ros_type, tuple(f"position.{each}" for each in joints), None,
        Align(), Feature("float32", (len(joints),), tuple(f"{each}.pos" for each in joints)),
    )  # fmt: skip
    action = ActionPart("work", _COMMANDS, Float64MultiArray.ros_type, "hold", tuple(joints))
    document = Contract(rate_hz, (state,), (action,)).canonical()
    (part,) = document["observations"]["observation.state"]
    for camera, shown in pictures.items():
        image = {"topic": f"/camera/{camera}", "type": Image.ros_type, "encoding": "rgb8", "shape": shown.shape[1:]}
        document["observations"][f"observation.images.{camera}"] = [{**part, **image}]
    return Contract.from_canonical(document)


def _messages(
    contract: Contract, joints: tuple[str, ...], states: Vector, commands: Vector, answers: Sequence[Answer],
    pictures: Mapping[str, NDArray[np.uint8]],
) -> Iterator[tuple[int, str, Message]]:  # fmt: skip
    """Time of receipt [ns], topic and message of all that was recorded."""
    for tick, (state, command) in enumerate(zip(states, commands, strict=True)):
        t_ns = START_NS + tick * contract.step_ns
        yield t_ns, JOINT_STATES, JointState(Header(t_ns), joints, state)
        yield t_ns, _COMMANDS, Float64MultiArray(command)
        for camera, shown in pictures.items():
            height, width, _ = shown[tick].shape
            yield (
                t_ns,
                f"/camera/{camera}",
                Image(Header(t_ns, camera), height, width, "rgb8", 3 * width, shown[tick].ravel()),
            )
    for number, each in enumerate(answers, start=1):
        seen_ns = START_NS + each.tick * contract.step_ns
        t_ns, took_ms = seen_ns + ns(each.latency), 1e3 * each.latency
        yield (
            t_ns,
            MODEL_ANSWERS,
            ModelAnswer(
                Header(t_ns), number, seen_ns, "net", "", "", "", each.outcome, "", took_ms, took_ms, 0.0,
                contract.step_ns, joints, np.asarray(each.chunk, np.float64).ravel(),
            ),
        )  # fmt: skip


class _Made(EpisodeReader):
    """A recording that was made in memory."""

    def __init__(
        self, name: str, messages: Sequence[tuple[int, str, Message]], metadata: Mapping[str, str], outcome: str
    ) -> None:
        self._name, self._metadata, self._outcome = name, metadata, outcome
        self._messages = [Recorded(topic, message, t_ns, t_ns) for t_ns, topic, message in messages]

    @override
    def summary(self) -> EpisodeSummary:
        counts: dict[str, TopicSummary] = {}
        for item in self._messages:
            count = counts[item.topic].count if item.topic in counts else 0
            counts[item.topic] = TopicSummary(item.message.ros_type, count + 1)
        times = [item.received_ns for item in self._messages] or [0]
        return EpisodeSummary(
            Path(self._name), True, times[0], times[-1], counts, self._metadata, self._outcome, self._outcome
        )

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        return (item for item in self._messages if topics is None or item.topic in topics)

    @override
    def digest(self) -> str:
        return self._name

    @override
    def close(self) -> None:
        pass


class CauseSuite(Suite[Cause]):
    """Checks of every `Cause`. The subclass defines `accused` and `healthy`."""

    def accused(self) -> Sequence[Window]:
        """Windows in which the cause is at work, e.g. mildly and strongly."""
        raise NotImplementedError(f"{type(self).__name__} must define accused(self)")

    def healthy(self) -> Sequence[Window]:
        """Windows in which it is not, among them one that is near to it."""
        raise NotImplementedError(f"{type(self).__name__} must define healthy(self)")

    def reference(self) -> Reference:
        """What the windows are compared with; override it for a cause that needs a card or a model."""
        return Reference()

    def subject(self) -> Cause:
        """A new cause."""
        return self.make(self.context())

    def _windows(self) -> list[Window]:
        return [*self.accused(), *self.healthy()]

    def test_says_what_it_is(self) -> None:
        """Name, title and remedy are as reports show them, and what it needs exists."""
        cause = self.subject()
        assert re.fullmatch(r"[a-z][a-z0-9_]*", cause.name), f"name {cause.name!r} must be as camera_moved"
        assert cause.title[:1].islower(), f"title {cause.title!r} stands in a list: begin it with a small letter"
        assert not cause.title.endswith("."), f"title {cause.title!r} is no sentence: no full stop"
        assert cause.remedy.endswith("."), f"remedy {cause.remedy!r} is a sentence: end it with a full stop"
        assert isinstance(cause.needs, frozenset), f'needs is {cause.needs!r}: write it as frozenset({{"commands"}})'
        unknown = cause.needs - STREAMS
        assert not unknown, f"needs {', '.join(sorted(unknown))}; available: {', '.join(sorted(STREAMS))}"

    def test_is_tested_on_all_windows(self) -> None:
        """Each window has what the cause needs, so that the other checks mean something."""
        cause, reference = self.subject(), self.reference()
        for window in self._windows():
            lacking = cause.needs - window.streams - reference.streams
            assert not lacking, f"window {window.name} has no {', '.join(sorted(lacking))}, which the cause needs"

    def test_is_accused_where_it_is_at_work(self) -> None:
        """The evidence is likely, and a sentence with a finite number."""
        for window in self.accused():
            evidence = self.subject().test(window, self.reference())
            assert evidence is not None, f"window {window.name} gives no evidence"
            assert ACCUSED <= evidence.likelihood <= 1, f"window {window.name}: likelihood {evidence.likelihood}"
            assert np.isfinite(evidence.number), f"window {window.name}: number {evidence.number}"
            assert evidence.text.endswith("."), f"{evidence.text!r} is no sentence"

    def test_is_not_accused_where_all_is_well(self) -> None:
        """A healthy window gives no evidence, or an unlikely one."""
        for window in self.healthy():
            evidence = self.subject().test(window, self.reference())
            likely = 0.0 if evidence is None else evidence.likelihood
            assert 0 <= likely < ACCUSED, f"window {window.name}: likelihood {likely}, {evidence and evidence.text}"

    def test_since_lies_in_the_window(self) -> None:
        """`since_s` is counted from the beginning of the window."""
        for window in self.accused():
            evidence = self.subject().test(window, self.reference())
            if evidence is not None and evidence.since_s is not None:
                assert 0 <= evidence.since_s <= window.seconds, f"since {evidence.since_s} s of {window.seconds} s"

    def test_equal_windows_give_equal_evidence(self) -> None:
        """Whatever it has tested before."""
        cause, windows = self.subject(), self._windows()
        first = [cause.test(window, self.reference()) for window in windows]
        for window, before in zip(reversed(windows), reversed(first), strict=True):
            for again in (cause, self.subject()):
                assert _plain(again.test(window, self.reference())) == _plain(before)

    def test_changes_nothing(self) -> None:
        """The arrays of the window are as they were: other causes see them, too."""
        for window in self._windows():
            before = [each.copy() for each in _arrays(window)]
            self.subject().test(window, self.reference())
            for kept, now in zip(before, _arrays(window), strict=True):
                np.testing.assert_array_equal(kept, now, err_msg=f"the cause changed window {window.name}")

    def test_takes_gaps_and_short_windows(self) -> None:
        """Positions that nobody measured are NaN, and a run may end at once: no error, and nobody is accused of it."""
        cause, reference = self.subject(), self.reference()
        for window in self._windows():
            for short in (_first(window, 2), _first(window, 3)):
                diagnose(short, reference, [cause])
        for window in self.healthy():
            named = diagnose(_with_gaps(window), reference, [cause]).first
            assert not named, f"window {window.name} with readings left out accuses it"


def _plain(evidence: Evidence | None) -> Any:
    return evidence and (evidence.text, evidence.number, evidence.likelihood, evidence.since_s, evidence.details)


def _arrays(window: Window) -> list[NDArray[Any]]:
    answers = [each.chunk for each in window.asked]
    return [window.ticks_ns, window.state.values, window.command.values, window.states, window.commands, *answers]


def _cut(track: Track, count: int) -> Track:
    return Track(track.names, track.times_ns[:count], track.stamps_ns[:count], track.values[:count])


def _first(window: Window, ticks: int) -> Window:
    """The first ticks of a window."""
    end_ns = window.ticks_ns[:ticks][-1]
    answers = tuple(each for each in window.asked if each.answer.header.stamp_ns <= end_ns)
    state, command = _cut(window.state, ticks), _cut(window.command, ticks)
    return attrs.evolve(
        window, ticks_ns=window.ticks_ns[:ticks], state=state, command=command, asked=answers, cameras={}
    )


def _with_gaps(window: Window) -> Window:
    """A window in which nothing is known of every fifth reading and command."""

    def gaps(track: Track) -> Track:
        values = track.values.copy()
        values[::5] = np.nan
        return attrs.evolve(track, values=values)

    return attrs.evolve(window, state=gaps(window.state), command=gaps(window.command))


class FakeCause(Cause):
    """A joint is commanded to and fro."""

    name = "fake"
    title = "no joint is commanded to and fro"
    needs = frozenset({"commands"})
    remedy = "Look at what commands the joint: a device may be noisy, or a policy undecided."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        commands = window.commands[np.isfinite(window.commands).all(axis=1)]
        if len(commands) < 3 or not window.seconds:
            return None
        steps = np.diff(commands, axis=0)
        rates = (steps[1:] * steps[:-1] < 0).sum(axis=0) / window.seconds
        worst = int(np.argmax(rates))
        rate = float(rates[worst])
        text = f"{window.joints[worst]} is commanded to turn around {rate:.1f} times per second."
        return Evidence(text, rate, "1/s", 4.0, likelihood(rate, 4.0, 8.0))


class FakeArmView:
    """Draws a stripe that moves with the first joint.

    Args:
        robot: the robot.
        camera: name of the camera's peripheral.
        info: what the camera says of itself; None if nothing.
        size: height and width of the pictures [pixels].
    """

    stands = True

    def __init__(self, robot: RobotConfig, camera: str, info: CameraInfo | None, size: tuple[int, int]) -> None:
        self._size = size

    def moving(self, positions: Vector) -> NDArray[np.bool_]:
        """Where something may move against the camera, for positions of the joints [rad]; shape (H, W)."""
        height, width = self._size
        seen = np.zeros(self._size, np.bool_)
        middle = round(width * (0.5 + 0.25 * float(np.sin(positions[0]))))
        seen[:, max(0, middle - height // 8) : middle + height // 8] = True
        return seen

    def close(self) -> None:
        """Release what it holds."""


def fake_pose(options: Options, ctx: Context) -> Mapping[str, float]:
    """Where the device stands: joint of the robot -> position [rad]."""
    return dict.fromkeys(ctx.robot.joint_names, 0.0)
