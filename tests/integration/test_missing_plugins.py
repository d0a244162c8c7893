"""Robots whose YAML names plugins that are not installed: only what the entered mode needs must be there."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points

import pytest
from ibrobot_provenance.jobs import check_pool

from ibrobot_core import plugins
from ibrobot_core.cli.main import main
from ibrobot_core.config import find_config, load_config
from ibrobot_core.errors import PluginError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

Only = Callable[..., None]


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch) -> Iterator[Only]:
    """Has some plugins installed, and no others."""

    def choose(*names: str) -> None:
        installed = [entry for entry in entry_points(group="ibrobot") if entry.dist is not None]
        found = [each for each in installed if each.name in names or (each.dist and each.dist.name == plugins.CORE)]
        monkeypatch.setattr(plugins, "entry_points", lambda: found)
        installed_plugins.cache_clear()

    yield choose
    installed_plugins.cache_clear()


@pytest.fixture
def ibrobot(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["ibrobot", *arguments])
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        assert isinstance(code, int)
        out, err = capsys.readouterr()
        return code, out, err

    return run


Run = Callable[..., tuple[int, str, str]]
NOTES = [
    "mode model_inference is unavailable: sensor type 'opencv', policy type 'scripted_pick' need plugins that are not "
    'installed: pip install "ibrobot[so101]"',
    "mode jog is unavailable: teleop type 'keyboard' needs a plugin that is not installed: "
    "pip install ibrobot-plugin-keyboard",
    "mode servo is unavailable: teleop type 'twist' needs a plugin that is not installed: "
    "pip install ibrobot-kinematics",
    "mode web is unavailable: teleop type 'web' needs a plugin that is not installed: pip install ibrobot-plugin-web",
    "mode moveit_planning is unavailable: executor type 'trajectory', executor type 'gripper', "
    "planner type 'rrt_connect', a mode with planner need plugins that are not installed: "
    "pip install ibrobot-plugin-planning",
]
CAMERAS = (
    "camera top, camera wrist: sensor type 'opencv' needs a plugin that is not installed; "
    "pip install ibrobot-plugin-camera"
)


def test_config_check_notes_modes_that_cannot_be_entered(only: Only, ibrobot: Run) -> None:
    only("feetech")

    code, out, err = ibrobot("config", "check", "so101")

    assert (code, err) == (0, "")
    notes = [line for line in out.splitlines() if line.startswith("note: ")]
    notes = [line for line in notes if "there is no such calibration" not in line]  # nor need be here
    limits = (
        "joint limits are not compared with robot.description.mjcf and urdf, since ibrobot-kinematics is not "
        "installed: pip install ibrobot-kinematics"
    )
    assert notes == [f"note: {line}" for line in (*NOTES, limits, f"runs start without {CAMERAS}")]
    assert ibrobot("config", "check", "so101", "--json") == (0, "[]\n", "")


def test_plan_says_what_is_not_there(only: Only, ibrobot: Run) -> None:
    only("feetech")

    code, out, err = ibrobot("launch", "so101", "--dry-run")

    assert (code, err) == (0, "")
    assert out.splitlines()[-len(NOTES) - 2 : -1] == [f"without {CAMERAS}", *NOTES]
    plan = json.loads(ibrobot("launch", "so101", "--dry-run", "--json")[1])
    assert list(plan["unavailable"]) == ["model_inference", "jog", "servo", "web", "moveit_planning"]


@pytest.mark.parametrize(
    ("kept", "arguments", "message"),
    [
        ((), (), "hardware.type: hardware type 'feetech_so101', teleop type 'so101_leader' need plugins that are not "
         "installed: pip install ibrobot-plugin-feetech"),
        (("feetech",), ("--mode", "jog"),
         "teleoperation.keyboard.type: teleop type 'keyboard' needs a plugin that is not installed: "
         "pip install ibrobot-plugin-keyboard"),
        (("feetech",), ("--sim",), "simulation.type: hardware type 'mujoco', policy type 'scripted_pick' need plugins "
         "that are not installed: pip install ibrobot-plugin-mujoco"),
        (("feetech",), ("--mode", "jog", "--set", "transport={type: zenoh, share: {publish: [/joint_states]}}"),
         "teleop type 'keyboard', transport type 'zenoh' need plugins that are not installed: "
         "pip install ibrobot-plugin-keyboard ibrobot-plugin-zenoh"),
        (("feetech",), ("--mode", "jog", "--set", "recording={type: mcap}"),
         "sensor type 'opencv', teleop type 'keyboard', recorder type 'mcap' need plugins that are not "
         'installed: pip install "ibrobot[so101]"'),
        (("feetech",), ("--set", "metrics.port=9464"),
         "--set metrics.port=9464: metrics: section 'metrics' needs a plugin that is not installed: "
         "pip install ibrobot-plugin-metrics"),
        (("feetech",), ("--mode", "jog", "--set", "metrics.port=9464"),
         "section 'metrics', teleop type 'keyboard' need plugins that are not installed: "
         'pip install "ibrobot[sim]"'),
    ],
)  # fmt: skip
def test_entered_mode_is_one_error_with_one_command(
    only: Only, ibrobot: Run, kept: tuple[str, ...], arguments: tuple[str, ...], message: str
) -> None:
    only(*kept)

    checked = ibrobot("config", "check", "so101", *arguments)
    launched = ibrobot("launch", "so101", "--dry-run", *arguments)

    assert checked == launched
    code, out, err = launched
    assert (code, out) == (2, "")
    [line] = err.splitlines()
    assert line.startswith("error: ")
    assert line.endswith(message)


FAR = ("--set", "transport={type: zenoh, connect: [tcp/127.0.0.1:7447]}")
MODE = ("--set", "control_modes.model_inference.inference.execution_mode=distributed")


def test_mode_whose_engine_is_not_installed_is_unavailable(only: Only, ibrobot: Run) -> None:
    only("mujoco", "keyboard", "planning", "zenoh")
    lacks = "engine type 'distributed' needs a plugin that is not installed: pip install ibrobot-plugin-serve\n"

    code, out, err = ibrobot("config", "check", "so101_blind", "--sim", *FAR, *MODE, "--mode", "teleop")
    entered = ibrobot("config", "check", "so101_blind", "--sim", *FAR, *MODE, "--mode", "model_inference")

    assert (code, err) == (0, "")
    assert f"mode model_inference is unavailable: {lacks}" in out
    assert entered[0] == 2
    assert entered[2].endswith(f"control_modes.model_inference.inference.execution_mode: {lacks}")


def test_unknown_type_stays_an_error_in_every_mode(only: Only, ibrobot: Run) -> None:
    only("feetech")

    code, _, err = ibrobot("config", "check", "so101", "--set", "teleoperation.keyboard.type=keybord")

    assert code == 2
    assert "unknown teleop type 'keybord'" in err


def test_switch_to_an_unavailable_mode_is_refused_with_the_remedy(only: Only) -> None:
    only("feetech")
    runtime = Runtime(
        Session(load_config(find_config("so101", installed_plugins())), installed_plugins(), LaunchRequest())
    )

    with pytest.raises(PluginError, match=r"^mode jog is unavailable: .*: pip install ibrobot-plugin-keyboard$"):
        runtime.switch_mode("jog")


def test_show_needs_every_plugin(only: Only, ibrobot: Run) -> None:
    only("feetech")

    code, out, err = ibrobot("config", "show", "so101")

    assert (code, out) == (2, "")
    assert err.endswith(': pip install "ibrobot[so101]"\n')


def test_pool_whose_package_is_not_installed_names_it(only: Only) -> None:
    only("processes")
    with pytest.raises(PluginError, match=r"pool type 'ray' needs .* pip install ibrobot-plugin-ray$"):
        check_pool("ray://head:10001")
