"""Sections of an imported robot: what its file lacks, as ibrobot ships it for an SO-101."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ibrobot_import.so101 import Body, shipped
from ibrobot_import.source import From, Node, Titled

WEB = {"web": From({"type": "web"}, "added, for the mode web")}
"""The device of the mode `web`."""
CONTROL = {"rate_hz": 100, "stop": "hold"}
"""The section `control`."""


def robot_section(
    body: Body,
    name: From,
    robot_type: From | None,
    limits: Mapping[str, tuple[float, float, Node]] | None = None,
    poses: Mapping[str, From] | None = None,
    groups: Mapping[str, From] | None = None,
) -> dict[str, Any]:
    """The section `robot`.

    Args:
        body: the arms.
        name: name of the robot.
        robot_type: LeRobot's name of the robot type.
        limits: joint -> lower and upper limit [rad] and where they stand; the narrower ones hold.
        poses: name -> joint positions [rad], beside those of ibrobot's own.
        groups: name -> joints, for groups of `body` that are in the file.
    """
    own = shipped(body.config)["robot"]
    joints: list[From] = []
    for each in own["joints"]:
        lower, upper, node = (limits or {}).get(each["name"], (each["lower"], each["upper"], None))
        narrowed = {**each, "lower": max(lower, each["lower"]), "upper": min(upper, each["upper"])}
        if node is None:
            joints.append(body.own(narrowed))
            continue
        if narrowed["lower"] >= narrowed["upper"]:
            node.wrong(f"leaves {each['name']} no range within {each['lower']} to {each['upper']} rad")
        joints.append(node.gives(narrowed, f"the narrower of it and {body.origin}"))
    poses = {name: body.own(pose) for name, pose in own["description"]["poses"].items()} | dict(poses or {})
    return {
        "name": name,
        "robot_type": robot_type or body.own(own["robot_type"]),
        "joints": joints,
        "groups": {name: body.own(group) for name, group in (body.groups | body.grippers).items()} | dict(groups or {}),
        "description": {name: body.own(value) for name, value in own["description"].items()} | {"poses": poses},
    }


def hardware_section(body: Body, ports: Sequence[From | None], calibrations: Sequence[From | None]) -> dict[str, Any]:
    """The section `hardware`, with a port and a calibration for each arm."""
    own = shipped(body.config)["hardware"]
    parts = {"": own} if len(body.prefixes) == 1 else own
    section = {}
    for (name, part), port, calibration in zip(parts.items(), ports, calibrations, strict=True):
        given = {"port": port, "calibration": calibration}
        section[name] = {key: given.get(key) or body.own(value) for key, value in part.items()}
    return section.get("", section)


def executor_sections(names: Mapping[str, tuple[str, str, str, int]]) -> dict[str, Any]:
    """The section `executors`: name -> type, group, comment and line."""
    return {
        name: From(
            {"type": type_, "group": group} | ({"stale_timeout": 0.25} if type_ == "position" else {}), comment, line
        )
        for name, (type_, group, comment, line) in names.items()
    }


def streams(body: Body) -> dict[str, tuple[str, str, str, int]]:
    """An executor of setpoints for each group, as for `executor_sections`."""
    return {f"{group}_position": ("position", group, body.origin, 0) for group in body.groups}


def added_modes(executors: Sequence[str], taken: Sequence[str]) -> dict[str, Any]:
    """Modes that every robot can run, also in simulation, without devices."""
    modes = {
        "hold": added_mode(executors, "holds its pose, needs no device"),
        "web": added_mode(executors, "driven from the page of `ibrobot launch --web`", "web"),
    }
    return {name: mode for name, mode in modes.items() if name not in taken}


def added_mode(executors: Sequence[str], remark: str, teleop: Any = None) -> Titled:
    """A mode that the file does not have, with its device or, for each group, the devices."""
    device = From(teleop, "added") if teleop is not None else None
    return Titled({"executors": From(list(executors), "added"), "teleop": device}, f"added: {remark}")


def sections(
    body: Body, robot: Mapping[str, Any], hardware: Mapping[str, Any], cameras: Sequence[Any], modes: Mapping[str, Any],
    devices: Mapping[str, Any], rate: From | None, observations: Sequence[Any],
) -> dict[str, Any]:  # fmt: skip
    """The sections of the new file, with all that a file lacks which has no executors and modes.

    Args:
        body: the arms.
        robot: the section `robot`.
        hardware: the section `hardware`.
        cameras: the peripherals.
        modes: the modes of the file's devices; the first one is the default.
        devices: the section `teleoperation`.
        rate: rate of the contract [Hz].
        observations: observations of the contract.
    """
    executors = streams(body)
    return {
        "robot": robot,
        "hardware": hardware,
        "simulation": simulation_section(),
        "peripherals": list(cameras),
        "executors": executor_sections(executors),
        "control_modes": {**modes, **added_modes(list(executors), list(modes))},
        "default_control_mode": From(next(iter(modes), "hold"), "added"),
        "teleoperation": {**devices, **WEB},
        "contract": {
            "rate_hz": rate,
            "observations": observations,
            "actions": [action_part(name, body.origin) for name in executors],
        },
        "control": body.own(CONTROL),
    }


def simulation_section(type_: From | None = None, scene: From | None = None) -> dict[str, Any]:
    """The section `simulation`."""
    return {
        "type": type_ or From("mujoco", "added"),
        "scene": scene or From("empty", "added"),
        "default_control_mode": From("hold", "added: a mode that needs no device"),
    }


def simulated(name: str, body: Body) -> From | None:
    """With --sim, the scene's camera for one whose name no camera of scenes has: by the words in its name."""
    wrists = {f"{prefix}wrist": f"{prefix}wrist_cam" for prefix in body.prefixes}
    if name in ("top", "front", *wrists):
        return None
    sides = [camera for prefix, camera in zip(body.prefixes, wrists.values(), strict=True) if prefix in name]
    if "wrist" in name or "hand" in name:
        camera = sides[0] if sides else next(iter(wrists.values()))
    else:
        camera = "front" if "front" in name else "top"
    cameras = ", ".join(("top", "front", *wrists.values()))
    return From({"camera": camera}, f"GUESS: with --sim, a camera of the scene: {cameras}")


def state_observation(body: Body) -> dict[str, Any]:
    """The observation of all joints, as LeRobot's datasets have it."""
    return {
        "key": body.own("observation.state"),
        "topic": body.own("/joint_states"),
        "select": body.own([f"position.{name}" for name in body.joints]),
        "align": body.own({"strategy": "hold", "stamp": "header"}),
    }


def picture_observation(key: From, peripheral: str) -> dict[str, Any]:
    """The observation of a camera."""
    return {
        "key": key,
        "peripheral": From(peripheral, "added"),
        "align": From({"strategy": "asof", "stamp": "header", "tol_ms": 100}, "added"),
    }


def action_part(executor: str, comment: str = "added", line: int = 0) -> dict[str, Any]:
    """The part of the action vector that an executor follows."""
    return {
        "key": From("action", comment, line),
        "executor": From(executor, comment, line),
        "topic": From(f"/{executor}_controller/commands", comment, line),
        "safety_behavior": From("hold", "added"),
    }
