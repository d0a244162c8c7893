"""Which robots have a guard that their YAML does not mention, and what a run says of it."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_planning.guard import notice as notices
from ibrobot_planning.guard import unsaid as unsaids
from ibrobot_planning.guard.unsaid import unsaid
from ibrobot_testing.command import command_line

from ibrobot_core.api import MissingDependency, String
from ibrobot_core.app import ComponentFailed, ConfigError, RobotConfig

from .conftest import Make
from .test_motion import robot_yaml

MODEL = {"robot": {"description": {"mjcf": "arm.xml"}}}
FLOOR = "robot.description.floor=0.04"


def with_floor(floor: Any) -> dict[str, Any]:
    return {"robot": {"description": {"mjcf": "arm.xml", "floor": floor}}}


@pytest.mark.parametrize(
    ("document", "guard"),
    [
        ({}, None),
        (MODEL, None),
        ({"robot": {"description": {"floor": 0.0}}}, None),
        (with_floor(0.0), {"type": "clearance"}),
        ({**with_floor(0.0), "goals": {"floor": 0.2}}, {"type": "clearance"}),
        ({**MODEL, "goals": {"floor": 0.2}}, {"type": "clearance", "floor": 0.2}),
        ({**MODEL, "world": {"scene": True}}, {"type": "clearance"}),
        ({**MODEL, "world": {}}, None),
        (
            {**MODEL, "control_modes": {"a": {"planner": {"floor": 0.2}}, "b": {"planner": {"floor": -0.1}}, "c": {}}},
            {"type": "clearance", "floor": -0.1},
        ),
        ({**MODEL, "control_modes": {"a": {"planner": "joint"}}}, None),
        ({**with_floor(0.0), "control": {"guard": None}}, None),
        ({**with_floor(0.0), "control": {"guard": {"type": "other"}}}, None),
        ({**with_floor(0.0), "control": {"rate_hz": 50}}, {"type": "clearance"}),
        ({**with_floor(0.0), "control": 3}, None),
        (with_floor("high"), None),
        (with_floor(float("nan")), None),
    ],
)  # fmt: skip
def test_a_model_and_a_table_make_a_guard(document: dict[str, Any], guard: dict[str, Any] | None) -> None:
    assert unsaid(document) == guard


VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from(("floor", "planner", "x")), inner),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(("robot", "control", "control_modes", "goals", "world")), VALUES))
def test_documents_of_any_kind_make_none_or_a_guard(document: dict[str, Any]) -> None:
    assert unsaid(document) is None  # none of them has a model


def said(make: Make, caplog: pytest.LogCaptureFixture, *overrides: str, text: str) -> tuple[RobotConfig, str]:
    """The config of a run, and what it says of its guard at the start."""
    with caplog.at_level(logging.INFO):
        run = make(*overrides, text=text)
        run.start()
    lines = [record.message for record in caplog.records if "guard" in record.message and "hulls" not in record.message]
    assert len(lines) == 1
    return run.session.config, lines[0]


class TestRun:
    def test_a_table_is_enough(self, make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        config, line = said(make, caplog, FLOOR, text=robot_yaml(tmp_path))
        assert config.control.guard is not None
        assert (
            line == "all commands keep 3 mm from the table at 0.04 m, 1 mm between links (off by control.guard: null)"
        )
        assert config.document["control"]["guard"] == {"type": "clearance"}, "recordings have it"

    def test_one_key_switches_it_off(self, make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        config, line = said(make, caplog, FLOOR, "control.guard=null", text=robot_yaml(tmp_path))
        assert config.control.guard is None
        assert line.startswith("no guard: ")
        assert line.endswith("control.guard is null")

    def test_without_a_table_it_says_what_to_set(
        self, make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        config, line = said(make, caplog, text=robot_yaml(tmp_path))
        assert config.control.guard is None
        assert line.endswith("set robot.description.floor to the height of the table")

    def test_without_the_engines_it_says_what_to_install(
        self, make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def missing() -> None:
            raise MissingDependency("needs coal", remedy="pip install coal")

        for module in (unsaids, notices):
            monkeypatch.setattr(module, "find_engines", missing)
        text = robot_yaml(tmp_path)
        config, line = said(make, caplog, FLOOR, "default_control_mode=idle", text=text)
        assert config.control.guard is None
        assert line.endswith("needs coal; pip install coal")


@pytest.mark.parametrize("extra", ["", "world: {}\n"], ids=["guard", "world"])
def test_config_check_says_what_system_library_a_run_will_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: str
) -> None:
    def load(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    robot = tmp_path / "robot.yaml"
    robot.write_text(robot_yaml(tmp_path) + extra)
    check, arguments = command_line("config"), ["check", str(robot), "--set", FLOOR]
    assert "libgomp" not in CliRunner().invoke(check, arguments).output
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("ctypes.CDLL", load)
    checked = CliRunner().invoke(check, arguments)
    assert checked.exit_code == 0
    assert [line for line in checked.output.splitlines() if "libgomp" in line] == [
        "note: planning around obstacles needs the system library libgomp.so.1, and so does the guard; "
        "sudo apt-get install libgomp1"
    ]
    assert json.loads(CliRunner().invoke(check, [*arguments, "--json"]).output) == [], "the file has no fault"


def test_a_region_with_a_link_that_is_not_there_is_refused(make: Make, tmp_path: Path) -> None:
    region = "control.guard={type: clearance, regions: {tray: {lower: [0, 0, 0], upper: [1, 1, 1], links: [hnad]}}}"
    with pytest.raises(ConfigError, match=r"control\.guard\.regions\.tray\.links\.0: unknown link 'hnad'.*hand"):
        make(region, text=robot_yaml(tmp_path))


@pytest.mark.parametrize(
    ("guard", "world", "warned"),
    [
        ("may_touch: {floor: [hnad]}", "", "may_touch.floor: there is no link or object 'hnad', did you mean 'hand'?"),
        ("may_touch: {flor: [hand]}", "", "may_touch.flor: there is no link or object 'flor', did you mean 'floor'?"),
        ("free: {cup: [hand, finger]}", "", "free.cup: there is no link or object 'cup'; known: "),
        ("free: {cup: [hand, finger]}", "{objects: {cup: {shape: sphere, radius: 0.1, position: [1, 1, 1]}}}", ""),
        ("may_touch: {floor: [hand, finger]}", "", ""),
        ("free: {}", "", ""),
    ],
)
def test_a_permission_for_a_name_that_is_not_there_is_warned_of(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture, guard: str, world: str, warned: str
) -> None:
    """It may be an object that comes later, so it is no fault."""
    text = robot_yaml(tmp_path) + (f"world: {world}\n" if world else "")
    make(f"control.guard={{type: clearance, {guard}}}", text=text).start()
    lines = [record.getMessage() for record in caplog.records if "no link or object" in record.getMessage()]
    assert len(lines) == (1 if warned else 0)
    assert not warned or lines[0].startswith(f"control.guard.{warned}")


def test_hulls_of_links_without_collision_geometry_are_named(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = robot_yaml(tmp_path)
    with caplog.at_level(logging.INFO):
        make(FLOOR, "default_control_mode=idle", text=text).start()
    assert "takes hulls of visible meshes for links without collision geometry: base\n" in caplog.text


def test_a_model_without_geometry_says_how_to_go_on(make: Make, tmp_path: Path) -> None:
    text = robot_yaml(tmp_path)
    model = tmp_path / "arm.xml"
    bare = re.sub(r"<geom[^>]*/>", "", model.read_text())
    model.write_text(bare.replace("<joint ", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint '))
    run = make(FLOOR, "default_control_mode=idle", text=text)
    with pytest.raises(ComponentFailed, match=r"no geometry that could collide.*control\.guard: null"):
        run.start()


@pytest.mark.parametrize("world", ["", "world: {objects: {}}\n"])
@pytest.mark.parametrize("acted", [False, True])
def test_a_run_says_at_its_end_whether_the_guard_acted(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture, world: str, acted: bool
) -> None:
    run = make(FLOOR, text=robot_yaml(tmp_path) + world)
    with caplog.at_level(logging.INFO):
        run.start()
        for text in ('{"first": "hand"}', "") if acted else ():
            run.session.bus.publish("/guard", String(text), latched=True)
        run.stop()
    assert ("the guard held the arm back" in caplog.text) is acted


HIGH = r"a table at 0\.3 m is above the arm's first joint, which is at 0\.05 m"


@pytest.mark.parametrize(
    ("override", "fault"),
    [
        ("robot.description.floor=0.3", rf"robot\.description\.floor: {HIGH}"),
        ("robot.description.floor=16", r"robot\.description\.floor: -?16\.0 is too .*10 m"),
        ("robot.description.floor=-16", r"robot\.description\.floor: -?16\.0 is too .*10 m"),
        ("control.guard={type: clearance, floor: 0.3}", rf"control\.guard\.floor: {HIGH}"),
        ("control.guard={type: clearance, floor: 16}", r"control\.guard\.floor: a table at 16 m is above"),
        ("goals.floor=0.3", rf"goals\.floor: {HIGH}"),
        ("control.guard=false", r"control\.guard: expected a mapping, got false \(null switches it off\)"),
    ],
)
def test_a_table_in_which_the_arm_would_stand_is_refused(make: Make, tmp_path: Path, override: str, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        make(override, text=robot_yaml(tmp_path))


def test_a_table_below_the_arm_or_at_its_foot_is_right(make: Make, tmp_path: Path) -> None:
    for floor in ("-0.5", "0.0", "0.05"):
        make(f"robot.description.floor={floor}", text=robot_yaml(tmp_path))
