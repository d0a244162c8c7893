"""Imports contracts of Rosetta, version 2."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from ibrobot_core.api import MESSAGE_TYPES
from ibrobot_import import parts, so101
from ibrobot_import.contracts import JOINT_STATE, QOS
from ibrobot_import.source import Fate, From, Node, Source, plain_name

_ARMS = re.compile(r"so_?10[01](_follower)?|so_follower")
IMAGES = "observation.images."
_SIGNALS = {"task": "std_msgs/msg/String", "next.reward": "", "next.done": ""}
_ARRAY = re.compile(r"std_msgs/msg/\w+MultiArray")
_SCALAR = re.compile(r"std_msgs/msg/\w+")
_DEGREES = "values are in radians; `ibrobot convert --norm-mode degrees` writes degrees, models have norm_mode: degrees"


def convert(source: Source, *, alone: bool = False) -> dict[str, Any]:
    """The sections of the new file.

    Args:
        source: the contract.
        alone: import the contract alone, with its topics, to convert bags; otherwise an SO-101 becomes a whole robot.
    """
    root = source.root
    for name, node in root.items():
        if name.startswith("x-"):
            source.mark(node.key, Fate.TAKEN, "read where an alias stands for it")
    if root["robot_interface"].value not in (None, "ros2"):
        root["robot_interface"].wrong(f"expected ros2, got {root['robot_interface'].value!r}")
    root["robot_interface"].taken("ros2", "topics and types are those of ROS 2")
    joints = None if alone else _arm(root)
    converted = _contract_alone(root) if joints is None else _robot(root, joints)
    root["teleop"].refuse("an operator's device belongs to teleoperation and episodes")
    for name in ("info", "complementary_data", "signals", "rewards", "tasks"):
        root[name].refuse("datasets have the columns task, next.reward and next.done beside observations and actions")
    root["adjunct"].refuse("a bag has these topics, or not; recording.topics lists those of a run")
    return converted


def _arm(root: Node) -> dict[str, str] | None:
    """Name of a joint -> that of an SO-101, if the contract is for one."""
    if not _ARMS.fullmatch(str(root["robot_type"].value)):
        return None
    names = [each.partition(".")[2] for each in root["observations"]["observation.state"]["select"].texts()]
    known = {name: so101.SYNONYMS.get(name, name) for name in names}
    free = [name for name in so101.SERVOS.values() if name not in known.values()]
    unknown = [name for name, joint in known.items() if joint not in so101.SERVOS.values()]
    if len(names) != len(so101.SERVOS) or len(free) != len(unknown) or len(free) > 1:
        return None
    return known | dict(zip(unknown, free, strict=True))


def _robot(root: Node, joints: Mapping[str, str]) -> dict[str, Any]:
    """A whole SO-101 with the keys of the contract."""
    body = so101.SINGLE
    peripherals: list[dict[str, Any]] = []
    observations: list[dict[str, Any]] = []
    for key, node in root["observations"].items():
        if key.startswith(IMAGES):
            name = plain_name(key.removeprefix(IMAGES))
            peripherals.append(_camera(node, name, len(peripherals)))
            observations.append(_picture(node, key, name))
        elif key == "observation.state":
            observations.append(_state(node, key, joints))
        else:
            node.refuse("an SO-101 has no such sensor; --contract imports the contract alone, with all its topics")
    for key, node in root["actions"].items():
        channel, select = node["channel"], node["select"]
        channel["topic"].changed(None, "commands go to the executors")
        channel["type"].changed(None, "commands go to the executors")
        select.changed(None, "the joints of the executors")
        _rest(node, f"{key} is the action of an SO-101")
    modes = {"teleop": parts.added_mode(list(parts.streams(body)), "the leader arm", "leader")}
    devices = {"leader": body.own(so101.shipped(body.config)["teleoperation"]["leader"])}
    kind = root["robot_type"].text()
    robot = parts.robot_section(body, kind or From(body.config, "added"), kind)
    hardware = parts.hardware_section(body, [None], [None])
    return parts.sections(body, robot, hardware, peripherals, modes, devices, root["fps"].number(), observations)


def _camera(node: Node, name: str, number: int) -> dict[str, Any]:
    node["channel"]["topic"].changed(None, f"the camera {name} publishes on /camera/{name}/image_raw")
    node["channel"]["type"].changed(None, "the camera chooses between raw and JPEG")
    return {
        "name": node.gives(name),
        "kind": node.gives("camera"),
        "type": From("opencv", "added"),
        "device": From(2 * number, "GUESS: `ibrobot camera list` prints the cameras"),
        "width": From(640, "GUESS"),
        "height": From(480, "GUESS"),
        "fps": From(30, "GUESS"),
        "sim": parts.simulated(name, so101.SINGLE),
    }


def _picture(node: Node, key: str, name: str) -> dict[str, Any]:
    values = {
        "key": node.gives(key),
        "peripheral": node.gives(name),
        "image": _image(node),
        "align": _align(node),
    }
    return values | _rest(node)


def _state(node: Node, key: str, joints: Mapping[str, str]) -> dict[str, Any]:
    given = node["select"].texts()
    select = [f"{each.partition('.')[0]}.{joints[each.partition('.')[2]]}" for each in given]
    guess = [f"{name} is {joint}" for name, joint in joints.items() if so101.SYNONYMS.get(name, name) != joint]
    note = "names of the SO-101's joints" + (f"; GUESS, as the only one left: {', '.join(guess)}" if guess else "")
    node["channel"]["topic"].changed("/joint_states", "the topic of the robot's state")
    node["channel"]["type"].taken(JOINT_STATE)
    values = {
        "key": node.gives(key),
        "topic": From("/joint_states", f"{node['channel']['topic'].origin}; the robot's state", node.line),
        "select": node["select"].changed(select, note) if select != given else node["select"].taken(select),
        "align": _align(node),
    }
    return values | _rest(node)


def _contract_alone(root: Node) -> dict[str, Any]:
    observations = [part for key, node in root["observations"].items() for part in _sources(key, node, _observation)]
    actions: list[dict[str, Any]] = []
    for key, node in root["actions"].items():
        if key != "action":
            node.refuse("there is one action vector, `action`")
            continue
        actions += _sources(key, node, _action)
    root["robot_type"].refuse("a contract alone has no robot; a dataset has the type of the robot that was recorded")
    values = {
        "rate_hz": root["fps"].number(),
        "observations": observations,
        "actions": actions,
        "signals": _signals(root),
    }
    return {"contract": {name: value for name, value in values.items() if value}}


def _sources(key: str, node: Node, convert: Any) -> list[dict[str, Any]]:
    parts = node.each() if isinstance(node.value, list) else [node]
    return [values for part in parts if (values := convert(key, part)) is not None]


def _observation(key: str, node: Node) -> dict[str, Any] | None:
    channel = node["channel"]
    if channel["decoder"].value is not None:
        node.refuse("its values are computed by code of Rosetta's; select reads numbers as they are")
        return None
    type_ = channel["type"].value
    values = {
        "key": node.gives(key),
        "topic": channel["topic"].text(),
        "type": channel["type"].text(),
        "foreign": None if type_ in MESSAGE_TYPES else From(True, "added: only bags have this type"),
        "select": _select(node, str(type_)),
        "image": _image(node) if key.startswith(IMAGES) else None,
        "align": _align(node),
    }
    return values | _rest(node)


def _action(key: str, node: Node) -> dict[str, Any] | None:
    channel = node["channel"]
    if channel["decoder"].value is not None or channel["encoder"].value is not None:
        node.refuse("its values are computed by code of Rosetta's; select reads numbers as they are")
        return None
    select = _select(node, str(channel["type"].value))
    names = [each.partition(".")[2] or each for each in node["select"].texts()] or [key]
    values = {
        "key": node.gives(key),
        "topic": channel["topic"].text(),
        "type": channel["type"].text(),
        "select": select,
        "joints": From(names, f"{node['select'].origin}; the names of the numbers", node.line),
        "executor": channel["topic"].text(),
        "foreign": From(True, "added: the commands of bags"),
    }
    strategy = node["align"]["strategy"]
    if strategy.value == "hold":
        strategy.taken("hold", "the default")
    return values | _rest(node, "the command in effect at the tick")


def _select(node: Node, type_: str) -> From | None:
    select = node["select"]
    given = select.texts()
    if _ARRAY.fullmatch(type_) and given:
        numbers = [f"data.{i}" for i in range(len(given))]
        return select.changed(numbers, f"labels {', '.join(given)} are numbers in order")
    if given:
        return select.taken(given)
    return From(["data"], "added: the number of the message") if _SCALAR.fullmatch(type_) else None


def _image(node: Node) -> dict[str, Any] | None:
    for step in node["apply"].each():
        size = step["resize"]
        if isinstance(step.value, Mapping) and size.value is not None:
            values = size.numbers(2)
            return {"resize": size.taken([int(each) for each in values])} if values else None
    return None


def _align(node: Node) -> dict[str, Any] | None:
    align = node["align"]
    tolerance = align["tolerance_ms"]
    strategy = align["strategy"].text()
    stamp = align["timeline"]
    values = {
        "strategy": strategy,
        "stamp": stamp.text(),
        "tol_ms": tolerance.number() if strategy is not None and strategy.value == "asof" else None,
    }
    if stamp.value not in (None, "header", "receive"):
        stamp.wrong(f"expected header or receive, got {stamp.value!r}")
    tolerance.refuse("only asof has a tolerance")
    return values if any(values.values()) else None


def _signals(root: Node) -> list[dict[str, Any]]:
    signals = []
    for section in ("tasks", "rewards", "signals"):
        for key, node in root[section].items():
            if key not in _SIGNALS:
                node.refuse(f"a dataset has the columns {', '.join(_SIGNALS)} beside observations and actions")
                continue
            channel = node["channel"]
            align = node["align"]["strategy"]
            values = {
                "key": node.gives(key),
                "topic": channel["topic"].text(),
                "type": channel["type"].text(),
                "select": _select(node, str(channel["type"].value)),
                "align": align.text() if align.value == "hold" else None,
            }
            node["align"]["timeline"].refuse("signals are aligned by their time of receipt")
            signals.append(values | _rest(node))
    return signals


def _rest(node: Node, note: str = "") -> dict[str, Any]:
    """Give verdicts on what remains of an entry."""
    for step in node["apply"].each():
        if step.value == "rad2deg":
            step.refuse(_DEGREES)
        else:
            step.refuse("values are as in the messages; the safety layer limits commands, by robot.joints")
    node["channel"]["qos"].refuse(QOS)
    node["channel"]["dtype"].refuse("datasets have 32-bit floats, and images")
    node["channel"]["safety"].refuse("a robot here holds, or relaxes: safety_behavior of an action")
    node["kind"].refuse("policies normalise by the statistics of the dataset")
    node["align"].refuse(note or "has no counterpart for this entry")
    return {}
