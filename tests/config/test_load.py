"""What a good config becomes: order, defaults, paths, environment, simulation, and rebuilding it elsewhere."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import attrs
import pytest

from ibrobot_core.config import RobotConfig, find_config, from_document, load_config
from ibrobot_core.config.show import to_yaml
from ibrobot_core.descriptors import EngineDescriptor
from ibrobot_core.errors import ConfigError
from ibrobot_core.plugins import Registry

Load = Callable[..., RobotConfig]
Faults = Callable[..., str]


def test_sections_become_objects(load_text: Load, base: str) -> None:
    config = load_text(base)

    assert config.robot.joint_names == ("pan", "lift", "grip")
    assert config.executors["arm_position"].joints == ("pan", "lift")
    assert config.hardware["hardware"].joints == ("pan", "lift", "grip")
    assert config.hardware["hardware"].options.max_speed == 3.0
    assert config.control_modes["plan"].planner is not None
    assert config.control_modes["policy"].dispatch.watermark == "auto"
    assert not config.simulated
    assert config.simulation is None


def test_topics_and_types_of_observations_are_filled_in(load_text: Load, base: str) -> None:
    state, image = load_text(base).contract.observations

    assert (state.topic, state.type) == ("/joint_states", "sensor_msgs/msg/JointState")
    assert (image.topic, image.type) == ("/camera/top/image_raw", "sensor_msgs/msg/Image")


def test_an_int_is_accepted_for_a_float(load_text: Load, base: str) -> None:
    rate = load_text(base).control.rate_hz

    assert rate == 100.0
    assert isinstance(rate, float)


def test_simulation_stands_for_hardware_and_its_sensors_for_real_ones(load_text: Load, base: str) -> None:
    text = base.replace("type: webcam, fps: 30", "type: webcam, device: 3, width: 320, fps: 15, sim: {shadows: true}")
    config = load_text(text, sim=True)

    assert config.simulated
    assert config.hardware == {}
    assert config.simulation is not None
    top = config.peripherals["top"]
    assert top.type == "virtual"
    assert (top.options.width, top.options.fps, top.options.shadows) == (320, 15.0, True)
    assert config.peripherals["chest"].type == "gyro"


@pytest.mark.parametrize(
    ("sim", "mode", "begins"),
    [(False, None, "teleop"), (True, None, "policy"), (True, "plan", "plan"), (False, "plan", "plan")],
)
def test_a_simulation_may_begin_in_a_mode_of_its_own(
    load_text: Load, base: str, sim: bool, mode: str | None, begins: str
) -> None:
    text = base.replace("{type: world}", "{type: world, default_control_mode: policy}")
    assert load_text(text, sim=sim, mode=mode).default_control_mode == begins


def test_an_unknown_mode_of_the_simulation_is_reported(faults_of_edit: Faults) -> None:
    message = faults_of_edit("{type: world}", "{type: world, default_control_mode: polcy}", sim=True)
    assert "simulation.default_control_mode: unknown control mode 'polcy', did you mean 'policy'?" in message


def test_simulation_needs_no_plugin_of_the_real_robot(load_text: Load, base: str, registry: Registry) -> None:
    del registry.entries["hardware", "bus"]
    del registry.entries["sensor", "webcam"]

    assert load_text(base, sim=True).peripherals["top"].type == "virtual"
    with pytest.raises(ConfigError, match="unknown hardware type 'bus'"):
        load_text(base)


def test_the_real_robot_needs_no_plugin_of_the_simulation(load_text: Load, base: str, registry: Registry) -> None:
    del registry.entries["hardware", "world"]

    assert load_text(base).hardware


def test_a_file_without_hardware_is_simulated(load_text: Load, base: str) -> None:
    text = base.replace("hardware: {type: bus, port: /dev/null}\n", "")

    assert load_text(text).simulated


def test_sim_without_simulation_is_refused(faults_of_edit: Faults) -> None:
    message = faults_of_edit("simulation: {type: world}\n", "", sim=True)

    assert message == "robot.yaml: --sim needs a simulation section, e.g. simulation: {type: mujoco}"


def test_faults_of_real_sensors_are_reported_in_simulation_too(faults_of_edit: Faults) -> None:
    message = faults_of_edit("type: webcam, fps: 30", "type: webcam, fsp: 30", sim=True)

    assert message == "robot.yaml:15: peripherals.top.fsp: unknown key, did you mean 'fps'?"


def test_faults_of_sim_options_are_reported_where_they_are(faults_of_edit: Faults) -> None:
    message = faults_of_edit("type: webcam, fps: 30", "type: webcam, sim: {\n      fps: 300, shadow: true}", sim=True)

    assert message == (
        "robot.yaml:16: peripherals.top.sim.fps: 300.0 is too large, must be at most 120 Hz\n"
        "robot.yaml:16: peripherals.top.sim.shadow: unknown key, did you mean 'shadows'?"
    )


def test_several_hardware_components_own_their_joints(load_text: Load, base: str) -> None:
    both = "hardware: {l: {type: bus, port: a, joints: [pan, lift]}, r: {type: bus, port: b, joints: [grip]}}"
    config = load_text(base.replace("hardware: {type: bus, port: /dev/null}", both))

    assert {name: part.joints for name, part in config.hardware.items()} == {"l": ("pan", "lift"), "r": ("grip",)}


def test_relative_paths_start_at_the_file(load_text: Load, base: str, tmp_path: Path) -> None:
    config = load_text(base.replace("port: /dev/null}", "port: /dev/null, calibration: cal/left.json}"))

    assert config.hardware["hardware"].options.offsets == tmp_path / "cal" / "left.json"


def test_package_paths_are_found_without_an_import(
    load_text: Load, base: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site" / "some_arm"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "arm.xml").write_text("<mujoco/>")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))

    config = load_text(base.replace("    poses:", "    mjcf: package://some_arm/arm.xml\n    poses:"))

    assert config.robot.description.mjcf == package / "arm.xml"


def test_environment_and_home_are_expanded(load_text: Load, base: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARM_PORT", "/dev/ttyACM7")
    monkeypatch.setenv("HOME", "/home/somebody")
    monkeypatch.delenv("ARM_BAUD", raising=False)
    block = (
        "hardware:\n  type: bus\n  port: ${ARM_PORT:/dev/null}\n  baud: ${ARM_BAUD:115200}\n  calibration: ~/arm.json\n"
    )
    options = load_text(base.replace("hardware: {type: bus, port: /dev/null}\n", block)).hardware["hardware"].options

    assert options.port == "/dev/ttyACM7"
    assert options.baud == 115200
    assert options.offsets == Path("/home/somebody/arm.json")


def test_merge_keys_fill_in_what_is_not_given(load_text: Load, base: str) -> None:
    text = base.replace("grip_position: {type: position", "grip_position: {<<: *defaults, type: position")
    text = text.replace("arm_position: {type", "arm_position: &defaults {stale_timeout: 0.5, type")
    executors = load_text(text).executors

    assert executors["grip_position"].options.stale_timeout == 0.5
    assert executors["grip_position"].group == "gripper"


@pytest.mark.parametrize("where", ["action", "executor"])
def test_either_the_action_or_its_executor_says_what_follows_stale_setpoints(
    load_text: Load, base: str, where: str
) -> None:
    old = "topic: /arm/commands" if where == "action" else "arm_position: {type: position"
    config = load_text(base.replace(old, f"{old}, safety_behavior: relax"))

    assert config.contract.actions[0].safety_behavior == "relax"
    assert config.executors["arm_position"].options.safety_behavior == "relax"
    assert config.executors["grip_position"].options.safety_behavior == "hold"


def test_an_action_that_contradicts_its_executor_is_refused(faults_of_edit: Faults, base: str) -> None:
    message = faults_of_edit(
        base[base.index("  arm_position") :],
        base[base.index("  arm_position") :]
        .replace("arm_position: {type: position", "arm_position: {type: position, safety_behavior: relax")
        .replace("topic: /arm/commands", "topic: /arm/commands, safety_behavior: hold"),
    )

    assert message == (
        "robot.yaml:38: contract.actions.0.safety_behavior: 'hold' contradicts 'relax' of executor 'arm_position'"
    )


@pytest.mark.parametrize("sim", [False, True])
def test_a_config_is_rebuilt_from_its_document(load_text: Load, base: str, registry: Registry, sim: bool) -> None:
    config = load_text(base, sim=sim, overrides=["control.rate_hz=50"], mode="plan")
    document = json.loads(json.dumps(config.document))

    assert from_document(document, source=config.source, sim=sim, registry=registry) == config


@pytest.mark.parametrize("sim", [False, True])
def test_what_show_prints_loads_to_the_same(load_text: Load, base: str, sim: bool) -> None:
    text = base.replace("recording: {type: log}", 'recording: {type: log, dataset: "1e-3"}')
    text = text.replace("topic: /arm/commands", "topic: /arm/commands, safety_behavior: relax")
    config = load_text(text, sim=sim)
    again = load_text(to_yaml(config), sim=sim)

    assert attrs.evolve(again, document={}) == attrs.evolve(config, document={})


def test_options_of_an_engine_stand_beside_its_execution_mode(load_text: Load, base: str, registry: Registry) -> None:
    entry = registry.entries["engine", "far"]
    assert isinstance(entry.descriptor, EngineDescriptor)
    descriptor = attrs.evolve(entry.descriptor, uses_transport=False)  # for a YAML without a transport
    registry.entries["engine", "far"] = attrs.evolve(entry, descriptor=descriptor)
    config = load_text(base.replace("{model: net}", "{model: net, execution_mode: far, server: big}"))
    inference = config.control_modes["policy"].inference

    assert inference is not None
    assert (inference.type, inference.options.server, inference.request_timeout) == ("far", "big", 5.0)
    assert "execution_mode: far" in to_yaml(config)
    assert load_text(to_yaml(config)).control_modes == config.control_modes


@pytest.mark.parametrize("name", ["mini", "mini.yaml"])
def test_shipped_configs_are_found_by_name(
    name: str, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    assert find_config(name, registry) == tmp_path / "shipped" / "mini.yaml"
    assert find_config(None, registry).name == "so101.yaml"
    (tmp_path / "mini.yaml").write_text("")
    assert find_config("mini.yaml", registry) == Path("mini.yaml")


def test_an_unknown_config_names_the_known(registry: Registry) -> None:
    with pytest.raises(ConfigError, match=r"^minni: no such file, and no config of this name, did you mean 'mini'\?$"):
        find_config("minni", registry)
    with pytest.raises(ConfigError, match=r"the configs are: bi_so101, .*so101.*, mini$"):
        find_config("zzzzz", registry)
    with pytest.raises(ConfigError, match=r"^no/where\.yaml: no such file$"):
        find_config("no/where.yaml", registry)


def test_a_file_that_cannot_be_read(registry: Registry, tmp_path: Path) -> None:
    binary = tmp_path / "x.yaml"
    binary.write_bytes(b"\xff\xfe\x00")

    with pytest.raises(ConfigError, match=r"cannot be read: not UTF-8 text$"):
        load_config(binary, registry=registry)
    with pytest.raises(ConfigError, match=r"cannot be read: Is a directory$"):
        load_config(tmp_path, registry=registry)


@pytest.mark.parametrize(("text", "found"), [("", "nothing"), ("- a", "a list"), ("5", "5")])
def test_a_file_without_a_mapping_is_refused(load_text: Load, text: str, found: str) -> None:
    with pytest.raises(ConfigError, match=f"^robot.yaml: expected a mapping of sections, got {found}$"):
        load_text(text)


NOT_INSTALLED = "executor type 'trajectory' needs a plugin that is not installed: pip install ibrobot-plugin-planning"


def test_mode_whose_executor_is_not_installed_is_unavailable(base: str, load_text: Load) -> None:
    config = load_text(base.replace("type: waypoints", "type: trajectory"))
    assert config.unavailable == {"plan": NOT_INSTALLED}
    assert "arm_trajectory" not in config.executors


def test_mode_with_a_planner_is_unavailable_without_the_source_of_goals(
    base: str, load_text: Load, registry: Registry
) -> None:
    del registry.entries["source", "planner"]
    message = "a mode with planner needs a plugin that is not installed: pip install ibrobot-plugin-planning"
    assert load_text(base).unavailable == {"plan": message}
    with pytest.raises(ConfigError, match=rf"^robot.yaml:28: control_modes.plan.planner.type: {message}$"):
        load_text(base, mode="plan")


@pytest.mark.parametrize("mode", ["teleop", "plan"])
def test_executor_of_the_contract_must_be_installed(faults_of_edit: Faults, mode: str) -> None:
    message = faults_of_edit("arm_position: {type: position", "arm_position: {type: trajectory", mode=mode)
    assert message == f"robot.yaml:18: executors.arm_position.type: {NOT_INSTALLED}"


@pytest.mark.parametrize(("simulation", "hint"), [("world", "; or run it in simulation: --sim"), ("mujoco", "")])
def test_hardware_that_is_not_installed_mentions_an_installed_simulation(
    faults_of_edit: Faults, simulation: str, hint: str
) -> None:
    message = faults_of_edit(
        "hardware: {type: bus, port: /dev/null}\nsimulation: {type: world}",
        f"hardware: {{type: feetech_so101}}\nsimulation: {{type: {simulation}}}",
    )
    assert message == (
        "robot.yaml:12: hardware.type: hardware type 'feetech_so101' needs a plugin that is not installed: "
        f"pip install ibrobot-plugin-feetech{hint}"
    )
