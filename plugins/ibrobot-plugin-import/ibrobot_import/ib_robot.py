"""Imports robot YAMLs of IB-Robot, whose sections are below `robot`, and its files with a contract."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.app import installed_plugins
from ibrobot_import import parts, so101
from ibrobot_import.contracts import contract_section
from ibrobot_import.source import From, Node, Source, Titled, plain_name

_ARMS = ("so101_hardware/SO101SystemHardware", "lekiwi_hardware/LeKiwiSystemHardware")
"""Hardware plugins of ros2_control whose arm is an SO-101."""
_CONTROLLER = re.compile(r"(\w+?)_(position|trajectory)_controller")
_FORMATS = {"mjpeg2rgb": "MJPG", "mjpeg": "MJPG", "yuyv": "YUYV", "yuyv2rgb": "YUYV"}
_AUTOMATIC = -1
"""Placeholder of a value that the camera chooses."""
_TELEOP = {"leader_arm": "so101_leader", "xbox_controller": "gamepad", "phone": "webxr"}
_SECTIONS = {
    "type": "selects nothing here; robot_type is what datasets have",
    "gazebo_world_name gazebo_gui": "the simulation is MuJoCo, with scenes of plugins",
    "controller_startup_timeout": "executors are there when the control loop starts",
    "voice_asr": "there is no speech recognition here",
    "navigation": "there is no mobile base here",
}
_HARDWARE = {
    "urdf_path xacro_mappings": "the model is that of the package so101-nexus",
    "controllers_config": "executors are in this file",
    "controllers": "each mode has its executors",
    "joint_names": "servos have the names of their joints",
    "velocity_joints base_vel_max_rad": "there is no mobile base here",
}
_MODE = {
    "description_cn": "modes have no description; `description` is a comment here",
    "sim_controllers": "a mode has the same executors in simulation",
}
_EXECUTOR = {
    "type": "the executors of the mode say it",
    "mode": "is the name of the mode",
    "queue_size": "the plan is as long as the model's chunk",
    "dispatcher": "there is one dispatcher",
    "navigation_mode": "there is no mobile base here",
}
_INFERENCE = {
    "enabled": "a mode with `inference` runs its model",
    "model execution_mode force_disable": "a mode without `inference` runs no model",
    "action_server": "the dispatcher calls the model itself",
    "publish_attention attention_viz_topic attention_viz": "attention is not published",
}
_CAMERA = {
    "pixel_format format": "images are JPEG or raw; datasets have RGB",
    "enable_pointcloud": "RealSense cameras give colour, or aligned depth",
    "enable_sync": "each stream is aligned by its stamps",
    "align_depth": "depth is always aligned to the colour images",
    "streams": "a further peripheral {type: realsense, stream: depth} gives depth",
    "saturation contrast sharpness": "this setting is not changed here",
    "autoexposure": "exposure is automatic unless it is set",
    "auto_white_balance": "white balance is automatic unless it is set",
    "fovy": "with --sim, the scene's model has the field of view",
    "use_default_transform simulation": "with --sim, the scene's model has the camera",
    "depth_width depth_height depth_fps": "depth is aligned to the colour images",
}
_DEVICE = {
    "leader_arm": {"control_frequency": "the robot follows at the rate of control"},
    "phone": {
        "control_frequency": "the page of the phone sends at its own rate",
        "phone_config": "the phone moves the tool by the page of `webxr`, whose options limit it",
        "ee_frame_name": "the tool is robot.description.tip",
    },
    "xbox_controller": {
        "input_device": "the first pad that is connected; set device to VENDOR:PRODUCT for another one",
        "default_mode": "joint mode comes first",
        "mapping_config": "buttons are mapped by buttons, joints and tool",
        "servo_config": "the tool moves without a servo node",
        "control_params": "has no counterpart among the speeds here",
        "control_frequency": "the robot follows at the rate of control",
    },
}


@attrs.define
class _Robot:
    """The parts of a robot while it is imported."""

    node: Node
    body: so101.Body
    executors: dict[str, tuple[str, str, str, int]] = attrs.field(factory=dict)
    devices: dict[str, Any] = attrs.field(factory=dict)


def convert(source: Source) -> dict[str, Any]:
    """The sections of the new file, or its contract alone if the robot has no arm that ibrobot drives."""
    root = source.root
    if root["robot"].value is None:
        root["name"].refuse("a contract alone has no name")
        root["version"].refuse("contracts have a fingerprint instead")
        root["robot_type"].refuse(
            "a contract alone has no robot; a dataset has the type of the robot that was recorded"
        )
        root["recording"].refuse("bags of IB-Robot are read as they are")
        root["process"].refuse("tensors do not pass through topics")
        return {"contract": contract_section(root, None)}
    robot = root["robot"]
    body = _body(robot)
    if body is None:
        contract = contract_section(robot["contract"], None)
        robot.refuse("only the contract is imported: ibrobot has no driver for this robot, but converts its bags")
        return {"contract": contract}
    return _sections(_Robot(robot, body))


def _body(robot: Node) -> so101.Body | None:
    plugin = robot["ros2_control"]["hardware_plugin"]
    if plugin.value not in _ARMS:
        return None
    plugin.changed("feetech_so101", "type: feetech_so101")
    groups = [name for name, _ in robot["joints"].items()]
    return so101.DOUBLE if {"left_arm", "right_arm"} <= set(groups) else so101.SINGLE


def _sections(part: _Robot) -> dict[str, Any]:
    robot, body = part.node, part.body
    section = _robot_section(part)
    hardware = _hardware_section(part)
    peripherals = _peripherals(part)
    devices = _teleoperation(part)
    models = _models(robot["models"])
    modes = _control_modes(part)
    contract = contract_section(robot["contract"], body, peripherals)
    _executors_of_actions(part, contract)
    if not any(type_ == "position" for type_, *_ in part.executors.values()):
        part.executors |= parts.streams(body)
    _only_driven(modes, contract)
    streams = [name for name, (type_, *_) in part.executors.items() if type_ == "position"]
    modes |= parts.added_modes(streams, list(modes))
    robot.refuse_all(_SECTIONS)
    for recording in (robot["recording"], robot["contract"]["recording"]):
        recording.refuse("`ibrobot record` records, and takes --root and --dataset; all topics of the contract")
    return {
        "robot": section,
        "hardware": hardware,
        "simulation": _simulation(robot["simulation"]),
        "peripherals": list(peripherals.values()),
        "executors": parts.executor_sections(part.executors),
        "models": models,
        "control_modes": modes,
        "default_control_mode": _default_mode(robot["default_control_mode"], modes),
        "teleoperation": devices | parts.WEB,
        "contract": contract,
        "control": From(parts.CONTROL, "so101 of ibrobot"),
    }


def _robot_section(part: _Robot) -> dict[str, Any]:
    robot, body = part.node, part.body
    name = robot["name"].text() or robot.changed("so101", "the file has no name")
    groups = {}
    for group, node in robot["joints"].items():
        names = node.texts()
        joints = [_joint(each, body) for each in names]
        for each, joint in zip(names, joints, strict=True):
            if joint is None and each not in part.node["ros2_control"]["velocity_joints"].texts():
                node.wrong(f"unknown joint {each!r}; the servos of an SO-101 are 1 to 6")
        target = group if len(body.prefixes) == 1 else group.removesuffix("_arm")
        if target in body.groups and None not in joints:
            given = [joint for joint in joints if joint is not None]
            own = body.groups[target]
            note = "servos have the names of their joints" + ("; with the gripper" if given != own else "")
            groups[target] = node.changed(own, note)
        else:
            node.refuse("the groups are those of the executors")
    reason = "planners plan for the executors' groups, with robot.description.tip as the tool"
    robot["moveit"].refuse_all({"arm_group_name base_link ee_link shoulder_link": reason})
    return parts.robot_section(
        body,
        name,
        robot["robot_type"].text() or robot["type"].text(),
        _limits(robot["teleoperation"]["safety"]["joint_limits"], body),
        _reset_pose(robot["ros2_control"]["reset_positions"], body),
        groups,
    )


def _joint(name: str, body: so101.Body) -> str | None:
    """The joint of this name, or of a servo's id."""
    for prefix in body.prefixes:
        plain = name.removeprefix(prefix) if name.startswith(prefix) else None
        if plain is not None and (joint := so101.SYNONYMS.get(plain, plain)) in so101.SERVOS.values():
            return f"{prefix}{joint}"
    return None


def _limits(node: Node, body: so101.Body) -> dict[str, tuple[float, float, Node]]:
    limits = {}
    for name, each in node.items():
        joint = _joint(name, body)
        lower, upper = each["min"].number("applies to every mode"), each["max"].number("applies to every mode")
        if joint is None:
            each.drop("not a joint of this robot")
        elif lower is not None and upper is not None:
            limits[joint] = (lower.value, upper.value, each)
    return limits


def _reset_pose(node: Node, body: so101.Body) -> dict[str, From]:
    if not node.items():
        return {}
    pose = dict.fromkeys(body.joints, 0.0)
    missing = set(body.joints)
    for name, each in node.items():
        joint = _joint(name, body)
        value = each.number("in the pose `reset`")
        if joint is None:
            each.wrong(f"unknown joint {name!r}; the servos of an SO-101 are 1 to 6")
        elif value is not None:
            pose[joint] = value.value
            missing.discard(joint)
    lacking = f"; {', '.join(sorted(missing))} at 0" if missing else ""
    return {"reset": From(list(pose.values()), f"{node.origin}{lacking}", node.line)}


def _hardware_section(part: _Robot) -> dict[str, Any]:
    node, body = part.node["ros2_control"], part.body
    arms = len(body.prefixes)
    port, calibration = node["port"].text(), node["calib_file"].text()
    node.refuse_all(_HARDWARE)
    rest: list[From | None] = [None] * (arms - 1)
    if arms > 1 and calibration is not None:
        node["calib_file"].drop("has the servos of two buses; each arm has its own calibration here")
        calibration = None
    return parts.hardware_section(body, [port, *rest], [calibration, *rest])


def _peripherals(part: _Robot) -> dict[str, dict[str, Any]]:
    peripherals: dict[str, dict[str, Any]] = {}
    for node in part.node["peripherals"].each():
        kind, driver, name = node["type"].value, node["driver"].value or "opencv", node["name"].text()
        if kind != "camera" or driver not in ("opencv", "realsense") or name is None:
            node.drop(f"there is no plugin here for a {kind} with driver {driver}")
            continue
        node["type"].taken(kind)
        values: dict[str, Any] = {
            "name": _renamed(node["name"], name),
            "kind": node["type"].gives("camera"),
            "type": node["driver"].taken(driver) if node["driver"].value is not None else From(driver, "added"),
        }
        values |= _usb(node) if driver == "opencv" else {"serial": node["serial_number"].text()}
        values |= {key: node[key].whole() for key in ("width", "height")} | {"fps": node["fps"].number()}
        optical = node["optical_frame_id"].text()
        values |= {"frame_id": optical, "transform": _transform(node, part.body)}
        node.refuse_all(_CAMERA)
        values["sim"] = parts.simulated(str(values["name"].value), part.body)
        peripherals[str(name.value)] = values
    return peripherals


def _usb(node: Node) -> dict[str, Any]:
    key = next((each for each in ("index", "port", "index_or_port") if node[each].value is not None), "index")
    device = node[key]
    values: dict[str, Any] = {"device": device.whole() if isinstance(device.value, int) else device.text()}
    if values["device"] is None:
        values["device"] = From(0, "added")
    if (code := _FORMATS.get(str(node["pixel_format"].value))) is not None:
        values["fourcc"] = node["pixel_format"].changed(code, "the camera's format, decoded where a frame needs it")
    for name in ("brightness", "exposure", "white_balance"):
        if node[name].value == _AUTOMATIC:
            node[name].refuse("-1 leaves it to the camera, as without the key here")
        else:
            values[name] = node[name].number()
    url = node["camera_info_url"]
    if url.value is not None:
        path = str(url.value).removeprefix("file://")
        if not Path(path).is_file():
            url.refuse("there is no such file on this machine; set `info` to the camera's calibration")
        else:
            values["info"] = url.changed(path, "a path")
    return values


def _transform(node: Node, body: so101.Body) -> Titled | None:
    given = node["transform"]
    if node["use_default_transform"].flag():
        given.refuse("not used there either, as use_default_transform is true")
    elif len(body.prefixes) > 1:
        given.refuse("two arms have no URDF here, whose links a mount needs")
    elif given.items() and (parent := given["parent_frame"].text()) is not None:
        link = so101.LINKS.get(parent.value, parent.value)
        axes = [[given[key].number() for key in keys] for keys in (("x", "y", "z"), ("roll", "pitch", "yaw"))]
        xyz, rpy = ([0.0 if each is None else float(each.value) for each in three] for three in axes)
        if link != parent.value:
            parent = given["parent_frame"].changed(link, "the link's name in the URDF")
        values = {
            "parent": parent,
            "xyz": given.gives(xyz),
            "rpy": given.gives(rpy),
            "frame": node["frame_id"].text(),
        }
        return given.titles(values)
    node["frame_id"].refuse("names the frame of a transform, which this camera does not have")
    return None


def _renamed(node: Node, name: From) -> From:
    """A name with the characters that ibrobot allows."""
    plain = plain_name(str(name.value))
    return name if plain == name.value else node.changed(plain, "letters, digits, _ and - only")


def _models(node: Node) -> dict[str, Any]:
    models = {}
    for name, each in node.items():
        note = "the checkpoint says which policy it is"
        values: dict[str, Any] = {
            "type": each["policy_type"].changed("lerobot", note),
            "path": each["path"].text(),
        }
        mode = each["lerobot_norm_mode"]
        if mode.value == "none":
            values["norm_mode"] = mode.changed("radians", "joints in radians, without conversion")
        else:
            values["norm_mode"] = mode.text()
        if each["device"].value == "rknn":
            each["device"].refuse("LeRobot's policies run on a device of torch; serve an RKNN model as a plugin")
        else:
            values["device"] = each["device"].text()
        each["normalization"].refuse("the checkpoint's own processors normalise")
        models[plain_name(name)] = each.titles(values)
    return models


def _control_modes(part: _Robot) -> dict[str, Any]:
    modes: dict[str, Any] = {}
    for name, node in part.node["control_modes"].items():
        executors = _mode_executors(part, node["controllers"])
        if not executors:
            node.drop("no executor of an arm is left for this mode")
            continue
        values: dict[str, Any] = {"executors": node["controllers"].changed(executors, "controllers are executors")}
        values |= _source(part, name, node, executors)
        node["executor"]["watermark_threshold"].refuse("belongs to modes with a model")
        rate, contract = node["executor"]["control_frequency"], part.node["contract"]["rate_hz"].value
        rate.refuse(f"setpoints come at control.rate_hz; the actions of a chunk at contract.rate_hz ({contract} Hz)")
        comment = node["description"]
        titled = node.origin
        if isinstance(comment.value, str):
            titled += f"; {comment.taken(comment.value, 'is a comment').value}"
        node.refuse_all(_MODE)
        node["executor"].refuse_all(_EXECUTOR)
        node["inference"].refuse_all(_INFERENCE)
        modes[plain_name(name)] = Titled(values, titled, node.line)
    return modes


def _source(part: _Robot, name: str, node: Node, executors: list[str]) -> dict[str, Any]:
    """What commands a mode: a planner, a model or a device."""
    inference, watermark = node["inference"], node["executor"]["watermark_threshold"]
    if {part.executors[each][0] for each in executors} != {"position"}:
        return {"planner": From({"type": "rrt_connect"}, "added: its executors take goals of a planner")}
    if inference["enabled"].flag() and inference["model"].value is not None:
        mode = inference["execution_mode"]
        if mode.value == "distributed":
            mode.refuse("the model runs in this process; on a server it needs `transport`, see the how-to on serving")
        else:
            mode.taken("monolithic", "the default")
        dispatch = {"dispatch": {"watermark": watermark.whole()}} if watermark.value is not None else {}
        return {"inference": {"model": inference["model"].text()}, **dispatch}
    device = part.node["teleoperation"]["active_device"]
    if device.value is None or name != "teleop":
        return {}
    known = plain_name(str(device.value))
    if known in part.devices:
        return {"teleop": device.taken(known)}
    device.refuse("this device is not imported, so that the mode holds the robot")
    return {}


def _mode_executors(part: _Robot, node: Node) -> list[str]:
    executors = []
    for name in node.texts():
        match = _CONTROLLER.fullmatch(name)
        if match is None or match[1] not in part.body.groups:
            continue
        group, kind = match[1], match[2]
        executor = f"{group}_{kind}"
        if kind == "trajectory" and len(part.body.groups[group]) == 1:
            executor, kind = f"{group}_action", "gripper"
        part.executors.setdefault(executor, (kind, group, f"line {node.line}: controller {name}", node.line))
        executors.append(executor)
    return executors


def _executors_of_actions(part: _Robot, contract: Mapping[str, Any]) -> None:
    for action in contract["actions"]:
        executor = action["executor"]
        group = str(executor.value).removesuffix("_position")
        part.executors.setdefault(str(executor.value), ("position", group, executor.comment, executor.line))


def _only_driven(modes: dict[str, Any], contract: Mapping[str, Any]) -> None:
    """Give modes with a model the executors that the action vector drives."""
    driven = [action["executor"].value for action in contract["actions"]]
    for mode in modes.values():
        if "inference" in mode.value and sorted(mode.value["executors"].value) != sorted(driven):
            given = mode.value["executors"]
            mode.value["executors"] = attrs.evolve(given, value=driven, comment=f"{given.comment}; those with actions")


def _default_mode(node: Node, modes: Mapping[str, Any]) -> From:
    if node.value is None:
        return From(next(iter(modes)), "added: the first mode")
    if node.value in modes:
        return node.taken(node.value)
    node.wrong(f"unknown mode {node.value!r}; the modes are: {', '.join(modes)}")
    return From(next(iter(modes)), "")


def _simulation(node: Node) -> dict[str, Any]:
    platform = node["platform"] if node["platform"].value is not None else node["active_platform"]
    type_ = platform.changed("mujoco", "the simulator here") if platform.value is not None else None
    node["sim_models_pkg"].refuse("scenes are plugins here")
    scene, given = node["scene"], None
    if "scene" in (node.value or {}):
        known = installed_plugins().types("scene")
        if scene.value in known:
            given = scene.text()
        elif scene.value is None:
            given = scene.changed("empty", "no scene")
        else:
            given = scene.changed("empty", f"there is no scene {scene.value!r}; there are {', '.join(known)}")
    return parts.simulation_section(type_, given)


def _teleoperation(part: _Robot) -> dict[str, Any]:
    node = part.node["teleoperation"]
    node["enabled"].taken(True, "modes say which device they use")
    for device in node["devices"].each():
        name, kind = device["name"].text(), device["type"].value
        if name is None or kind not in _TELEOP:
            device.drop(f"there is no plugin here for a device of type {kind}")
            continue
        values: dict[str, Any] = {"type": device["type"].changed(_TELEOP[kind], "the type here")}
        if kind == "leader_arm":
            port, calibration = device["port"].text(), device["calib_file"].text()
            values |= {"port": port or From("/dev/ttyACM1", "added")}
            values |= {"calibration": calibration or From("so101_leader", "added")}
        elif kind == "xbox_controller":
            control = device["control_params"]
            values |= {
                "dead_zone": control["deadzone"].number(),
                "joint_speed": control["joint_velocity_gain"].number(),
                "long_press": control["long_press_duration"].number(),
            }
        else:
            values |= {"scale": device["phone_config"]["linear_scale"].number()}
        device.refuse_all(_DEVICE[kind])
        part.devices[plain_name(str(name.value))] = device.titles(values)
    return part.devices
