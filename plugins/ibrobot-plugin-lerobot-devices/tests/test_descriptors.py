"""What core asks of the descriptors; options against LeRobot's dataclasses; commands."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import attrs
import ibrobot_lerobot_devices
import numpy as np
import pytest
from click.testing import CliRunner
from ibrobot_lerobot_devices import link, new_robot, registry
from ibrobot_lerobot_devices.link import DeviceLink
from ibrobot_lerobot_devices.options import CameraOptions, CmdVelOptions, RobotOptions, TeleopOptions
from ibrobot_testing.command import command_line
from ibrobot_testing.contexts import make_robot
from ibrobot_testing.descriptor import check_descriptor

from ibrobot_core.api import HardwareError
from ibrobot_core.app import ConfigError, RequestError, load_config, parse_yaml

from .conftest import JOINTS, Motors, install_package

lerobot = command_line("lerobot")


@pytest.mark.parametrize(
    ("hook", "options"),
    [
        ("ibrobot_hardware", RobotOptions("fake_arm", {"port": "/dev/ttyACM0"})),
        ("ibrobot_teleop", TeleopOptions("fake_leader", {"port": "/dev/ttyACM1"})),
        ("ibrobot_teleop", CmdVelOptions()),
        ("ibrobot_sensors", CameraOptions("fake_still", {"path": "picture", "height": 24, "width": 32})),
    ],
)
def test_functions_of_the_descriptors(hook: str, options: Any) -> None:
    (descriptor,) = (each for each in getattr(ibrobot_lerobot_devices, hook)() if isinstance(options, each.options))
    check_descriptor(descriptor, options)
    assert list(options.check(make_robot(), make_robot().joint_names)) == []


@pytest.mark.parametrize(
    ("changes", "option", "message"),
    [
        ({"robot": "fake_harm"}, ("robot",), "LeRobot has no robot 'fake_harm', did you mean 'fake_arm'?"),
        ({"config": {"prot": "x", "port": "y"}}, ("config", "prot"), "LeRobot's fake_arm has no 'prot', did you mean"),
        ({"config": {}}, ("config",), "LeRobot's fake_arm needs port"),
        ({"config": {"port": "x", "gain": True}}, ("config", "gain"), "must be int or None, not True"),
        ({"config": {"port": "x", "gain": "high"}}, ("config", "gain"), "must be int or None, not 'high'"),
        ({"config": {"port": "x", "cameras": {"a": 1}}}, ("config", "cameras"), "cameras are peripherals here"),
        (
            {"config": {"port": "x", "disable_torque_on_disconnect": True}},
            ("config", "disable_torque_on_disconnect"),
            "is control.stop here",
        ),
        ({"names": {"a": "gripped"}}, ("names", "a"), "unknown joint 'gripped', did you mean 'gripper'?"),
        ({"inverted": ("elbow",)}, ("inverted", 0), "unknown joint 'elbow', did you mean 'elbow_flex'?"),
    ],
)
def test_wrong_options_are_named(changes: dict[str, Any], option: tuple[Any, ...], message: str) -> None:
    options = RobotOptions(**{"robot": "fake_arm", "config": {"port": "x"}, **changes})
    (fault,) = options.check(make_robot(), ())
    assert fault.option == option
    assert message in fault.message


def test_without_lerobot_nothing_is_checked_and_doctor_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "is_installed", lambda: False)
    monkeypatch.setattr(registry, "is_installed", lambda: False)
    assert list(RobotOptions("any").check(make_robot(), ())) == []
    (check,) = ibrobot_lerobot_devices.ibrobot_doctor()
    assert not check.ok
    assert check.remedy == "pip install lerobot"


def test_doctor_says_what_lerobot_does_not_report() -> None:
    (check,) = ibrobot_lerobot_devices.ibrobot_doctor()
    assert check.found == (
        "0.6.1; its robots report no torque, temperature or voltage, so that only positions are checked in a run"
    )


class TestCommands:
    def test_list(self) -> None:
        result = CliRunner().invoke(lerobot, ["list"], catch_exceptions=False)
        assert "robots: hardware of type lerobot: fake_arm, fake_base\n" in result.output
        assert "teleoperators: teleop of type lerobot: fake_leader, fake_stick\n" in result.output

    def test_list_of_a_type_has_its_config(self) -> None:
        result = CliRunner().invoke(lerobot, ["list", "fake_arm"], catch_exceptions=False)
        assert "  port: str; required\n" in result.output
        assert "  gain: int or None; default None\n" in result.output

    def test_torque_off(self, motors: Motors) -> None:
        motors.port.write_text(json.dumps(motors.content | {"torque": True}))
        config = json.dumps({"port": str(motors.port), "id": "tester"})
        result = CliRunner().invoke(
            lerobot, ["torque-off", "fake_arm", "--config", config, "--yes"], catch_exceptions=False
        )
        assert result.output.endswith("torque off: fake_arm\n")
        assert not motors.content["torque"]

    def test_torque_off_of_an_arm_that_is_not_there(self, motors: Motors) -> None:
        with pytest.raises(HardwareError, match="fake_arm: ConnectionError: no port"):
            CliRunner().invoke(
                lerobot,
                ["torque-off", "fake_arm", "--config", '{"port": "nowhere", "id": "x"}', "--yes"],
                catch_exceptions=False,
            )


def new(out: Path, *arguments: str) -> str:
    """The output of `ibrobot lerobot new`."""
    ran = CliRunner().invoke(lerobot, ["new", str(out), *arguments], catch_exceptions=False, standalone_mode=False)
    return ran.output


class TestNew:
    def test_a_new_robot_has_the_joints_and_ranges_of_lerobot(self, tmp_path: Path) -> None:
        out = tmp_path / "arm.yaml"
        result = CliRunner().invoke(lerobot, ["new", str(out), "fake_arm"], catch_exceptions=False)
        assert result.output.startswith(f"{out}: fake_arm, 6 joints\n")
        assert "guesses" not in result.output
        config = load_config(out)
        assert config.robot.joint_names == JOINTS
        tick = 2 * math.pi / 4096
        expected = [(700 - 2048) * tick] * 2 + [(2048 - 3300) * tick] + [(700 - 2048) * tick] * 2 + [0.0]
        np.testing.assert_allclose(config.robot.lower, expected, atol=1e-3)
        assert config.hardware["hardware"].options.config["id"] == "fake_arm"

    def test_a_base_is_driven_in_a_mode_of_its_own(self, tmp_path: Path) -> None:
        out = tmp_path / "base.yaml"
        CliRunner().invoke(lerobot, ["new", str(out), "fake_base"], catch_exceptions=False)
        config = load_config(out)
        assert config.robot.joint_names == ("gripper", "x", "y", "theta")
        assert config.control_modes["drive"].devices == {"base": "cmd_vel"}
        assert config.executors["base_position"].joints == ("x", "y", "theta")

    @pytest.mark.parametrize("port", [None, "/dev/serial/mine"])
    def test_lerobot_gets_the_port_and_not_its_variable(
        self, port: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[dict[str, object]] = []

        class Link(DeviceLink):
            def __init__(self, kind: str, type_: str, config: dict[str, object], **more: Any) -> None:
                made.append(dict(config))
                super().__init__(kind, type_, config, **more)

        monkeypatch.setattr(new_robot, "DeviceLink", Link)
        monkeypatch.delenv("IBROBOT_FOLLOWER_PORT", raising=False)
        if port is not None:
            monkeypatch.setenv("IBROBOT_FOLLOWER_PORT", port)
        out = tmp_path / "arm.yaml"
        CliRunner().invoke(lerobot, ["new", str(out), "fake_arm"], catch_exceptions=False)
        assert [each["port"] for each in made] == [port or "/dev/ttyACM0"]
        assert "${IBROBOT_FOLLOWER_PORT:/dev/ttyACM0}" in out.read_text(), "the YAML keeps the variable"

    @pytest.mark.parametrize("name", ["{}", "0{}", "1e{}", "on{}", "a b{}", "m,{}", "é{}", "#{}"])
    def test_names_of_joints_are_texts(self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        names = [name.format(i) for i in range(1, 6)] + ["gripper"]
        known = new_robot.describe_robot("fake_arm", "fake_arm", {})
        pairs = zip(known.mapped, names, strict=True)
        mapped = [attrs.evolve(each, joint=joint, feature=joint) for each, joint in pairs]
        limits = dict(zip(names, known.limits.values(), strict=True))
        made = attrs.evolve(known, mapped=mapped, limits=limits, leader="")
        document = parse_yaml(new_robot.robot_yaml(made), "made.yaml")
        document.raise_problems()
        assert [each["name"] for each in document.root["robot"]["joints"]] == names
        assert document.root["robot"]["groups"]["arm"] == names[:-1]
        (observed,) = document.root["contract"]["observations"]
        assert observed["select"] == [f"position.{each}" for each in names]

    def test_a_faulty_yaml_is_not_left_behind(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(new_robot, "robot_yaml", lambda found: "robot: {name: 1}")
        out = tmp_path / "arm.yaml"
        before = set(tmp_path.iterdir())
        with pytest.raises(ConfigError, match=f"{out}:1: robot"):
            CliRunner().invoke(lerobot, ["new", str(out), "fake_arm"], catch_exceptions=False)
        assert set(tmp_path.iterdir()) == before

    @pytest.mark.parametrize(
        ("type_", "unknown"),
        [("strange_follower", "pan, lift, tilt"), ("strange_base", "grip, x, y, theta")],
    )
    def test_without_a_unit_there_is_no_file(self, lerobot: Path, tmp_path: Path, type_: str, unknown: str) -> None:
        install_package(lerobot, "lerobot_robot_strange")
        out = tmp_path / "arm.yaml"
        with pytest.raises(HardwareError, match=f"does not say the unit of {type_}'s {unknown}: .* --unit "):
            new(out, type_)
        assert not out.exists()

    @pytest.mark.parametrize("unit", ["radians", "degrees"])
    def test_a_stated_unit_is_what_the_robot_is_sent(self, lerobot: Path, tmp_path: Path, unit: str) -> None:
        install_package(lerobot, "lerobot_robot_strange")
        out = tmp_path / "arm.yaml"
        output = new(out, "strange_follower", "--unit", unit, "--unit", "tilt=range_0_100")
        assert "note: the file has no leader: LeRobot does not say the unit of strange_leader's pan, lift" in output
        (device,) = load_config(out).hardware.values()
        assert device.options.units == {"*": unit, "tilt": "range_0_100"}
        assert "strange_leader" not in out.read_text()

    @pytest.mark.parametrize("unit", ["pan=degree", "x=metres", "=degrees", "turns"])
    def test_a_wrong_unit_is_named(self, lerobot: Path, tmp_path: Path, unit: str) -> None:
        install_package(lerobot, "lerobot_robot_strange")
        out = tmp_path / "arm.yaml"
        with pytest.raises((HardwareError, RequestError), match=f"'{unit.rpartition('=')[2]}'|has no '(x|)'|say the"):
            new(out, "strange_follower", "--unit", unit)
        assert not out.exists()

    def test_a_robot_that_cannot_be_made_is_an_error_without_advice_to_install(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(new_robot, "_required", lambda fields, prefix: {"port": "nowhere", "gain": -1})
        with pytest.raises(HardwareError) as error:
            new(tmp_path / "arm.yaml", "fake_arm")
        assert str(error.value) == "fake_arm: LeRobot's fake_arm refuses its config: gain must not be negative"

    def test_an_existing_file_is_not_overwritten(self, tmp_path: Path) -> None:
        out = tmp_path / "arm.yaml"
        out.write_text("mine")
        with pytest.raises(HardwareError, match="exists already, and is not overwritten"):
            CliRunner().invoke(lerobot, ["new", str(out), "fake_arm"], catch_exceptions=False, standalone_mode=False)
        assert out.read_text() == "mine"
