"""Imports LeRobot's configs of robots and recordings, and its calibrations, for SO-100 and SO-101."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_calibration import load_calibration

from ibrobot_import import parts, so101
from ibrobot_import.source import Fate, From, Node, Source, Titled, plain_name

_SINGLE = ("so100_follower", "so101_follower", "so_follower")
_DOUBLE = ("bi_so100_follower", "bi_so101_follower", "bi_so_follower")
_LEADERS = ("so100_leader", "so101_leader", "so_leader")
_BI_LEADERS = ("bi_so100_leader", "bi_so101_leader", "bi_so_leader")
_DEVICES = {"keyboard": "keyboard", "gamepad": "gamepad", "phone": "webxr"}
_CAMERA = {
    "color_mode color_format": "datasets have RGB",
    "warmup_s": "a camera is ready when its first image came",
    "backend": "cameras are opened by Video4Linux, streams and files by OpenCV",
    "use_depth": "a further peripheral {type: realsense, stream: depth} gives depth",
    "rotation": "this camera is not turned here",
}
_DATASET = {
    "repo_id": "`ibrobot record --dataset`, and `ibrobot datasets push` after `ibrobot convert`",
    "single_task": "`ibrobot record --prompt`",
    "num_episodes": "`ibrobot record --episodes`",
    "root": "`ibrobot convert --out`; recordings are bags below recording.root",
    "push_to_hub private tags": "`ibrobot datasets push`, after `ibrobot convert`",
    "reset_time_s": "the operator begins each episode",
    "video vcodec": "an option of `ibrobot convert`",
}
_RECORD = {
    "display_data": "`ibrobot record --web`",
    "play_sounds": "`ibrobot record` says when to begin",
    "resume": "a recording goes on in its dataset",
}
_CLIENT = {
    "server_address": "`ibrobot serve` runs a policy for other machines; `transport` and `inference` say where it is",
    "policy_type policy_device": "the checkpoint says what it is, and the model's option `device` where it runs",
    "actions_per_chunk chunk_size_threshold aggregate_fn_name": "`inference` says how chunks follow one another",
    "task": "`inference: {prompt: …}` of a mode",
    "client_device": "actions are plain numbers in a run",
    "debug_visualize_queue_size": "the panel of a run shows its plan",
}
"""Keys of the client of LeRobot's asynchronous inference."""
_STEP = "the robot's joints have max_velocity and max_acceleration, which always hold"


def convert_calibration(source: Source) -> dict[str, Any]:
    """An SO-101 with this calibration.

    Raises:
        CalibrationError: if it is wrong.
    """
    path = Path(source.document.file).absolute()
    load_calibration(path, tuple(so101.SERVOS.values()))
    source.mark((), Fate.TAKEN, "hardware.calibration reads it as it is")
    return _sections(so101.SINGLE, [None], [From(str(path), "this file, which stays as it is")], {}, {})


def convert(source: Source) -> dict[str, Any]:
    """The sections of the new file."""
    root = source.root
    record = root["robot"].value is not None
    robot = root["robot"] if record else root
    kind = robot["type"]
    body = so101.SINGLE if kind.value in _SINGLE else so101.DOUBLE if kind.value in _DOUBLE else None
    if body is None:
        kind.wrong(f"there is no plugin here for {kind.value!r}; those imported are: {', '.join((*_SINGLE, *_DOUBLE))}")
        return {}
    kind.changed("feetech_so101", "type: feetech_so101")
    arms = _arms(robot, body)
    cameras = _cameras([robot, *arms])
    devices = _devices(root["teleop"], body) if record else {}
    sections = _sections(
        body, [_port(arm, robot, side) for arm, side in zip(arms, body.prefixes, strict=True)],
        [_calibration(arm, robot, "robots", kind, side) for arm, side in zip(arms, body.prefixes, strict=True)],
        cameras, devices,
    )  # fmt: skip
    for arm in (*arms, robot):
        arm["max_relative_target"].refuse(_STEP)
        arm["use_degrees"].refuse("joints are in radians; `ibrobot convert --norm-mode` chooses the unit of a dataset")
        arm["record_telemetry"].refuse("temperature, load and voltage are published as /diagnostics")
        stop = arm["disable_torque_on_disconnect"]
        if stop.flag() is not None:
            word = "relax" if stop.flag() else "hold"
            sections["control"] = {
                "rate_hz": body.own(100),
                "stop": stop.changed(word, "relax takes the torque off at the end, hold keeps it"),
            }
    if record:
        _record(root, sections)
        root.refuse_all(_CLIENT)
    return sections


def _sections(
    body: so101.Body,
    ports: list[From | None],
    calibrations: list[From | None],
    cameras: Mapping[str, Any],
    devices: Mapping[str, Any],
) -> dict[str, Any]:
    modes = {}
    if devices:
        names = list(devices)
        given: Any = names[0] if len(names) == 1 else dict(zip(body.groups, names, strict=True))
        modes["teleop"] = parts.added_mode(list(parts.streams(body)), "the device of `teleop`", given)
    observations = [parts.state_observation(body)]
    observations += [
        parts.picture_observation(From(f"observation.images.{name}", part["name"].comment, part["name"].line), name)
        for name, part in cameras.items()
    ]
    robot = parts.robot_section(body, body.own(body.config), None)
    hardware = parts.hardware_section(body, ports, calibrations)
    rate = From(30, "LeRobot's default")
    return parts.sections(body, robot, hardware, list(cameras.values()), modes, devices, rate, observations)


def _arms(robot: Node, body: so101.Body) -> list[Node]:
    if len(body.prefixes) == 1:
        return [robot]
    return [robot[f"{prefix}arm_config"] for prefix in body.prefixes]


def _port(arm: Node, robot: Node, side: str) -> From | None:
    return arm["port"].text() or (robot[f"{side}arm_port"].text() if side else None)


def _calibration(arm: Node, whole: Node, kind: str, type_: Node, side: str) -> From | None:
    """The path of a calibration, as LeRobot finds it by the robot's id."""
    name = arm["id"] if arm["id"].value is not None else whole["id"]
    if name.value is None:
        return None
    folder = arm["calibration_dir"] if arm["calibration_dir"].value is not None else whole["calibration_dir"]
    stem = str(name.value) if name.key[:-1] == arm.key else f"{name.value}_{side.rstrip('_')}"
    if folder.value is not None:
        path = Path(str(folder.value)) / f"{stem}.json"
        folder.taken(folder.value)
    else:
        cache = Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface")
        base = Path(os.environ.get("HF_LEROBOT_CALIBRATION") or cache / "lerobot" / "calibration") / kind
        single = str(type_.value).removeprefix("bi_")
        names = dict.fromkeys((re.sub(r"so10[01]", "so", single), single))
        candidates = [base / each / f"{stem}.json" for each in names]
        path = next((each for each in candidates if each.is_file()), candidates[0])
    note = "LeRobot's file, which stays as it is" if path.is_file() else f"LeRobot's file; it is not there: {path}"
    return name.changed(str(path), note if path.is_file() else "LeRobot's file, which is not on this machine")


def _cameras(nodes: list[Node]) -> dict[str, Any]:
    cameras: dict[str, Any] = {}
    for node in nodes:
        for name, camera in node["cameras"].items():
            kind = camera["type"].value
            if kind not in ("opencv", "intelrealsense"):
                camera.refuse(f"there is no plugin here for a camera of type {kind}")
                continue
            plain = plain_name(name)
            prefix = node.key[-1].removesuffix("arm_config") if node.key and isinstance(node.key[-1], str) else ""
            plain = f"{prefix}{plain}" if prefix in so101.DOUBLE.prefixes else plain
            values: dict[str, Any] = {
                "name": camera.gives(plain),
                "kind": camera.gives("camera"),
            }
            if kind == "opencv":
                device = camera["index_or_path"]
                values |= {
                    "type": camera["type"].text(),
                    "device": device.whole() if isinstance(device.value, int) else device.text(),
                    "fourcc": camera["fourcc"].text(),
                }
                turn = camera["rotation"].value
                if isinstance(turn, int) and turn % 90 == 0:
                    values["rotation"] = camera["rotation"].taken(turn % 360)
            else:
                values |= {
                    "type": camera["type"].changed("realsense", "the type here"),
                    "serial": camera["serial_number_or_name"].text(),
                }
            values |= {key: camera[key].whole() for key in ("width", "height")} | {"fps": camera["fps"].number()}
            camera.refuse_all(_CAMERA)
            values["sim"] = parts.simulated(plain, so101.DOUBLE if prefix in so101.DOUBLE.prefixes else so101.SINGLE)
            cameras[plain] = values
    return cameras


def _devices(teleop: Node, body: so101.Body) -> dict[str, Any]:
    kind = teleop["type"]
    if kind.value in _LEADERS and len(body.prefixes) == 1:
        return {"leader": _leader(teleop, teleop, kind, "")}
    if kind.value in _BI_LEADERS and len(body.prefixes) > 1:
        kind.changed("so101_leader", "the type here")
        return {
            f"leader_{prefix.rstrip('_')}": _leader(teleop[f"{prefix}arm_config"], teleop, kind, prefix)
            for prefix in body.prefixes
        }
    if kind.value in _DEVICES and len(body.prefixes) == 1:
        name = kind.changed(_DEVICES[str(kind.value)], "the type here")
        teleop.refuse(f"`ibrobot config schema` has the options of {name.value}")
        return {str(kind.value): teleop.titles({"type": name})}
    teleop.refuse(f"there is no plugin here for a device of type {kind.value} with this robot")
    return {}


def _leader(node: Node, whole: Node, kind: Node, prefix: str) -> Titled:
    own = so101.shipped("so101" if not prefix else "bi_so101")["teleoperation"]
    shipped = own["leader" if not prefix else f"leader_{prefix.rstrip('_')}"]
    values: dict[str, Any] = {
        "type": kind.changed("so101_leader", "the type here"),
        "port": _port(node, whole, prefix) or From(shipped["port"], "so101 of ibrobot"),
        "calibration": _calibration(node, whole, "teleoperators", kind, prefix)
        or From(shipped["calibration"], "so101 of ibrobot"),
        "prefix": From(prefix, "added") if prefix else None,
    }
    node["use_degrees"].refuse("joints are in radians")
    return node.titles(values)


def _record(root: Node, sections: dict[str, Any]) -> None:
    dataset = root["dataset"]
    contract = sections["contract"]
    default = contract.pop("rate_hz")
    rate = dataset["fps"].number() or root["fps"].number()  # of a client, it stands at the top
    times = {"rate_hz": rate or default, "max_duration_s": dataset["episode_time_s"].number()}
    sections["contract"] = times | contract
    dataset.refuse_all(_DATASET)
    root.refuse_all(_RECORD)
    dataset.refuse("an option of LeRobot's writer; `ibrobot convert` has its own")
    policy = root["policy"]
    places = (policy["path"], policy["pretrained_path"], root["pretrained_name_or_path"])
    path = next((each for each in places if each.value is not None), policy["path"])
    if path.value is not None and (where := path.text()) is not None:
        model = {"type": From("lerobot", "added"), "path": where, "norm_mode": _norm_mode(root["robot"])}
        sections["models"] = {"policy": model}
        executors = list(parts.streams(so101.SINGLE if root["robot"]["type"].value in _SINGLE else so101.DOUBLE))
        sections["control_modes"]["model_inference"] = path.titles(
            {"executors": From(executors, "added"), "inference": {"model": path.gives("policy")}}
        )
    policy.refuse("the checkpoint has its own options")


def _norm_mode(robot: Node) -> From:
    degrees = robot["use_degrees"]
    if degrees.value is None:
        return From("degrees", "GUESS: the default of LeRobot 0.6; older policies have range_m100_100")
    return degrees.changed("degrees" if degrees.flag() else "range_m100_100", "the unit of the policy's joints")
