"""The simulated SO-101 jogged with fake devices through the launch path, in lockstep: equal seeds, equal motion."""

from __future__ import annotations

import json
import queue
import re
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import attrs
import numpy as np
import pytest
import yaml
from ibrobot_gamepad.options import GamepadOptions

from ibrobot_core.api import Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

from .fake_hid import DUALSENSE, SPACEMOUSE, FakeHidapi, Plugged, dualsense, mouse_buttons, spacemouse
from .test_teleop import Rig

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(find_spec("ibrobot_mujoco") is None, reason="needs ibrobot-plugin-mujoco"),
]
ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "so101_blind.yaml"
PAGES = {"gamepad": "drive-with-a-gamepad.md", "spacemouse": "drive-with-a-spacemouse.md"}
LB = "left_shoulder"


@attrs.define
class Run:
    """A run with a device, and what control has of the arm."""

    runtime: Runtime
    device: Plugged

    def ticks(self, count: int, *reports: bytes) -> None:
        """Let time pass; the device sends its last report again and again, as pads do."""
        for i in range(count):
            if self.device.present:
                self.device.send(*(reports if i == 0 else reports[-1:]))
            assert not self.runtime.step()

    @property
    def position(self) -> Vector:
        return self.runtime.session.measured().position.copy()

    @property
    def tool(self) -> Vector:
        """Where the tip is [m], by the transform that the run would publish."""
        from ibrobot_kinematics import robot_model

        robot = self.runtime.session.config.robot
        arm = robot.groups["arm"]
        return robot_model(robot, arm).forward(self.position[robot.indices(arm)]).position


def documented(mode: str) -> list[str]:
    """The overrides that add what the how-to's first YAML says to a robot."""
    page = (ROOT / "docs" / "how-to" / PAGES[mode]).read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)[:1]
    return [
        f"{section}.{name}={json.dumps(value)}"
        for section, entries in yaml.safe_load(block).items()
        for name, value in entries.items()
    ]


Start = Callable[..., Run]


@pytest.fixture
def start(hidapi: FakeHidapi) -> Iterator[Start]:
    made: list[Runtime] = []

    def start(mode: str, device: Plugged, rest: bytes, *overrides: str) -> Run:
        registry = installed_plugins()
        config = load_config(CONFIG, sim=True, mode=mode, overrides=[*documented(mode), *overrides], registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=3)))
        made.append(runtime)
        hidapi.plug(device)
        device.send(rest)
        runtime.start()
        run = Run(runtime, device)
        run.ticks(20, rest)
        return run

    yield start
    for runtime in made:
        runtime.stop()


def pad(start: Start, *overrides: str) -> Run:
    return start("gamepad", Plugged(*DUALSENSE), dualsense(), "teleoperation.gamepad.via=hid", *overrides)


def test_sticks_move_joints_and_triggers_the_gripper(start: Start):
    run = pad(start)
    before = run.position
    run.ticks(50, dualsense(LB), dualsense(LB, left=(1, 0)))
    run.ticks(20, dualsense(LB))
    way = run.position - before
    assert way[0] == pytest.approx(0.4, abs=0.05)
    assert np.max(np.abs(way[1:])) < 0.05
    run.ticks(30, dualsense(LB, triggers=(1, 0)))
    assert (run.position - before)[5] > 0.2
    assert run.runtime.session.faults == ()


def test_a_long_press_changes_to_the_tool(start: Start):
    run = pad(start)
    run.ticks(100, dualsense(LB), dualsense(LB, "west"))  # away from the limits, to home
    run.ticks(60, dualsense(LB, "right_shoulder"))
    run.ticks(10, dualsense(LB))
    before = run.tool
    run.ticks(60, dualsense(LB, right=(0, -1)))
    run.ticks(20, dualsense(LB))
    way = run.tool - before
    assert way[2] < -0.03, "the tool went down"
    assert np.hypot(way[0], way[1]) < 0.02
    assert run.runtime.session.faults == ()


def test_a_long_press_starts_from_the_measured_position(hidapi: FakeHidapi):
    robot = load_config(CONFIG, sim=True).robot
    rig = Rig(hidapi, GamepadOptions(via="hid"), robot=robot, blocked=True, position=robot.pose("home").copy())
    rig.engage()
    rig.hold(2, dualsense(LB, left=(1, 0)))
    lead = rig.setpoint(rig.tick(dualsense(LB))) - rig.position
    assert lead[0] == pytest.approx(0.1), "a joint at rest is ahead of a robot that does not follow"
    ahead = [rig.setpoint(rig.tick(dualsense(LB, "right_shoulder"))) - rig.position for _ in range(60)]
    assert ahead[40][0] == pytest.approx(0.1)
    np.testing.assert_allclose(ahead[-1], 0.0, atol=1e-9)


def test_a_spacemouse_moves_the_tool(start: Start):
    run = start("spacemouse", Plugged(*SPACEMOUSE, usage=0x08), mouse_buttons())
    before = run.tool
    run.ticks(60, mouse_buttons(0), spacemouse(z=1))
    run.ticks(20, spacemouse())
    assert (run.tool - before)[2] > 0.03
    held = run.position
    run.ticks(30, mouse_buttons(), spacemouse(z=1))
    np.testing.assert_allclose(run.position, held, atol=0.02)


def test_unplugs_in_motion_hold_until_the_deadman_is_pressed_again(start: Start, hidapi: FakeHidapi):
    """`guest/boot.sh` unplugs each device 20 times."""
    run = pad(start)
    rng = np.random.default_rng(7)
    direction = 1
    for _ in range(5):
        moving = dualsense(LB, left=(direction, 0))
        before = run.position[0]
        run.ticks(int(rng.integers(10, 40)), dualsense(), dualsense(LB), moving)
        assert direction * (run.position[0] - before) > 0.02
        hidapi.unplug(run.device)
        run.ticks(15)  # what it takes to stop
        stopped = run.position
        run.ticks(int(rng.integers(1, 80)))
        hidapi.plug(run.device)
        run.ticks(70, moving)
        np.testing.assert_allclose(run.position, stopped, atol=2e-3)
        direction = -direction
    assert run.runtime.session.faults == ()


@pytest.fixture
def bimanual(hidapi: FakeHidapi) -> Iterator[tuple[Run, queue.SimpleQueue[str]]]:
    """Two simulated arms: a pad moves the left one, the keyboard the right one."""
    overrides = [
        "peripherals=[]",
        "contract={}",
        "teleoperation.pad={type: gamepad, via: hid, gripper: left_gripper}",
        "control_modes.both={executors: [left_position, right_position], teleop: {left: pad, right: keyboard_right}}",
    ]
    registry, typed = installed_plugins(), queue.SimpleQueue[str]()
    config = load_config(CONFIG.parent / "bi_so101.yaml", sim=True, mode="both", overrides=overrides, registry=registry)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, keys=lambda: typed)))
    run = Run(runtime, hidapi.plug(Plugged(*DUALSENSE)))
    run.device.send(dualsense())
    runtime.start()
    run.ticks(20, dualsense())
    yield run, typed
    runtime.stop()


def test_a_pad_and_the_keyboard_move_an_arm_each(bimanual: tuple[Run, queue.SimpleQueue[str]], hidapi: FakeHidapi):
    run, typed = bimanual
    left, right = slice(0, 6), slice(6, 12)
    before = run.position
    run.ticks(50, dualsense(LB), dualsense(LB, left=(1, 0)))
    way = run.position - before
    assert way[left][0] == pytest.approx(0.4, abs=0.05)
    assert np.max(np.abs(way[right])) < 0.02
    run.ticks(20, dualsense(LB))
    run.ticks(30, dualsense(LB, triggers=(1, 0)))
    assert (run.position - before)[5] > 0.2

    def jog(ticks: int, *reports: bytes) -> None:
        for event in ("release:w", "w"):
            typed.put(event)
        for _ in range(ticks):
            typed.put("repeat:w")
            run.ticks(1, *reports)

    run.ticks(20, dualsense())
    before = run.position
    jog(50, dualsense())
    way = run.position - before
    assert np.max(np.abs(way[left])) < 0.02
    assert abs(way[right][0]) > 0.1

    run.ticks(30, dualsense(LB), dualsense(LB, left=(-1, 0)))
    hidapi.unplug(run.device)
    run.ticks(20)
    before = run.position
    jog(50)
    way = run.position - before
    assert np.max(np.abs(way[left])) < 0.02, "the arm of the pad that is gone holds"
    assert abs(way[right][0]) > 0.1, "the other one goes on"
    assert run.runtime.session.faults == ()


def test_the_tool_of_one_of_two_arms_moves_along_its_own_axes(bimanual: tuple[Run, queue.SimpleQueue[str]]):
    from ibrobot_kinematics import robot_model

    run, _ = bimanual
    part = run.runtime.session.config.robot.part("left")
    names = part.joint_names[:-1]

    def tool() -> Vector:
        return robot_model(part, names).forward(run.position[:5]).position

    run.ticks(150, dualsense(LB), dualsense(LB, "west"))  # away from the limits, to home
    run.ticks(60, dualsense(LB, "right_shoulder"))
    run.ticks(10, dualsense(LB))
    before = tool()
    run.ticks(60, dualsense(LB, right=(0, -1)))
    run.ticks(20, dualsense(LB))
    assert (tool() - before)[2] < -0.03, "the tool went down"
    assert run.runtime.session.faults == ()


def test_equal_seeds_and_reports_give_equal_motion(start: Start, hidapi: FakeHidapi):
    paths = []
    for _ in range(2):
        hidapi.bus.clear()
        run = pad(start)
        path = []
        for i in range(60):
            run.ticks(1, dualsense(LB, left=(np.sin(i / 9), np.cos(i / 9) / 2 - 0.5)) if i else dualsense())
            path.append(run.position)
        paths.append(np.array(path))
        run.runtime.stop()
    np.testing.assert_array_equal(paths[0], paths[1])


def test_the_stop_button_stops_the_robot_and_a_reset_waits_for_the_deadman(start: Start):
    run = pad(start)
    run.ticks(30, dualsense(LB), dualsense(LB, left=(1, 0)))
    run.ticks(20, dualsense(LB, "east", left=(1, 0)))
    assert any("emergency stop" in fault for fault in run.runtime.session.faults)
    stopped = run.position
    run.runtime.reset()
    run.ticks(30, dualsense(LB, left=(1, 0)))
    np.testing.assert_allclose(run.position, stopped, atol=2e-3)
    run.ticks(30, dualsense(), dualsense(LB), dualsense(LB, left=(1, 0)))
    assert run.position[0] - stopped[0] > 0.1
