"""The control modes of a robot as pages offer them: what each does, and how it is driven."""

from __future__ import annotations

from collections import Counter
from typing import Any

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import ControlMode, RobotConfig

_PAGE = "web"
"""The type of the teleoperation device that is the robot's page."""


def modes_json(config: RobotConfig, plugins: Any, *, terminal: bool) -> list[dict[str, Any]]:
    """The modes, in the order of the YAML.

    Each has its `name`, a `label` that says what it does in the words of the plugins that do it, whether a `policy` or
    the `planner` drives it, the `jogs` of the page (device -> joints), and why it is `unavailable`.

    Args:
        config: the robot.
        plugins: the plugins, a `Registry` or as a run has them.
        terminal: whether the run has a terminal.
    """
    labels = {name: _label(config, mode, plugins) for name, mode in config.control_modes.items()}
    counts = Counter(labels.values())
    return [
        {
            "name": name,
            "label": labels[name] if counts[labels[name]] == 1 else f"{labels[name]} ({name})",
            "planner": mode.planner is not None,
            "policy": mode.inference is not None,
            "jogs": _jogs(config, mode),
            "unavailable": config.unavailable.get(name) or ("" if terminal else _lacks_terminal(config, mode)),
        }
        for name, mode in config.control_modes.items()
    ]


def page_devices(config: RobotConfig, mode: ControlMode) -> dict[str, str]:
    """Joint group -> the page's own device that moves it in a mode, also one that takes the robot from a policy.

    An empty group stands for all joints.
    """
    devices = {**mode.devices, **(mode.inference.devices if mode.inference is not None else {})}
    return {group: name for group, name in devices.items() if config.teleoperation[name].type == _PAGE}


def _jogs(config: RobotConfig, mode: ControlMode) -> dict[str, list[str]]:
    robot = config.robot
    return {
        name: list((robot.part(group) if group else robot).joint_names)
        for group, name in page_devices(config, mode).items()
    }


def _label(config: RobotConfig, mode: ControlMode, plugins: Any) -> str:
    if mode.inference is not None:
        return f"run the policy {mode.inference.model}"
    if mode.planner is not None:
        return _words(plugins, "source", "planner") or mode.name
    words = {group: _words(plugins, "teleop", config.teleoperation[name].type) for group, name in mode.devices.items()}
    if len(set(words.values())) == 1:
        groups = " and ".join(filter(None, words))
        return next(iter(words.values())) + (f": {groups}" if groups else "")
    return " and ".join(f"{group}: {text}" if group else text for group, text in words.items()) or mode.name


def _words(plugins: Any, kind: str, type_: str) -> str:
    """What a plugin says that its type does; its name if it is not installed."""
    try:
        descriptor = plugins.find(kind, type_)
    except IbrobotError:
        return type_
    words: str = descriptor.label or descriptor.summary
    return words


def _lacks_terminal(config: RobotConfig, mode: ControlMode) -> str:
    names = [name for name in mode.devices.values() if config.teleoperation[name].options.terminal_keys(config.robot)]
    return f"{' and '.join(names)} needs a terminal: start the robot in one, with ibrobot launch" if names else ""
