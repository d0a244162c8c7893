"""Each planted fault is named first, and healthy runs accuse nobody."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_diagnose import diagnosis
from ibrobot_diagnose.card import make_card
from ibrobot_diagnose.cause import KIND, OWN_NAMES, Cause, CauseDescriptor, Evidence, Reference
from ibrobot_diagnose.causes import all_causes
from ibrobot_diagnose.causes.data import UnseenStates
from ibrobot_diagnose.causes.joints import like_poses
from ibrobot_diagnose.causes.motion import AnswersTremble, SmoothingAverages
from ibrobot_diagnose.causes.others import TOOLS
from ibrobot_diagnose.causes.pictures import pairs
from ibrobot_diagnose.commands import check
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.report import Explanation
from ibrobot_diagnose.testing import Answer, make_window
from ibrobot_diagnose.window import Window
from made_runs import Run, window_of
from numpy.typing import NDArray
from planted_faults import DEMONSTRATED, JOINTS, PICTURES, TIMES, of_top

from ibrobot_core.api import Late, Options, option
from ibrobot_core.plugins import Entry, Failure, Registry

ONE: dict[str, Any] = {"cameras": ("top",), "camera_hz": 5.0, "seconds": 5}
BOTH: dict[str, Any] = {"camera_hz": 5.0, "seconds": 5}
NONE: dict[str, Any] = {"cameras": (), "seconds": 6}
SHOWN = dict.fromkeys(PICTURES, ONE) | dict.fromkeys(JOINTS, NONE) | {"joint_zero": ONE, "cameras_exchanged": BOTH}
"""What a run of each fault shows."""


@pytest.fixture(scope="module")
def data() -> Reference:
    """Ten demonstrations."""
    demos = (Run(seed=each, acts=False, seconds=7, camera_hz=5.0) for each in range(10))
    return Reference(make_card(window_of(each, f"demo_{each.seed}") for each in demos))


def first_of(run: Run, reference: Reference) -> str:
    return diagnose(window_of(run), reference).first


def explained_by(window: Window, reference: Reference) -> str:
    """The cause that is named first, if it brings about all others that are found, but for those of a weak policy."""
    found = diagnose(window, reference).findings
    followed = {0}
    for number, each in enumerate(found):
        if any(found[source].explains(each) for source in followed if source < number):
            followed.add(number)
    others = [each.name for number, each in enumerate(found) if number not in followed and not each.cause.weak]
    return f"{found[0].name}, but also {others}" if others else found[0].name


@pytest.mark.parametrize("cause", TIMES)
def test_planted_fault_is_named_first(cause):
    mild, _, strong = (
        Run(seed=9000 + number, cameras=(), outcome="failure", **each) for number, each in enumerate(TIMES[cause])
    )
    assert first_of(mild, Reference()) == cause
    assert explained_by(window_of(strong), Reference()) == cause


@pytest.mark.parametrize("cause", [*PICTURES, *JOINTS])
def test_planted_fault_is_named_first_with_the_data(cause, data):
    planted: dict[str, tuple[dict[str, Any], ...]] = PICTURES | JOINTS
    mild, _, strong = (
        Run(**{**SHOWN[cause], "seed": 9010 + number, "outcome": "failure", **each})
        for number, each in enumerate(planted[cause])
    )
    assert explained_by(window_of(strong), data) == cause
    if planted[cause][0] is not planted[cause][2]:
        assert first_of(mild, data) in (cause, ""), "a mild fault may be missed, but accuses no other cause"


def changed(reference: Reference, **facts: Any) -> Reference:
    """The reference with another card."""
    assert reference.card is not None
    return Reference(attrs.evolve(reference.card, **facts))


def idle_data(data: Reference) -> tuple[Window, Reference]:
    """Demonstrations that begin with 3 s in which nothing moves, and a policy that has learned to wait."""
    demos = (Run(seed=each, acts=False, seconds=10, cameras=(), idle_s=3.0) for each in range(10))
    run = Run(seed=9501, outcome="failure", cameras=(), idle_s=5.5, seconds=9)
    return window_of(run), Reference(make_card(map(window_of, demos)))


def other_norm_mode(data: Reference) -> tuple[Window, Reference]:
    """A robot YAML that gives the model degrees."""
    window = plain_run()
    document = json.dumps({**window.document, "models": {"act": {"norm_mode": "degrees"}}})
    metadata = {**window.metadata, "config": document}
    return attrs.evolve(window, metadata=metadata), changed(data, norm_mode="radians")


@cache
def plain_run() -> Window:
    window: Window = window_of(Run(seed=9500, outcome="failure", **NONE))
    return window


OF_THE_DATA: dict[str, Callable[[Reference], tuple[Window, Reference]]] = {
    "other_rate": lambda data: (plain_run(), changed(data, rate_hz=15.0)),
    "checkpoint_early": lambda data: (plain_run(), changed(data, trained={"step": 20, "steps": 20, "batch_size": 8})),
    "idle_data": idle_data,
    "other_norm_mode": other_norm_mode,
}
"""Cause -> a run and its model's data, which only this cause explains."""
ELSEWHERE = {
    "other_model": "tests/lerobot/test_ask_again.py", "camera_ignored": "tests/lerobot/test_ask_again.py",
    "answers_tremble": "test_answers_of_noise_are_a_weak_policy",
    "unseen_states": "test_arm_that_leaves_the_data_for_no_other_reason_is_a_weak_policy",
    "unseen_success": "test_a_success_judged_a_failure_held_something_and_ends_as_the_data_does",
    "unseen_pictures": "test_scene_that_the_data_does_not_have_is_named",
}  # fmt: skip
"""Cause -> where its planted case is."""


@pytest.mark.parametrize("cause", OF_THE_DATA)
def test_planted_fault_of_the_data_is_named_first(cause, data):
    assert explained_by(*OF_THE_DATA[cause](data)) == cause


def test_scene_that_the_data_does_not_have_is_named(data):
    """Other furniture, in colours that the data has, too."""
    scene = np.kron(np.random.default_rng(0).integers(20, 235, (6, 8, 3)), np.ones((12, 12, 1))).astype(np.uint8)

    def other(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return (0.2 * picture + 0.8 * scene).astype(np.uint8)

    run = Run(seed=9520, outcome="failure", picture=of_top(other), **ONE)
    assert "unseen_pictures" in {each.name for each in diagnose(window_of(run), data).findings}


def test_every_cause_of_a_run_or_an_episode_has_a_planted_case():
    of_rigs = {each.name for each in all_causes() if "rig" in each.needs}
    tools = {each.name for each in TOOLS}
    planted = {*TIMES, *PICTURES, *JOINTS, *OF_THE_DATA, *ELSEWHERE, *DEMONSTRATED, "odd_length", "odd_path"}
    assert {each.name for each in all_causes()} - of_rigs - tools == planted


def test_healthy_runs_accuse_nobody():
    runs = [Run(seed=seed, cameras=(), latency_s=0.02 + 0.003 * (seed % 50)) for seed in range(9100, 9125)]
    assert Counter(first_of(run, Reference()) for run in runs) == {"": 25}


def test_a_guard_that_held_nothing_back_is_healthy():
    window = attrs.evolve(window_of(Run(seed=9201, cameras=(), guarded=(0.2, 0.8))), guarded=())
    assert "guard" in window.streams
    assert "guard_held" in {name for name, _ in diagnose(window, Reference()).healthy}


@pytest.mark.parametrize("cause", ["statistics", "other_units", "joint_order", "gripper_reversed"])
def test_a_guard_that_held_an_arm_back_which_is_misled_comes_after_what_misleads_it(cause, data):
    run = Run(seed=9203, outcome="failure", guarded=(0.1, 0.9), **NONE, **JOINTS[cause][2])
    named = [each.name for each in diagnose(window_of(run), data).findings]
    assert named[0] == cause
    assert "guard_held" in named


@pytest.mark.parametrize("label", ["no JSON", "[]", "{}", "3", '{"first": 1}'])
def test_a_label_of_another_guard_is_shown_as_it_is(label):
    window = window_of(Run(seed=9200, cameras=(), guarded=(0.2, 0.8)))
    said = ((window.start_ns, label), (int(window.ticks_ns[-1]), ""))
    (first, *_) = diagnose(attrs.evolve(window, guarded=said), Reference()).findings
    assert first.name == "guard_held"
    assert f"between {label}." in first.evidence.text


def test_a_guard_that_said_nothing_is_no_cause() -> None:
    window = window_of(Run(seed=9200, cameras=(), guarded=(0.2, 0.8)))
    report = diagnose(attrs.evolve(window, guarded=()), Reference())
    assert "guard_held" not in {each.name for each in report.findings}


@pytest.mark.parametrize("outcome", ["success", "failure"])
def test_healthy_runs_accuse_nobody_with_the_data(outcome, data):
    runs = [Run(seed=seed, drift=0.01, outcome=outcome, **BOTH) for seed in range(9200, 9203)]
    assert Counter(first_of(run, data) for run in runs) == {"": 3}


def test_each_cause_says_what_to_do():
    for cause in all_causes():
        assert cause.remedy.endswith("."), cause.name
        assert cause.title[0].islower(), cause.name
        assert cause.explains <= {each.name for each in all_causes()} | {"camera_ignored"}, cause.name


@pytest.mark.parametrize(
    ("offsets", "named"),
    [
        ([0.3, -0.3] * 8, True),
        ([0.3, 0.3, -0.3, -0.3, 0.3, -0.3, -0.3] * 3, True),
        ([0.4, -0.4, 0.4, 0.1] + [0.1] * 12, False),
        ([0.1 * each for each in range(16)], False),
    ],
    ids=["in turn", "now one, now the other", "a few times at the beginning", "a drift"],
)
def test_only_answers_of_two_intentions_are_averaged(offsets, named):
    """Whatever one large change among them does, and however large the share that is torn."""
    times = np.arange(10 * len(offsets) + 40) / 30
    path = np.stack([np.sin(times), np.cos(times)], axis=1)
    answers = [
        Answer(10 * i, path[10 * i : 10 * i + 40] + np.array([off, 0.0]), latency=0.02) for i, off in enumerate(offsets)
    ]
    window = make_window(path, path, answers=answers)
    first = diagnose(window, Reference(), [SmoothingAverages()]).first
    assert first == ("smoothing_averages" if named else "")


def test_arm_that_does_not_follow_comes_before_the_guard_that_then_holds_it():
    """The guard holds commands back, and an arm without a fault follows those."""
    window = window_of(Run(seed=9302, cameras=(), gain={0: 0.5}, guarded=(0.5, 0.8)))
    assert [each.name for each in diagnose(window, Reference()).findings] == ["arm_not_following", "guard_held"]


def test_gripper_that_holds_something_is_no_fault():
    held = window_of(Run(seed=9300, cameras=(), gain={3: 0.6}))
    assert diagnose(held, Reference()).first == ""


def test_gripper_that_never_moves_is_one():
    shut = window_of(Run(seed=9301, cameras=(), slack={3: 5.0}))
    first = diagnose(shut, Reference()).findings[0]
    assert (first.name, "gripper" in first.evidence.text) == ("arm_not_following", True)


def test_of_two_causes_the_one_that_explains_the_other_comes_first():
    slow = diagnose(window_of(Run(seed=9302, cameras=(), latency_s=0.8)), Reference())
    assert [each.name for each in slow.findings][:2] == ["answers_slow", "plan_dry"]
    assert slow.findings[0].evidence.likelihood < slow.findings[1].evidence.likelihood


def placed(camera: str, picture: NDArray[Any], t_s: float) -> NDArray[Any]:
    """A block that is bright once it stands where it belongs."""
    shown = picture.copy()
    shown[50:66, 70:86] = 250 if t_s > 3.2 else 20
    return shown


HOLDS: dict[str, Any] = {"gain": {3: 0.6}, "picture": placed, **ONE, "seconds": 7}
"""A gripper that closes on something, which then stands elsewhere."""


@pytest.fixture(scope="module")
def placing() -> Reference:
    demos = (Run(seed=each, acts=False, **HOLDS) for each in range(10))
    return Reference(make_card(window_of(each, f"demo_{each.seed}") for each in demos))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        pytest.param({"outcome": "failure"}, "unseen_success", id="judged-wrongly"),
        pytest.param({"outcome": "success"}, "", id="judged-rightly"),
        pytest.param({"outcome": "failure", "gain": {}}, "", id="held-nothing"),
        pytest.param({"outcome": "failure", "seconds": 4.2}, "", id="arm-not-back"),
    ],
)
def test_a_success_judged_a_failure_held_something_and_ends_as_the_data_does(changes, named, placing):
    assert first_of(Run(**{**HOLDS, "seed": 9400, **changes}), placing) == named


def test_a_gripper_that_begins_at_its_other_end_is_reversed_whatever_it_does_then(placing):
    def reversed_gripper(state: NDArray[Any]) -> NDArray[Any]:
        return state * [1, 1, 1, -1]

    def stays(chunk: NDArray[Any]) -> NDArray[Any]:
        return np.where([False, False, False, True], -0.9, chunk)

    run = Run(**{**HOLDS, "gain": {}}, seed=9402, outcome="failure", seen=reversed_gripper, answered=stays)
    (first, *_) = diagnose(window_of(run), placing).findings
    assert (first.name, first.evidence.likelihood > 0.95) == ("gripper_reversed", True)


class Squeaks(Cause):
    """A cause of another package."""

    name, title, remedy = "squeaks", "no joint squeaks", "Oil it."

    def test(self, window, reference):
        return Evidence("A joint squeaks.", 1.0, "joints", 0.5, 0.9)


def offered(monkeypatch, *causes, failures=()):
    """Let `ibrobot-plugin-squeaks` offer causes, and nobody else."""
    entries = {}
    for each in causes:
        descriptor = each if isinstance(each, CauseDescriptor) else CauseDescriptor(each.name, make=each, summary="-")
        entries[KIND, descriptor.type] = Entry(KIND, descriptor, "squeaks", "ibrobot-plugin-squeaks", "1.0")
    registry = Registry(entries, [*failures])
    monkeypatch.setattr(diagnosis, "installed_plugins", lambda: registry)


@cache
def late_run():
    return window_of(Run(seed=9310, cameras=(), latency_s=2.0, outcome="failure"))


def test_other_packages_add_causes(monkeypatch):
    offered(monkeypatch, Squeaks)
    found = diagnose(window_of(Run(cameras=())), Reference())
    assert (found.first, found.broken) == ("squeaks", ())


class Raises(Squeaks):
    def test(self, window, reference):
        raise KeyError("elbow")


class ReturnsANumber(Squeaks):
    def test(self, window, reference):
        return 0.9


class LikelihoodIsText(Squeaks):
    def test(self, window, reference):
        return Evidence("A joint squeaks.", 1.0, "joints", 0.5, "high")  # type: ignore[arg-type]


class NumberIsNone(Squeaks):
    def test(self, window, reference):
        return Evidence("A joint squeaks.", None, "joints", 0.5, 0.9)  # type: ignore[arg-type]


class DetailsAreText(Squeaks):
    def test(self, window, reference):
        return Evidence("A joint squeaks.", 1.0, "joints", 0.5, 0.9, details="of the elbow")  # type: ignore[arg-type]


class Abstract(Cause):
    name, title, remedy = "squeaks", "no joint squeaks", "Oil it."


class TitleIsMissing(Squeaks):
    title = None  # type: ignore[assignment]


class NeedsAreText(Squeaks):
    needs = "commands"  # type: ignore[assignment]


class NeedsSomethingElse(Squeaks):
    needs = frozenset({"measured"})


class ExplainsATuple(Squeaks):
    explains = ("plan_dry",)  # type: ignore[assignment]


def unfinished():
    raise NotImplementedError


MISTAKES = {
    Raises: r"KeyError: 'elbow' \(tests/test_causes.py:\d+\)",
    ReturnsANumber: "TypeError: test returned 0.9: return an Evidence, or None",
    LikelihoodIsText: "TypeError: .*'likelihood' must be",
    NumberIsNone: "TypeError: .*'number' must be",
    DetailsAreText: "TypeError: .*'details' must be",
    Abstract: "it cannot be made: TypeError: Can't instantiate abstract class Abstract",
    TitleIsMissing: "its title is no text: None",
    NeedsAreText: "its needs are no frozenset of texts: 'commands'",
    NeedsSomethingElse: "it needs measured; available: answers, ",
    ExplainsATuple: r"its explains are no frozenset of texts: \('plan_dry',\)",
    unfinished: "it cannot be made: NotImplementedError",
    dict: "make returned {}, must be a Cause",
    Late("squeaks_nowhere:Squeaks"): "it cannot be made: ModuleNotFoundError: No module named 'squeaks_nowhere'",
    AnswersTremble: "its name is 'answers_tremble', and the type of its descriptor 'squeaks': give both one name",
}


@pytest.mark.parametrize("make", MISTAKES, ids=str)
def test_mistake_in_a_cause_names_it_and_its_package_and_keeps_the_others(make, monkeypatch):
    offered(monkeypatch, CauseDescriptor("squeaks", make=make, summary="-"))
    found = diagnose(late_run(), Reference())
    ((name, why),) = found.broken
    assert (name, found.first) == ("squeaks", "answers_slow")
    assert re.search(f"^ibrobot-plugin-squeaks has a mistake: {MISTAKES[make]}", why), why
    text = "\n".join(Explanation.of(late_run(), Reference(), found).lines())
    assert f"Not tested, since {why}: squeaks." in text


def test_mistake_in_a_cause_under_test_is_raised():
    with pytest.raises(KeyError):
        diagnose(window_of(Run(cameras=())), Reference(), [Raises()])


def test_plugin_that_failed_is_named(monkeypatch):
    reason = "unknown hook 'ibrobot_cause', did you mean 'ibrobot_causes'?"
    failure = Failure("squeaks", "ibrobot-plugin-squeaks", "hooks", reason)
    offered(monkeypatch, failures=[failure])
    found = diagnose(late_run(), Reference())
    text = "\n".join(Explanation.of(late_run(), Reference(), found).lines())
    assert f"Not tested, since plugin 'squeaks' (ibrobot-plugin-squeaks) has a wrong hook: {reason}: squeaks." in text


def test_names_are_known_without_the_causes():
    assert sorted(each.name for each in all_causes()) == sorted(OWN_NAMES)


@pytest.mark.parametrize("name", ["plan_dry", "picture_dark"])
def test_descriptor_of_a_taken_name_is_refused(name):
    taken = CauseDescriptor(name, make=Squeaks, summary="-")
    assert list(taken.mistakes()) == ["ibrobot-plugin-diagnose has a cause of this name: give yours another"]


def test_options_of_a_cause_are_refused():
    @attrs.frozen
    class Loudness(Options):
        usual: float = option(0.1, help="usual loudness")

    (mistake,) = CauseDescriptor("squeaks", make=Squeaks, summary="-", options=Loudness).mistakes()
    assert mistake.startswith("options: nothing sets options of a cause")


def test_listing_plugins_imports_no_numpy():
    """Every `ibrobot` command imports the hooks."""
    code = "import sys, ibrobot_diagnose; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_answers_that_all_come_too_late_are_named():
    """None of them is used."""
    late = diagnose(window_of(Run(seed=9310, cameras=(), latency_s=2.0, outcome="failure")), Reference())
    assert late.first == "answers_slow"


def test_slow_arm_is_explained_by_what_makes_it_slow(data):
    held = diagnose(window_of(Run(seed=9311, velocity=0.08, outcome="failure", **NONE)), data)
    assert {"limits_low", "other_speed"} <= {each.name for each in held.findings}
    assert held.first == "limits_low"


def test_fast_answers_are_named_though_the_arm_is_not_faster(data):
    def twice(chunk):
        return chunk[np.minimum(2 * np.arange(len(chunk)), len(chunk) - 1)]

    fast = diagnose(window_of(Run(seed=9312, velocity=0.8, answered=twice, outcome="failure", **NONE)), data)
    assert fast.first == "other_speed"
    assert "answers move the arm too fast" in fast.findings[0].evidence.text


def test_answers_that_begin_elsewhere_are_no_other_statistics(data):
    """They are inside of what the data shows."""
    shifted = Run(seed=9313, answered=lambda chunk: np.add(chunk, (0.2, 0, 0, 0)), outcome="failure", **NONE)
    assert "statistics" not in {each.name for each in diagnose(window_of(shifted), data).findings}


def test_arm_that_leaves_the_data_for_no_other_reason_is_a_weak_policy(data):
    """The set-up is not blamed for it."""
    away = window_of(Run(seed=9314, amplitude=1.4, outcome="failure", **NONE))
    explained = Explanation.of(away, data, diagnose(away, data, [UnseenStates()]))
    assert explained.first.startswith("Nothing is wrong with the set-up; more or better data is what helps: ")
    assert "left the range of the data" in explained.first


def test_bright_scene_that_turns_white_is_named(data):
    """Its brightness can hardly grow."""
    whole = Run(seed=9315, **ONE, acts=False, picture=of_top(lambda picture: 175 + picture // 4))
    bright = Reference(
        make_card([window_of(attrs.evolve(whole, seed=9316 + each), f"demo_{each}") for each in range(3)])
    )
    white = attrs.evolve(
        whole, acts=True, outcome="failure", picture=of_top(lambda picture: np.full_like(picture, 254))
    )
    findings = {each.name for each in diagnose(window_of(white), bright).findings}
    assert "picture_bright" in findings


def names_of(window, reference):
    return {each.name for each in diagnose(window, reference).findings}


def test_limit_that_demonstrations_had_too_is_not_too_low(data):
    """Their own speed is at it, so speeds alone do not tell."""
    slow = {"velocity": 0.3, **NONE}
    demos = [window_of(Run(seed=each, acts=False, **slow), f"demo_{each}") for each in range(6)]
    same = Reference(make_card(demos))
    run = window_of(Run(seed=9320, outcome="failure", **slow))
    assert "limits_low" not in names_of(run, same)
    assert "limits_low" in names_of(run, data)
    assert same.card is not None
    assert "limits_low" in names_of(run, Reference(attrs.evolve(same.card, limits=None, speed=same.card.speed * 2)))


def test_widest_limits_of_the_demonstrations_count():
    demos = [
        window_of(Run(seed=each, acts=False, velocity=velocity, **NONE), f"demo_{each}")
        for each, velocity in enumerate((0.5, 4.0, 1.0))
    ]
    limits = make_card(demos).limits
    assert limits is not None
    assert {each.velocity for each in limits} == {4.0}


def test_answers_of_noise_are_a_weak_policy(data):
    """Neither their speed nor limits that they reach are faults of the set-up."""
    rng = np.random.default_rng(0)

    def noisy(chunk):
        return chunk + rng.normal(0, 0.15, chunk.shape)

    run = window_of(Run(seed=9321, answered=noisy, outcome="failure", **NONE))
    diagnosis = diagnose(run, data)
    assert diagnosis.first == "answers_tremble"
    explained = Explanation.of(run, data, diagnosis)
    assert explained.first.startswith("Nothing is wrong with the set-up; more or better data is what helps: ")


def test_weak_policy_is_no_excuse_for_a_likelier_fault(data):
    """What noise brings about, too, makes it no likelier than a shifted zero."""

    class Trembles(AnswersTremble):
        def test(self, window, reference):
            return Evidence("They tremble.", 40.0, "%", 50.0, 0.6)

    class Off(Squeaks):
        name, likely = "arm_not_following", 1.0

        def test(self, window, reference):
            return Evidence("It squeaks.", 1.0, "joints", 0.5, self.likely)

    class Zero(Off):
        name, likely = "joint_zero", 0.9

    named = diagnose(window_of(Run(cameras=())), data, [Trembles(), Off(), Zero()]).findings
    assert [each.name for each in named] == ["joint_zero", "answers_tremble", "arm_not_following"]


def test_weak_policy_comes_after_whatever_is_wrong_with_the_set_up(data):
    """However likely it is, the report would begin with "nothing is wrong with the set-up"."""

    class Errs(Squeaks):
        name, weak = "errs", True

        def test(self, window, reference):
            return Evidence("It errs.", 1.0, "-", 0.5, 0.99)

    window = window_of(Run(cameras=()))
    found = diagnose(window, data, [Errs(), Squeaks()])
    assert [each.name for each in found.findings] == ["squeaks", "errs"]
    assert Explanation.of(window, data, found).first == "A joint squeaks."


@pytest.mark.parametrize(
    ("outcome", "begins"), [("success", "Nothing is wrong: "), ("failure", "Nothing is wrong with ")]
)
def test_success_needs_no_more_data(outcome, begins, data):
    """Though its arm went where the data was not, as does that of any run that is compared with one other alone."""

    class Errs(Squeaks):
        name, weak = "errs", True

    window = window_of(Run(cameras=(), outcome=outcome))
    first = Explanation.of(window, data, diagnose(window, data, [Errs()])).first
    assert first.startswith(begins)
    assert first.endswith("A joint squeaks.")
    assert ("more or better data" in first) == (outcome == "failure")


@pytest.mark.parametrize("share", [0.5, 0.8, 1.0])
def test_colours_are_exchanged_in_nearly_all_pictures(share, data):
    """A scene of some pictures alone may fit the data so by chance."""

    def some(camera: str, picture: NDArray[Any], t_s: float) -> NDArray[Any]:
        return picture[..., ::-1] if camera == "top" and t_s < 8 * share else picture

    run = window_of(Run(seed=9330, outcome="failure", picture=some, **{**ONE, "seconds": 8}))
    assert ("bgr" in names_of(run, data)) == (share == 1)


def riding(data):
    """The card of the same data, if the camera `top` were on the arm."""
    (key,) = (each for each in data.card.cameras if each.endswith("top"))
    moving = np.full_like(data.card.cameras[key].moving, 9)
    cameras = {**data.card.cameras, key: attrs.evolve(data.card.cameras[key], moving=moving)}
    return Reference(attrs.evolve(data.card, cameras=cameras))


def test_camera_on_the_arm_is_compared_where_the_arm_stands_alike(data):
    on_arm = riding(data)
    moved = {**ONE, "moved": {"top": (12, 6, 0.1)}}
    run = window_of(Run(seed=9322, outcome="failure", **moved))
    assert "camera_moved" in names_of(run, data)
    assert "camera_moved" not in names_of(run, on_arm)
    hidden = window_of(Run(seed=9323, outcome="failure", picture=of_top(lambda shown: shown * 0 + 50), **ONE))
    assert "picture_covered" in names_of(hidden, on_arm)
    away: dict[str, Any] = {"start": (2.5,) * 4, "seconds": 3, "cameras": ("top",), "camera_hz": 5.0}
    elsewhere = window_of(Run(seed=9324, outcome="failure", **away))
    assert "picture_covered" not in names_of(elsewhere, on_arm)
    hidden = window_of(Run(seed=9324, outcome="failure", picture=of_top(lambda shown: shown * 0 + 50), **away))
    assert on_arm.card is not None
    (pair,) = pairs(hidden, on_arm.card)
    assert pair.at_like_poses() is None, "the arm never stands as in the data"
    assert "picture_covered" in names_of(hidden, on_arm)


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_cameras_are_exchanged_in_nearly_all_pictures(share, data):
    """Some pictures alone may look like the other camera's by chance."""
    windows = [
        window_of(Run(seed=9331, outcome="failure", exchanged=exchanged, **{**BOTH, "seconds": 8}))
        for exchanged in (False, True)
    ]
    assert data.card is not None
    for one, other in zip(*(pairs(each, data.card) for each in windows), strict=True):
        count = round(share * len(one.camera.pictures))
        one.camera.pictures[:count] = other.camera.pictures[:count]
    assert ("cameras_exchanged" in names_of(windows[0], data)) == (share == 1)


@pytest.mark.parametrize("share", [0.58, 0.75])
def test_cameras_are_exchanged_if_pictures_are_much_closer_to_the_other_s(share, data):
    """Pictures of a new scene may all be a little closer to the other camera's by chance."""
    window = window_of(Run(seed=9331, outcome="failure", **{**BOTH, "seconds": 8}))
    assert data.card is not None
    one, other = pairs(window, data.card)
    mixed = [
        [
            attrs.evolve(a, small=(share * b.small + (1 - share) * a.small).astype(np.uint8))
            for a, b in zip(*each, strict=True)
        ]
        for each in ((one.camera.pictures, other.camera.pictures), (other.camera.pictures, one.camera.pictures))
    ]
    one.camera.pictures[:], other.camera.pictures[:] = mixed
    assert ("cameras_exchanged" in names_of(window, data)) == (share == 0.75)


def test_joint_that_the_cameras_hardly_see_has_no_shifted_zero(data):
    """Its positions at pictures that look the same differ from demonstration to demonstration."""
    shifted = window_of(Run(seed=9325, zero={0: 0.35}, start=(0.35, 0, 0, 0), outcome="failure", **ONE))
    assert "joint_zero" in names_of(shifted, data)
    assert data.card is not None
    rng = np.random.default_rng(1)
    cameras = {}
    for key, camera in data.card.cameras.items():
        owners = [name for name, _ in camera.places]
        apart = {name: rng.uniform(-0.5, 0.5) for name in dict.fromkeys(owners)}
        poses = camera.poses + np.array([[apart[name], 0, 0, 0] for name in owners])
        cameras[key] = attrs.evolve(camera, poses=poses)
    assert "joint_zero" not in names_of(shifted, Reference(attrs.evolve(data.card, cameras=cameras)))


def test_gripper_that_begins_at_its_other_end_is_reversed(data):
    """Though it then hardly moves, so that its way says nothing."""
    window = window_of(Run(seed=9326, outcome="failure", seen=lambda state: state, **NONE))
    assert data.card is not None
    begins = float(np.median(data.card.starts[:, 3]))
    ends = {"lower": begins - 0.1, "upper": begins + 1.2}
    document = {**window.document, "robot": {"joints": [{"name": "gripper", **ends}]}}
    state = window.state.values.copy()
    state[:, 3] = ends["lower"] + ends["upper"] - begins
    window = attrs.evolve(
        window,
        state=attrs.evolve(window.state, values=state),
        metadata={**window.metadata, "config": json.dumps(document)},
    )
    first, *_ = diagnose(window, data).findings
    assert first.name == "gripper_reversed"


def test_check_of_a_dataset_names_a_cause_with_a_mistake(monkeypatch, data):
    offered(monkeypatch, Raises)
    monkeypatch.setattr(check, "read_episode", lambda path: window_of(Run(seed=3, acts=False, seconds=7, cameras=())))
    ((name, why),) = check.check_episode((Path("one"), data.card)).broken
    untested = [{"name": name, "why": why, "episodes": 1}]
    lines = check.lines_of({"episodes": 2, "listed": [], "counts": {}, "unreadable": [], "untested": untested})
    assert lines[0].startswith("Not tested in 1 of 2 episodes: squeaks, since ibrobot-plugin-squeaks has a mistake: ")
    assert lines[-1] == "Nothing was found in 2 episodes."


@pytest.mark.parametrize(
    ("episodes", "warned"), [(1, "Only 1 episode to"), (4, "Only 4 episodes to"), (5, ""), (90, "")]
)
def test_what_few_episodes_say_of_one_another_is_called_little(episodes: int, warned: str) -> None:
    listed = [{"episode": "a", "causes": [{"name": "jerk", "text": "It jerks."}]}]
    checked = {"episodes": episodes, "listed": listed, "counts": {"jerk": 1}, "unreadable": [], "untested": []}
    first, *more, last = check.lines_of(checked)
    assert first == "a: It jerks."
    assert [each.startswith(warned) for each in more] == [True] * bool(warned)
    assert last.startswith("1 of ")
    assert check.lines_of({**checked, "listed": [], "counts": {}})[:-1] == more


def test_consequence_of_the_first_cause_says_to_fix_that_first(data):
    run = Run(seed=9400, outcome="failure", guarded=(0.1, 0.9), **NONE, **JOINTS["gripper_reversed"][2])
    window = window_of(run)
    explanation = Explanation.of(window, data, diagnose(window, data))
    done = {each["name"]: each["to_do"] for each in explanation.facts()["causes"]}
    assert next(iter(done)) == "gripper_reversed"
    assert done["gripper_reversed"].startswith("Calibrate the gripper again")
    assert done["guard_held"] == "Fix the first cause first: this is probably a consequence of it."
    assert f"   What to do: {done['guard_held']}" in explanation.lines()


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"guarded": (0.3, 0.7)}, "guard"),
        ({"velocity": 0.2}, "limits"),
        ({"torn": 0.6}, "blending"),
        ({"gain": {0: 0.2}}, "following"),
    ],
)
def test_planted_deviation_from_the_answers_has_the_largest_share(options, part):
    window = window_of(Run(seed=9410, cameras=(), **options))
    explanation = Explanation.of(window, Reference(), diagnose(window, Reference()))
    shares = explanation.facts()["between"]["mean_difference_rad"]
    assert max(shares, key=lambda each: shares[each]) == part
    assert (explanation.facts()["between"]["share_at_limit"]["velocity"] > 0.5) == (part == "limits")


def test_two_of_many_joints_that_are_exchanged_are_named():
    """Of a robot with two arms and hands."""
    rng, at = np.random.default_rng(0), np.arange(90)[:, None] / 30
    middles, widths = rng.uniform(-1, 1, (2, 26))
    names = [f"joint_{number}" for number in range(26)]

    def moved() -> NDArray[np.float64]:
        states: NDArray[np.float64] = middles + widths * np.sin(2 * at + rng.normal(0, 0.05, 26))
        return states

    card = Reference(make_card(make_window(moved(), joints=names, name=f"demo {number}") for number in range(8)))
    assert "joint_order" not in {each.name for each in diagnose(make_window(moved(), joints=names), card).findings}
    exchanged = make_window(moved()[:, [0, 5, 2, 3, 4, 1, *range(6, 26)]], joints=names)
    (first, *_) = diagnose(exchanged, card).findings
    assert first.name == "joint_order"
    assert "joint_1 behaves as joint_5, joint_5 behaves as joint_1" in first.evidence.text


@pytest.mark.parametrize("tremble", [0.0, 0.3])
@pytest.mark.parametrize(
    "pose", [(-0.7, -0.4, 0.5), (-0.6, -0.1, 0.0), (0.4, -0.6, -0.2), (0.5, 0.3, 0.3), (0.7, 0.2, 0.2)]
)
def test_arm_that_stays_where_the_data_never_was_has_no_shifted_zero(data, pose, tremble):
    """All its pictures resemble one of the data, at another pose: they count once."""
    rng = np.random.default_rng(1)

    def stays(chunk: Any) -> Any:
        goal = np.array([*pose, 0.0]) + rng.uniform(-tremble, tremble, 4)
        return np.broadcast_to(goal, chunk.shape).astype(chunk.dtype)

    run = window_of(Run(seed=9501, outcome="failure", answered=stays, **{**ONE, "seconds": 8}))
    assert "joint_zero" not in names_of(run, data)


def test_pose_in_which_a_run_began_is_known_if_the_camera_began_first(data):
    """It speaks against a shifted zero."""
    run = window_of(Run(seed=9502, acts=False, **ONE))
    (camera,) = run.cameras.values()
    late = run.state.times_ns > camera.times_ns[1]
    kept = {name: getattr(run.state, name)[late] for name in ("times_ns", "stamps_ns", "values")}
    state = attrs.evolve(run.state, **kept)
    poses = like_poses(attrs.evolve(run, state=state), data.card)
    np.testing.assert_array_equal(poses.own[poses.begins], state.at(np.array(camera.times_ns)[2:3]))
