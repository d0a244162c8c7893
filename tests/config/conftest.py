"""A small robot YAML and a registry of made-up plugins that it needs."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import attrs
import pytest

from ibrobot_core.api import Options
from ibrobot_core.config import RobotConfig, load_config
from ibrobot_core.descriptors import (
    ConfigFile,
    Descriptor,
    EngineDescriptor,
    ExecutorDescriptor,
    HardwareDescriptor,
    PolicyDescriptor,
    RecorderDescriptor,
    SensorDescriptor,
    SourceDescriptor,
    TeleopDescriptor,
)
from ibrobot_core.errors import ConfigError
from ibrobot_core.options import option
from ibrobot_core.plugins import Entry, Registry, discover

BASE = textwrap.dedent("""\
    robot:
      name: mini
      joints:
        - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
        - {name: lift, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
        - {name: grip, lower: 0.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
      groups:
        arm: [pan, lift]
        gripper: [grip]
      description:
        poses: {home: [0, 0, 0]}
    hardware: {type: bus, port: /dev/null}
    simulation: {type: world}
    peripherals:
      - {name: top, kind: camera, type: webcam, fps: 30}
      - {name: chest, kind: imu, type: gyro}
    executors:
      arm_position: {type: position, group: arm}
      grip_position: {type: position, group: gripper}
      arm_trajectory: {type: waypoints, group: arm}
    models:
      net: {type: net}
    control_modes:
      policy:
        executors: [arm_position, grip_position]
        inference: {model: net}
      teleop: {executors: [arm_position, grip_position], teleop: stick}
      plan: {executors: [arm_trajectory], planner: {type: straight}}
    default_control_mode: teleop
    teleoperation:
      stick: {type: stick}
    contract:
      rate_hz: 30
      observations:
        - {key: observation.state, topic: /joint_states, select: [position.pan, position.lift, position.grip]}
        - {key: observation.images.top, peripheral: top, align: {strategy: asof, tol_ms: 100}}
      actions:
        - {executor: arm_position, topic: /arm/commands}
        - {executor: grip_position, topic: /grip/commands}
    recording: {type: log}
    control: {rate_hz: 100, stop: hold}
    """)


@attrs.frozen
class BusOptions(Options):
    port: str = option(help="serial port")
    max_speed: float = option(3.0, unit="rad/s", gt=0, help="speed limit of the servos")
    baud: int = option(1_000_000, unit="Bd", ge=9600, help="speed of the bus")
    torque: bool = option(True, help="whether to hold")
    offsets: Path | None = option(None, help="calibration file", key="calibration")
    parity: Literal["none", "even"] = option("none", help="parity")

    def devices(self) -> Mapping[str, str]:
        return {"port": self.port}


@attrs.frozen
class WebcamOptions(Options):
    device: int = option(0, help="index")
    width: int = option(640, unit="px", ge=1, help="width")
    fps: float = option(30.0, unit="Hz", gt=0, help="rate")

    def devices(self) -> Mapping[str, str]:
        return {"device": f"/dev/video{self.device}"}


@attrs.frozen
class VirtualOptions(Options):
    width: int = option(640, unit="px", ge=1, help="width")
    fps: float = option(30.0, unit="Hz", gt=0, le=120, help="rate")
    shadows: bool = option(False, help="whether to render shadows")


@attrs.frozen
class NetOptions(Options):
    layers: tuple[int, ...] = option((), help="sizes")
    gains: tuple[float, float] = option((1.0, 1.0), help="two gains")
    scale: float | str = option("auto", help="a number, or auto")


@attrs.frozen
class FarOptions(Options):
    server: str = option("", help="where the model is")


def _make(options: object, ctx: object) -> Any:
    raise AssertionError("checking a config makes nothing")


@pytest.fixture(scope="session")
def base() -> str:
    return BASE


@pytest.fixture
def load_text(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RobotConfig]:
    """Load a config text, written to `robot.yaml` in the working directory."""
    monkeypatch.chdir(tmp_path)

    def load_robot(text: str, **options: Any) -> RobotConfig:
        Path("robot.yaml").write_text(text, encoding="utf-8")
        return load_config("robot.yaml", registry=registry, **options)

    return load_robot


@pytest.fixture
def faults_of_edit(load_text: Callable[..., RobotConfig], tmp_path: Path) -> Callable[..., str]:
    """The whole error for the base config with `old` replaced by `new`; its folder reads FOLDER."""

    def faults(old: str, new: str, **options: Any) -> str:
        assert BASE.count(old) == 1
        with pytest.raises(ConfigError) as message:
            load_text(BASE.replace(old, new), **options)
        return str(message.value).replace(str(tmp_path), "FOLDER")

    return faults


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    registry = discover([])
    offered: list[tuple[str, Descriptor[Any]]] = [
        ("hardware", HardwareDescriptor("bus", _make, "a bus", BusOptions)),
        ("hardware", HardwareDescriptor("world", _make, "a world", simulated=True, sensors={"camera": "virtual"})),
        ("sensor", SensorDescriptor("webcam", _make, "a camera", WebcamOptions)),
        ("sensor", SensorDescriptor("virtual", _make, "a camera", VirtualOptions)),
        ("sensor", SensorDescriptor("gyro", _make, "a gyroscope", kind="imu")),
        ("policy", PolicyDescriptor("net", _make, "a network", NetOptions)),
        ("engine", EngineDescriptor("far", _make, "on a server", FarOptions, uses_transport=True)),
        ("teleop", TeleopDescriptor("stick", _make, "a stick")),
        ("planner", Descriptor("straight", _make, "straight lines")),
        ("source", SourceDescriptor("planner", make=_make, summary="goals")),
        ("executor", ExecutorDescriptor("waypoints", _make, "straight lines")),
        ("recorder", RecorderDescriptor("log", _make, "a log")),
    ]
    for kind, descriptor in offered:
        registry.entries[kind, descriptor.type] = Entry(kind, descriptor, "fake", "ibrobot-plugin-fake", "1.0")
    shipped = tmp_path / "shipped" / "mini.yaml"
    shipped.parent.mkdir()
    shipped.write_text(BASE)
    registry.configs.append(ConfigFile("mini", shipped))
    return registry
