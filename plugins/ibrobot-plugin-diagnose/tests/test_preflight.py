"""`ibrobot preflight` on a simulated robot, in simulated time."""

from __future__ import annotations

import json
import re

import pytest
from command_line import run_here
from ibrobot_diagnose.pictures import read_png
from ibrobot_diagnose.preflight_contents import lines_of, read_contents
from ibrobot_provenance.reports import Cases

from ibrobot_core.app import installed_plugins

_REGISTRY = installed_plugins()
_RENDERS = ("sensor", "mujoco") in _REGISTRY.entries and _REGISTRY.missing("sensor", "mujoco") is None
pytestmark = [
    pytest.mark.integration,  # another package simulates the robot
    pytest.mark.skipif(not _RENDERS, reason="needs ibrobot-plugin-mujoco, and OpenGL"),
]

SMALL = [
    part
    for camera in ("top", "wrist")
    for each in ("fps=10", "width=320", "height=240")
    for part in ("--set", f"peripherals.{camera}.{each}")
]
"""A twelfth of the pixels, which take most of the time."""
SIM = ("so101", "--sim", "--lockstep", "--seconds", "0.5", *SMALL)


def preflight(*arguments):
    """Its exit code and facts."""
    done = run_here("preflight", *SIM, "--json", *arguments)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def unwell(facts):
    return {each["name"]: each["verdict"] for each in facts["lines"] if each["verdict"] != "ok"}


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A reference of the robot at rest."""
    file = tmp_path_factory.mktemp("rig") / "rig.json"
    code, facts = preflight("--take", file)
    assert (code, facts["verdict"], facts["taken"]) == (0, "ok", str(file))
    return file


def test_rig_is_as_it_was(reference):
    code, facts = preflight("--against", reference)
    assert (code, facts["verdict"], unwell(facts), facts["notes"]) == (0, "ok", {}, [])
    assert facts["untested"] == []  # what only a policy that runs shows is no omission
    assert {"camera_moved", "zero_shifted", "picture_dark", "camera_slow"} <= {each["name"] for each in facts["lines"]}


def test_every_camera_that_is_dark_is_named_and_shown(reference, tmp_path):
    dim = "simulation.scene={type: pick_cube, light: 0.4}"
    code, facts = preflight("--against", reference, "--out", tmp_path, "--set", dim)
    assert (code, unwell(facts)) == (1, {"picture_dark": "fail"})
    (dark,) = (each for each in facts["lines"] if each["name"] == "picture_dark")
    said = " ".join([dark["text"], *dark["details"]])
    shown = json.loads((tmp_path / "preflight.json").read_text())["pictures"]
    for camera in ("top", "wrist"):
        assert f"The pictures of {camera} are " in said
        assert {f"{camera} now", f"{camera} in the reference"} <= set(shown)


def test_arm_that_stands_elsewhere_is_no_fault(reference):
    code, facts = preflight("--against", reference, "--set", "simulation.start_pose=home")
    assert (code, unwell(facts)) == (0, {"zero_shifted": "cannot tell"})


def changed(reference, file, change):
    """A copy of the reference, edited by hand."""
    facts = json.loads(reference.read_text())
    change(facts["rig"])
    file.write_text(json.dumps(facts))
    return file


def test_reference_of_another_robot_fails(reference, tmp_path):
    other = changed(reference, tmp_path / "other.json", lambda rig: rig.update(robot="koch", joints=[*"abcdef"]))
    done = run_here("preflight", *SIM, "--against", other)
    assert done.returncode == 1, done.stderr
    assert "FAIL  other_robot: The reference is of koch with other joints: a, b, c, d, e, elbow_flex, f," in done.stdout
    assert "note  the arm is not masked in top: the robot has no joint 'a', as the reference has" in done.stdout


def test_camera_that_the_reference_lacks_is_uncertain(reference, tmp_path):
    less = changed(reference, tmp_path / "less.json", lambda rig: rig["cameras"].pop("observation.images.top"))
    code, facts = preflight("--against", less)
    assert (code, unwell(facts)["camera_unknown"]) == (0, "cannot tell")
    assert any(line.startswith("?     camera_unknown: top: not in the reference") for line in facts["lines_of_text"])
    assert ", as far as that is certain: 0 fail, 0 warn, " in facts["first"]


def test_camera_that_moved_fails_with_a_report(reference, tmp_path):
    done = run_here(
        "preflight", *SIM, "--against", reference, "--out", tmp_path,
        "--set", "simulation.scene={type: pick_cube, camera_turn: [0.012, 0.012]}",
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    first, *_, last = done.stdout.splitlines()
    assert re.match(r"FAIL  camera_moved: The camera top has moved: its picture is shifted by 1\d\.\d of 640", first)
    assert "warns from 3, fails from 5" in first
    assert "What to do: Put the camera back" in done.stdout
    assert last.startswith("so101 is not fit to be used: 1 fail, 0 warn")
    (sections, pictures, *_) = read_contents(tmp_path)
    assert any("What to do: Put the camera back" in str(each) for each in sections.blocks)
    (cases, *_) = pictures.blocks
    assert isinstance(cases, Cases)
    shown = cases.cases
    assert [each.title for each in shown] == ["top now", "top in the reference"]
    drawn = [each.picture for each in shown if each.picture is not None]
    assert [read_png(each.read_bytes()).shape[2] for each in drawn] == [3, 3]
    (first_line,) = lines_of(tmp_path)
    assert first_line == last
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img") == 2
    assert "top in the reference" in page
    assert not re.search(r"""(?:src|href)=["']?https?:""", page)
    assert json.loads((tmp_path / "preflight.json").read_text())["verdict"] == "fail"


def test_fault_of_the_run_fails(reference):
    """The servos fall silent while the rig is looked at."""
    silent = "simulation.faults=[{at: 0.2, kind: read_error}]"
    done = run_here("preflight", *SIM, "--against", reference, "--set", silent)
    assert done.returncode == 1, done.stderr
    assert "FAIL  joints_unwell: " in done.stdout


def test_events_tell_what_is_done_and_each_difference_with_its_number_and_remedy(reference, tmp_path):
    other = changed(reference, tmp_path / "other.json", lambda rig: rig.update(robot="koch"))
    done = run_here("preflight", *SIM, "--against", other, "--events")
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert [each["event"] for each in events][-1] == "preflightreport"
    assert events[-1]["verdict"] == "warn"
    assert {"control", "the window"} <= {each["what"] for each in events[:-1] if "what" in each}
    (differs,) = [each for each in events if each["event"] == "difference"]
    assert (differs["name"], differs["verdict"]) == ("other_robot", "warn")
    assert differs["limits"] == "[1 difference; warns from 1, fails from 2]"
    assert differs["remedy"].startswith("Compare with a reference of this robot")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("so101", "--lockstep"), "--lockstep is for simulation"),
        (("so101", "--sim", "--take", "a", "--against", "b"), "--against and --take exclude each other"),
        (("so101", "--sim", "--against", "nowhere"), "nowhere"),
        (("no_robot",), "no_robot"),
    ],
)
def test_wrong_options_are_named(arguments, says):
    done = run_here("preflight", *arguments)
    assert done.returncode == 2
    assert says in done.stderr


def test_card_from_before_has_no_rig(reference, tmp_path):
    facts = json.loads(reference.read_text())
    del facts["rig"]
    (tmp_path / "old.json").write_text(json.dumps(facts))
    done = run_here("preflight", *SIM, "--against", tmp_path / "old.json")
    assert done.returncode == 2
    assert "from before preflight" in done.stderr
