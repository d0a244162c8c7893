"""Imports the contract of IB-Robot: topics -> observations, and the action vector -> topics of controllers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ibrobot_core.api import MESSAGE_TYPES
from ibrobot_import import parts, so101
from ibrobot_import.source import From, Node

JOINT_STATE = "sensor_msgs/msg/JointState"
_PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_COMMANDS = re.compile(r"/(\w+?)(?:_position)?_controller/commands")
_SIDES = {"leader_arm:": "left_", "follower_arm:": "right_"}
"""How IB-Robot's file for two arms names them."""
QOS = "the transport of a run chooses the quality of service"


def contract_section(
    node: Node, body: so101.Body | None, peripherals: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The section `contract`.

    Args:
        node: the contract of IB-Robot.
        body: the arms; None for a contract alone, to convert bags.
        peripherals: the cameras that are imported.
    """
    node["base_contract"].refuse("IB-Robot does not read it either")
    values: dict[str, Any] = {"rate_hz": node["rate_hz"].number(), "max_duration_s": node["max_duration_s"].number()}
    observations = [_observation(each, body, peripherals or {}) for each in node["observations"].each()]
    actions = [part for each in node["actions"].each() for part in _actions(each, body)]
    if body is not None and not actions:
        actions = [parts.action_part(name, body.origin) for name in parts.streams(body)]
    values["observations"] = [each for each in observations if each is not None]
    values["actions"] = actions
    return {key: value for key, value in values.items() if value is not None and value != []}


def _observation(node: Node, body: so101.Body | None, peripherals: Mapping[str, Any]) -> dict[str, Any] | None:
    key, peripheral, topic = node["key"].text(), node["peripheral"], node["topic"]
    if key is None:
        node["key"].fault("the key of the observation")
        return None
    type_ = node["type"].value or (_PICTURES[0] if peripheral.value is not None else JOINT_STATE)
    node["qos"].refuse(QOS)
    if type_ == "sensor_msgs/msg/PointCloud2":
        node.drop("a point cloud has no fixed number of values for a policy")
        return None
    values: dict[str, Any] = {"key": key}
    if type_ in _PICTURES and body is not None:
        if key.value.endswith(".depth"):
            node.drop("depth needs a peripheral of its own here: {type: realsense, stream: depth}")
            return None
        if peripheral.value not in peripherals:
            node.drop("its camera is not imported")
            return None
        values["peripheral"] = peripheral.text()
        published = f"/camera/{peripheral.value}/image_raw"
        if topic.value == published:
            topic.taken(published, "the topic of the peripheral")
        elif topic.value is not None:
            topic.changed(published, f"the camera publishes on {published}")
        node["type"].taken(type_, "the type of the peripheral")
    else:
        values["topic"] = topic.text()
        values["type"] = node["type"].text() or From(type_, "added: the type there")
        peripheral.refuse("a contract alone has no cameras; topic and type say where images come from")
        if type_ not in MESSAGE_TYPES:
            values["foreign"] = From(True, "added: only bags have this type")
    if node["image"].items():
        size = node["image"]["resize"].numbers(2)
        if size:
            values["image"] = {"resize": node["image"]["resize"].taken([int(each) for each in size])}
        node["image"]["encoding"].refuse("images are RGB")
    names = node["selector"]["names"]
    if names.value is not None and type_ not in _PICTURES:
        values["select"] = _select(names, type_, body)
    return {**values, "align": _align(node["align"])}


def _select(names: Node, type_: str, body: so101.Body | None) -> From | None:
    given = names.texts()
    if type_ != JOINT_STATE or body is None:
        if type_ == JOINT_STATE and not all("." in each for each in given):
            return names.changed([f"position.{each}" for each in given], "positions of the joints")
        return names.taken(given)
    select, left_out = [], []
    for each in given:
        field, dot, joint = each.partition(".")
        field, joint = (field, joint) if dot else ("position", field)
        for side, prefix in _SIDES.items() if len(body.prefixes) > 1 else ():
            joint = joint.replace(side, prefix) if joint.startswith(side) else joint
        prefix = next((p for p in body.prefixes if joint.startswith(p)), "")
        name = so101.SYNONYMS.get(joint.removeprefix(prefix), joint.removeprefix(prefix))
        if f"{prefix}{name}" in body.joints:
            select.append(f"{field}.{prefix}{name}")
        else:
            left_out.append(each)
    note = "servos have the names of their joints"
    if left_out:
        note += f"; without {', '.join(left_out)}, for which there is no joint here"
    if not select:
        names.wrong(f"has no joint of an SO-101: {', '.join(given)}")
        return None
    return names.taken(select) if select == given else names.changed(select, note)


def _align(node: Node) -> dict[str, Any] | None:
    if not node.items():
        return None
    strategy = node["strategy"].value or "hold"
    tolerance = node["tol_ms"]
    if strategy == "asof" and tolerance.value == 0:
        node["strategy"].changed("hold", "asof without a tolerance holds, there too")
        tolerance.refuse("0 is no tolerance there")
        strategy = "hold"
    values = {
        "strategy": node["strategy"].gives("hold")
        if strategy == "hold" and node["strategy"].value == "asof"
        else node["strategy"].text(),
        "stamp": node["stamp"].text(),
        "tol_ms": tolerance.number() if strategy == "asof" else None,
    }
    tolerance.refuse(f"{strategy} has no tolerance there either; contract.max_age bounds the age of a held value")
    return values if any(values.values()) else None


def _actions(node: Node, body: so101.Body | None) -> list[dict[str, Any]]:
    publish, names = node["publish"], node["selector"]["names"]
    key = node["key"]
    title = key.taken("action") if key.value == "action" else key.changed("action", "one action vector")
    publish["qos"].refuse(QOS)
    publish["layout"].refuse("commands are flat arrays")
    publish["strategy"].refuse("each action has its time in the plan")
    node["from_tensor"].refuse("the safety layer limits commands, by robot.joints")
    behaviour = node["safety_behavior"]
    if body is None:
        return [_foreign_action(title, publish, names, behaviour)]
    zeros = behaviour.value == "zeros"
    safety = behaviour.changed("hold", "zeros would move the joints to 0") if zeros else behaviour.text()
    match = _COMMANDS.fullmatch(str(publish["topic"].value))
    group = match[1] if match is not None else None
    if group in body.groups:
        executor = f"{group}_position"
        values: dict[str, Any] = {
            "key": title,
            "executor": publish["topic"].taken(executor),
            "topic": publish["topic"].text(),
            "type": publish["type"].text(),
            "safety_behavior": safety,
        }
        if names.value is not None:
            names.changed(None, f"the joints of group {group}, in order")
        return [values]
    if match is not None:
        node.drop(f"there is no joint group {group!r} here")
        return []
    note = "commands go to the executors, each with a topic of its own"
    key.changed("action", "an action for each executor")
    for part in (publish["topic"], publish["type"], names):
        part.changed(None, note)
    comment = f"{publish['topic'].origin}; {note}"
    added = {"safety_behavior": safety} if safety is not None else {}
    return [parts.action_part(name, comment, node.line) | added for name in parts.streams(body)]


def _foreign_action(key: From, publish: Node, names: Node, behaviour: Node) -> dict[str, Any]:
    """An action of bags, which other programs commanded."""
    given = names.texts()
    select: Sequence[str] = [each.removeprefix("action.") for each in given]
    joints = [each.rpartition(":")[2].removeprefix("position.") for each in given]
    behaviour.refuse("nothing is commanded by a contract alone")
    values: dict[str, Any] = {"key": key, "topic": publish["topic"].text(), "type": publish["type"].text()}
    if publish["type"].value == "std_msgs/msg/Float64MultiArray":
        names.changed(given, "the names of the numbers")
    else:
        values["select"] = names.taken(select)
    values["joints"] = names.gives(joints, "the names of the numbers")
    return values | {"executor": values["topic"], "foreign": From(True, "added: the commands of bags")}
