"""What differs between two rigs is found, and nothing else is accused."""

from __future__ import annotations

import json

import attrs
import numpy as np
import pytest
from ibrobot_diagnose.card import Card
from made_rigs import CALIBRATION, HEIGHT, TOP, WIDTH, WRIST, Scene, card, compared, rig, unwell, verdicts, window
from PIL import Image, ImageFilter

from ibrobot_core.api import DatasetError

THEN = rig(Scene().still())
WITH_LEADER = attrs.evolve(THEN, leaders={"leader": dict.fromkeys(("pan", "lift", "elbow"), 0.01)})
HALF = WIDTH / 640


def warm(picture):
    return np.clip(picture * np.array([1.25, 1.0, 0.8]), 0, 255).astype(np.uint8)


def blurred(picture):
    return np.asarray(Image.fromarray(picture).filter(ImageFilter.GaussianBlur(2.5)))


def with_boxes(picture):
    """Two striped boxes on the table."""
    shown = picture.copy()
    for row, column in ((24, 20), (120, 190)):
        shown[row : row + 80, column : column + 90] = np.where(np.arange(90)[:, None] // 5 % 2, 235, 160)
    return shown


def covered(picture):
    hidden = picture.copy()
    hidden[:, : WIDTH // 2] = 20
    return hidden


@pytest.mark.parametrize("number", range(6))
def test_objects_light_and_the_arm_are_no_fault(number):
    rng = np.random.default_rng(number)
    arm = float(rng.uniform(-1, 1)) if number % 2 else 0.0
    now = Scene(objects=number, arm=arm, light=float(rng.uniform(0.85, 1.15)), noise=number)
    unwell = verdicts(rig(now.still()), THEN)
    assert set(unwell) <= {"zero_shifted"}
    assert unwell.get("zero_shifted", "cannot tell") == "cannot tell"


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize(
    ("pixels", "verdict"), [(2.0, None), (4.0, "warn"), (6.5, "fail"), (20.0, "fail"), (40.0, "fail")]
)
def test_moved_camera_is_measured(pixels, verdict, masked):
    then = rig(Scene().still(masked=masked))
    for number in (1, 2):
        angle = 0.7 + 1.6 * number
        shift = (HALF * pixels * np.cos(angle), HALF * pixels * np.sin(angle))
        moved = Scene(shift=shift, objects=number, arm=0.3 * number, noise=number, light=0.9)
        diagnosis = compared(rig(moved.still(masked=masked)), then)
        found = {each.name: each.evidence for each in diagnosis.findings}
        assert unwell(diagnosis).get("camera_moved") == verdict
        if verdict is not None:
            assert found["camera_moved"].number == pytest.approx(pixels, abs=0.4)


@pytest.mark.parametrize("degrees", [2.0, 5.0, 10.0])
def test_turned_camera_is_found(degrees):
    now = rig(Scene(roll=float(np.radians(degrees)), objects=3, arm=0.5).still())
    (first, *_) = compared(now, THEN).findings
    assert (first.name, first.evidence.verdict) == ("camera_moved", "fail")
    assert f"turned by {degrees:.1f}" in first.evidence.text


def test_mask_tells_a_large_arm_from_what_stands_still():
    """Without it, most of what could be seen is elsewhere."""
    turned, then = Scene(width=100, arm=0.9, objects=2), Scene(width=100, arm=-0.9)
    told = [
        verdicts(*(rig(each.still(masked=masked)) for each in (turned, then))).get("camera_moved")
        for masked in (True, False)
    ]
    assert told[0] is None
    assert told[1] is not None


def test_plain_table_cannot_tell():
    plain = [rig(Scene(plain=True, objects=each, arm=0.8 * each).still()) for each in (0, 1)]
    moved = {each.name: each.evidence for each in compared(plain[1], plain[0]).measured}["camera_moved"]
    assert moved.verdict == "cannot tell"
    assert moved.unclear.startswith("only ")


def test_another_view_fails():
    assert verdicts(rig(Scene(camera="wrist").still()), THEN)["camera_moved"] == "fail"


def test_camera_that_may_be_on_the_arm_is_not_accused_if_the_arm_stands_elsewhere():
    now, then = (rig(each.still(masked=False), stands=None) for each in (Scene(shift=(9.0, 3.0), arm=0.6), Scene()))
    unwell = compared(now, then)
    assert "camera_moved" not in {each.name for each in unwell.findings}
    (evidence,) = (each.evidence for each in unwell.measured if each.name == "camera_moved")
    assert "the camera may be on it" in evidence.unclear


@pytest.mark.parametrize(
    ("scene", "cause"),
    [
        (Scene(light=0.45), "picture_dark"), (Scene(light=1.4), "picture_bright"),
        (Scene(made=warm), "white_balance"), (Scene(made=blurred), "picture_blurred"),
        (Scene(made=covered), "picture_covered"), (Scene(made=lambda p: p[..., ::-1].copy()), "bgr"),
        (Scene(made=lambda p: p[::-1, ::-1].copy()), "picture_flipped"),
        (Scene(made=lambda p: p[:, ::-1].copy()), "picture_flipped"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_pictures_is_named_first(scene, cause):
    assert compared(rig(attrs.evolve(scene, objects=5, arm=0.2).still()), THEN).first == cause


def test_objects_that_have_left_a_plain_table_cover_nothing():
    """The table around them is seen in their place; a thing before the lens has a colour of its own."""
    then = rig(Scene(plain=True, made=with_boxes).still())
    assert "picture_covered" not in verdicts(rig(Scene(plain=True, light=0.93, noise=2).still()), then)
    hidden = Scene(plain=True, noise=2, made=lambda picture: covered(with_boxes(picture)))
    assert verdicts(rig(hidden.still()), then)["picture_covered"] == "fail"


def test_exchanged_cameras_are_named_first():
    one, other = Scene().still(), Scene(camera="wrist").still()
    then, now = rig(one, more={WRIST: other}), rig(other, more={WRIST: one})
    assert verdicts(now, then)["camera_moved"] == "fail"


@pytest.mark.parametrize("degrees", [2.0, 5.0, 17.0])
def test_zero_that_has_shifted_is_measured_by_the_picture(degrees):
    shifted = rig(Scene(noise=4).still(reads=float(np.radians(degrees))))
    (first, *_) = compared(shifted, THEN).findings
    assert first.name == "zero_shifted"
    assert first.evidence.number == pytest.approx(degrees, abs=0.01)
    assert f"pan is shifted by +{degrees:.1f}" in first.evidence.text
    assert first.evidence.verdict == ("fail" if degrees >= 5 else "warn")


def test_arm_that_is_not_where_it_says_is_found():
    assert verdicts(rig(Scene(arm=0.3).still(reads=0.0)), THEN)["zero_shifted"] == "fail"


def changed(**numbers):
    return {"arm": {**CALIBRATION["arm"], "gripper": {**CALIBRATION["arm"]["gripper"], **numbers}}}


@pytest.mark.parametrize(
    ("changes", "cause", "verdict"),
    [
        ({"loop_hz": 20.0}, "loop_slow", "fail"), ({"loop_hz": 93.0}, "loop_slow", "warn"),
        ({"calibration": changed(homing_offset=23)}, "other_calibration", "fail"),
        ({"calibration": changed(homing_offset=9)}, "other_calibration", "warn"),
        ({"calibration": changed(id=9)}, "other_calibration", "fail"),
        ({"calibration": {"arm": {}}}, "other_calibration", "fail"),
        ({"calibration": changed(range_max=2400)}, "other_gripper", "fail"),
        ({"versions": {"ibrobot-core": "0.2.0"}}, "other_versions", "warn"),
        ({"leaders": {"leader": {"pan": 0.31, "lift": 0.0}}}, "leader_apart", "fail"),
        ({"leaders": {"leader": {"pan": 0.08, "lift": 0.0}}}, "leader_apart", "warn"),
        ({"leaders": {"leader": dict.fromkeys(("pan", "lift", "elbow"), 0.9)}}, "leader_apart", "cannot tell"),
        ({"leaders": {}, "notes": ("leader cannot be read: no port",)}, "leader_apart", "cannot tell"),
        ({"robot": "other_arm"}, "other_robot", "warn"),
        ({"joints": THEN.joints[::-1]}, "other_robot", "warn"),
        ({"joints": (*THEN.joints[:-1], "thumb")}, "other_robot", "fail"),
        ({"cameras": {**THEN.cameras, WRIST: THEN.cameras[TOP]}}, "camera_unknown", "cannot tell"),
        ({"conditions": ({"message": "hot", "severity": "warning"},)}, "joints_unwell", "warn"),
        ({"conditions": ({"message": "dead", "severity": "fault"},)}, "joints_unwell", "fail"),
    ],
)  # fmt: skip
def test_what_else_is_wrong_is_found(changes, cause, verdict):
    assert verdicts(attrs.evolve(WITH_LEADER, **changes), WITH_LEADER)[cause] == verdict


def test_rig_is_well_beside_itself():
    assert verdicts(WITH_LEADER, WITH_LEADER) == {}


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ({"homing_offset": -2100}, "its offset is -2100 ticks, and a servo stores -2047 to 2047"),
        ({"range_min": 3}, "ends within 8 ticks of the encoder's end"),
        ({"range_max": 4095}, "ends within 8 ticks of the encoder's end"),
        ({"range_min": 3800}, "its range is 100 ticks (9 deg)"),
        ({"range_max": 2600}, "it moved by 211 deg, its limits are 344 deg apart"),
        ({"range_min": 900}, "the middle of its range is 31 deg from the middle pose"),
        ({"range_min": 0, "range_max": 4095}, None),
        ({"homing_offset": 2047}, None),
    ],
)  # fmt: skip
def test_odd_calibration_is_named(numbers, says):
    odd = attrs.evolve(THEN, calibration=changed(**numbers))
    found = {each.name: each.evidence.text for each in compared(odd, odd).findings}
    assert ("calibration_odd" in found) == (says is not None)
    assert says is None or says in found["calibration_odd"]


@pytest.mark.parametrize(
    ("camera", "cause"),
    [
        ({"rate_hz": 15.0}, "camera_slow"), ({"size": (240, 320)}, "other_resolution"),
        ({"settings": {"exposure": 250}}, "camera_options"), (None, "camera_missing"),
    ],
)  # fmt: skip
def test_cameras_with_other_settings_are_found(camera, cause):
    cameras = {} if camera is None else {TOP: attrs.evolve(THEN.cameras[TOP], **camera)}
    assert cause in verdicts(attrs.evolve(THEN, cameras=cameras), THEN)


def test_card_keeps_the_rig(tmp_path):
    written = card(rig(Scene().still(), leaders={"leader": {"pan": 0.1}}))
    written.write(tmp_path / "card.json")
    read = Card.read(tmp_path / "card.json").rig
    assert read is not None
    assert written.rig is not None
    still, kept = (each.cameras[TOP].stills[0] for each in (written.rig, read))
    assert still.picture.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(still.picture, kept.picture)
    assert read.facts() == written.rig.facts()
    assert verdicts(rig(Scene(noise=3).still(masked=False)), read) == {"zero_shifted": "cannot tell"} | {
        "leader_apart": "cannot tell"
    }


def damaged(facts):
    """Every value of the facts of a rig, in turn, replaced by something else of JSON."""
    wrong: tuple[object, ...] = (None, "x", -1, [], {}, float("nan"), True, [1, 2, 3])
    for key in facts:
        for value in wrong:
            yield {**facts, key: value}
    for key in ("homing_offset", "range_min", "range_max"):
        for value in wrong:
            yield {**facts, "calibration": changed(**{key: value})}
    camera = facts["cameras"][TOP]
    for key in camera:
        for value in wrong:
            yield {**facts, "cameras": {TOP: {**camera, key: value}}}
    for key in camera["stills"][0]:
        for value in wrong:
            yield {**facts, "cameras": {TOP: {**camera, "stills": [{**camera["stills"][0], key: value}]}}}


def read(file, facts):
    """The rig in a file of these facts, or why there is none."""
    file.write_text(json.dumps(facts))
    try:
        return Card.read(file).rig, ""
    except DatasetError as error:
        return None, str(error)


IMPOSSIBLE = {
    "no still": (("cameras", TOP, "stills"), []),
    "a joint twice": (("joints",), ["pan"] * len(THEN.joints)),
    "no date": (("taken",), "today\nrig is as in the reference"),
    "negative loop": (("loop_hz",), -5.0),
    "no loop": (("loop_hz",), 0),
    "infinite loop": (("loop_hz",), 10**400),
    "negative rate": (("cameras", TOP, "rate_hz"), -1),
    "no focal length": (("cameras", TOP, "focal"), 0),
    "no size": (("cameras", TOP, "size"), [0, 0]),
    "negative size": (("cameras", TOP, "size"), [240, -320]),
    "infinite size": (("cameras", TOP, "size"), [float("inf"), 320]),
    "pose far away": (("cameras", TOP, "stills", 0, "pose"), [1e308] * len(THEN.joints)),
}


@pytest.mark.parametrize("mistake", IMPOSSIBLE)
def test_numbers_that_no_rig_has_are_refused(mistake, tmp_path):
    """Compared with them, a rig would be found well."""
    facts = card(THEN).facts()
    *places, last = IMPOSSIBLE[mistake][0]
    at = facts["rig"]
    for place in places:
        at = at[place]
    at[last] = IMPOSSIBLE[mistake][1]
    known, error = read(tmp_path / "card.json", facts)
    assert known is None
    assert "card.json: cannot be read as a card of data: " in error


@pytest.mark.parametrize(
    "text", ['{"schema":' + "[" * 100_000, '{"schema": "ibrobot card", "version": 1, "joints": [], "episodes": 1e999}']
)
def test_file_that_is_no_card_is_refused(text, tmp_path):
    file = tmp_path / "card.json"
    file.write_text(text)
    with pytest.raises(DatasetError, match="cannot be read as a card of data"):
        Card.read(file)


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.long)])
def test_damaged_rigs_are_refused_or_read(every, tmp_path):
    """Whatever a file says, it is a card that can be compared, or a clear error."""
    whole, file = card(rig(Scene(plain=True).still())).facts(), tmp_path / "card.json"
    siblings = list(damaged(whole["rig"]))
    assert len(siblings) == 8 * (10 + 3 + 6 + 2)
    siblings = siblings[::every]
    refused = 0
    for each in siblings:
        known, error = read(file, {**whole, "rig": each})
        assert bool(error) <= (str(file) in error)
        refused += bool(error)
        if known is not None:
            verdicts(THEN, known)
    assert refused > len(siblings) / 2


def test_recording_at_its_end_is_a_reference():
    """A card of episodes knows the rig of the last one."""
    from ibrobot_diagnose.card import make_card
    from made_runs import Run, window_of

    made = make_card(window_of(Run(seed=each, acts=False, seconds=2, cameras=("top",))) for each in range(2))
    assert made.rig is not None
    assert set(made.rig.cameras) == {TOP}
    assert len(made.rig.cameras[TOP].stills) == 3
    assert made.rig.loop_hz == pytest.approx(100.0, rel=0.02)
    assert window(THEN).streams >= {"rig"}
    assert not window(THEN).streams & {"motion", "demonstration"}
