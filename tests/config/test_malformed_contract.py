"""What the contract may say: observations, selections, alignment, actions."""

from __future__ import annotations

from collections.abc import Callable

import pytest

# The fault, the replaced text of the base YAML, its replacement, and the whole error.
CASES = {
    "resize_negative": (
        "peripheral: top, align",
        "peripheral: top, image: {resize: [-240, 320]}, align",
        (
            "robot.yaml:36: contract.observations.1.image.resize: [-240, 320] is not a valid size: [height, width] of "
            "1 to 8192 px each"
        ),
    ),
    "resize_absurd": (
        "peripheral: top, align",
        "peripheral: top, image: {resize: [240, 320000]}, align",
        (
            "robot.yaml:36: contract.observations.1.image.resize: [240, 320000] is not a valid size: [height, width] "
            "of 1 to 8192 px each"
        ),
    ),
    "two_images_under_one_key": (
        "    - {key: observation.images.top",
        "    - {key: observation.images.top, peripheral: top}\n    - {key: observation.images.top",
        (
            "robot.yaml:37: contract.observations.2.key: a second image under observation.images.top; only vectors "
            "concatenate, so give it its own key"
        ),
    ),
    "executors_share_a_topic": (
        "topic: /grip/commands",
        "topic: /arm/commands",
        (
            "robot.yaml:39: contract.actions.1.topic: executor 'arm_position' has its commands on /arm/commands; give "
            "each its own topic"
        ),
    ),
    "contract_unknown_peripheral": (
        "peripheral: top,",
        "peripheral: tpo,",
        "robot.yaml:36: contract.observations.1.peripheral: unknown peripheral 'tpo', did you mean 'top'?",
    ),
    "contract_peripheral_and_topic": (
        "peripheral: top,",
        "peripheral: top, topic: /x,",
        "robot.yaml:36: contract.observations.1.topic: comes from peripheral 'top'; give one or the other",
    ),
    "contract_neither": (
        "peripheral: top,",
        "",
        "robot.yaml:36: contract.observations.1: needs a topic, or a peripheral",
    ),
    "contract_peripheral_kind": (
        "peripheral: top,",
        "peripheral: chest,",
        (
            "robot.yaml:36: contract.observations.1.peripheral: a peripheral of kind 'imu' does not "
            "determine topic and type; give them instead"
        ),
    ),
    "contract_type_needed": (
        "peripheral: top,",
        "topic: /other,",
        "robot.yaml:36: contract.observations.1: needs a type, which topic /other does not determine",
    ),
    "contract_unknown_message": (
        "peripheral: top,",
        "topic: /other, type: sensor_msgs/msg/Imag,",
        (
            "robot.yaml:36: contract.observations.1.type: unknown message type 'sensor_msgs/msg/Imag', did you "
            "mean 'sensor_msgs/msg/Image'? (set `foreign: true` for a type that only bags define)"
        ),
    ),
    "contract_foreign_that_is_known": (
        "topic: /joint_states,",
        "topic: /imu, type: sensor_msgs/msg/Imu, foreign: true,",
        "robot.yaml:35: contract.observations.0.foreign: sensor_msgs/msg/Imu is a known type; leave foreign out",
    ),
    "contract_foreign_name": (
        "topic: /joint_states,",
        "topic: /touch, type: lamp_msgs/Touch, foreign: true,",
        "robot.yaml:35: contract.observations.0.type: expected PACKAGE/msg/NAME, got 'lamp_msgs/Touch'",
    ),
    "contract_foreign_whole": (
        "topic: /joint_states, select: [position.pan, position.lift, position.grip]",
        "topic: /touch, type: lamp_msgs/msg/Touch, foreign: true",
        (
            "robot.yaml:35: contract.observations.0: needs a select: paths to numbers of lamp_msgs/msg/Touch, "
            "e.g. wrench.force.x or data.0"
        ),
    ),
    "contract_foreign_image": (
        "key: observation.state, topic: /joint_states,",
        "key: observation.images.x, topic: /touch, type: lamp_msgs/msg/Touch, foreign: true,",
        (
            "robot.yaml:35: contract.observations.0: lamp_msgs/msg/Touch gives only numbers, no images; "
            "use a topic with images"
        ),
    ),
    "contract_foreign_peripheral": (
        "peripheral: top,",
        "peripheral: top, foreign: true,",
        "robot.yaml:36: contract.observations.1.foreign: comes from peripheral 'top'; give one or the other",
    ),
    "contract_joint_states_type": (
        "topic: /joint_states,",
        "topic: /joint_states, type: sensor_msgs/msg/Imu,",
        (
            "robot.yaml:35: contract.observations.0.type: /joint_states carries sensor_msgs/msg/JointState, not "
            "sensor_msgs/msg/Imu"
        ),
    ),
    "contract_select_unknown_joint": (
        "position.grip]",
        "position.grp]",
        "robot.yaml:35: contract.observations.0.select.2: unknown joint 'grp', did you mean 'grip'?",
    ),
    "contract_select_form": (
        "position.grip]",
        "2]",
        "robot.yaml:35: contract.observations.0.select.2: expected text, got 2 (quote it: '2')",
    ),
    "contract_select_index": (
        "position.grip]",
        "position]",
        (
            "robot.yaml:35: contract.observations.0.select.2: expected position.JOINT or velocity.JOINT or "
            "effort.JOINT, got 'position'"
        ),
    ),
    "contract_select_image": (
        "peripheral: top,",
        "peripheral: top, select: [data],",
        "robot.yaml:36: contract.observations.1.select.0: images have no numbers to select",
    ),
    "contract_select_field": (
        "topic: /joint_states, select: [position.pan, position.lift, position.grip]",
        "topic: /imu, type: sensor_msgs/msg/Imu, select: [linear_aceleration.x]",
        (
            "robot.yaml:35: contract.observations.0.select.0: 'linear_aceleration.x': Imu has no field "
            "'linear_aceleration', did you mean 'linear_acceleration'?"
        ),
    ),
    "contract_select_deep": (
        "topic: /joint_states, select: [position.pan, position.lift, position.grip]",
        "topic: /imu, type: sensor_msgs/msg/Imu, select: [orientation.x, orientation.q]",
        (
            "robot.yaml:35: contract.observations.0.select.1: 'orientation.q': Quaternion has no field 'q'; "
            "available: x, y, z, w"
        ),
    ),
    "contract_select_nothing": (
        "topic: /joint_states, select: [position.pan, position.lift, position.grip]",
        "topic: /text, type: std_msgs/msg/String",
        "robot.yaml:35: contract.observations.0: std_msgs/msg/String needs a select: paths to its numbers, e.g. data",
    ),
    "contract_action_size": (
        "executor: grip_position, topic: /grip/commands",
        (
            "executor: grip_position, topic: /grip, type: std_msgs/msg/Float64MultiArray, foreign: true, "
            "select: [data.0, data.1]"
        ),
        ("robot.yaml:39: contract.actions.1.select: gives 2 numbers, but 'grip_position' commands 1: grip"),
    ),
    "contract_action_joint_twice": (
        "gripper: [grip]",
        "gripper: [grip, pan]",
        (
            "robot.yaml:25: control_modes.policy.executors.1: executors 'arm_position' and 'grip_position' both claim "
            "joint 'pan'\n"
            "robot.yaml:27: control_modes.teleop.executors.1: executors 'arm_position' and 'grip_position' both claim "
            "joint 'pan'\n"
            "robot.yaml:39: contract.actions.1: joint 'pan' is already in the action vector; list each joint once"
        ),
    ),
    "contract_signal_size": (
        "  actions:\n",
        "  signals: [{key: next.done, topic: /done, type: std_msgs/msg/Float64MultiArray}]\n  actions:\n",
        "robot.yaml:37: contract.signals.0.select.0: 'data' must lead to one number, e.g. data.0",
    ),
    "contract_image_of_joints": (
        "topic: /joint_states,",
        "topic: /joint_states, image: {},",
        (
            "robot.yaml:35: contract.observations.0.image: needs a camera; /joint_states carries "
            "sensor_msgs/msg/JointState"
        ),
    ),
    "contract_image_key": (
        "key: observation.state",
        "key: observation.images.state",
        (
            "robot.yaml:35: contract.observations.0.key: observation.images.state needs a camera; /joint_states "
            "carries sensor_msgs/msg/JointState"
        ),
    ),
    "contract_mixed_kinds": (
        "key: observation.images.top",
        "key: observation.state",
        (
            "robot.yaml:36: contract.observations.1.key: observation.state is an image in one observation and a "
            "vector in another; give them different keys"
        ),
    ),
    "contract_asof": (
        "tol_ms: 100",
        "stamp: header",
        "robot.yaml:36: contract.observations.1.align: strategy asof needs tol_ms, e.g. tol_ms: 100",
    ),
    "contract_tol": (
        "strategy: asof, ",
        "",
        ("robot.yaml:36: contract.observations.1.align: tol_ms applies only to strategy asof, not hold"),
    ),
    "contract_align_strategy": (
        "strategy: asof",
        "strategy: newest",
        "robot.yaml:36: contract.observations.1.align.strategy: 'newest' is not one of: hold, asof, drop",
    ),
    "contract_action_executor": (
        "executor: arm_position, topic",
        "executor: arm_positon, topic",
        ("robot.yaml:38: contract.actions.0.executor: unknown executor 'arm_positon', did you mean 'arm_position'?"),
    ),
    "contract_action_of_goals": (
        "executor: arm_position, topic",
        "executor: arm_trajectory, topic",
        (
            "robot.yaml:38: contract.actions.0.executor: executor 'arm_trajectory' takes goals; an action needs "
            "one for setpoints, e.g. type position"
        ),
    ),
    "contract_action_type": (
        "executor: arm_position, topic",
        "executor: arm_position, type: sensor_msgs/msg/JointState, topic",
        (
            "robot.yaml:38: contract.actions.0.type: this robot publishes std_msgs/msg/Float64MultiArray, not "
            "'sensor_msgs/msg/JointState'; set foreign: true for the commands of foreign bags"
        ),
    ),
    "contract_action_select": (
        "executor: arm_position, topic",
        "executor: arm_position, select: [data.1, data.0], topic",
        (
            "robot.yaml:38: contract.actions.0.select: 'data.1' is computed by no installed plugin; paths into "
            "messages are for foreign bags: set foreign: true"
        ),
    ),
    "contract_foreign_action_whole": (
        "executor: arm_position, topic",
        "executor: arm_position, type: trajectory_msgs/msg/JointTrajectory, foreign: true, topic",
        (
            "robot.yaml:38: contract.actions.0: needs a select: paths to numbers of "
            "trajectory_msgs/msg/JointTrajectory, one for each joint, e.g. points.0.positions.0"
        ),
    ),
    "contract_foreign_action_name": (
        "executor: arm_position, topic",
        "executor: arm_position, type: JointState, foreign: true, topic",
        "robot.yaml:38: contract.actions.0.type: expected PACKAGE/msg/NAME, got 'JointState'",
    ),
    "contract_action_twice": (
        "executor: grip_position, topic",
        "executor: arm_position, topic",
        "robot.yaml:39: contract.actions.1.executor: executor 'arm_position' already has an action",
    ),
    "contract_topic": (
        "topic: /arm/commands",
        "topic: arm/commands",
        "robot.yaml:38: contract.actions.0.topic: a topic starts with /, got 'arm/commands'",
    ),
    "contract_safety": (
        "topic: /arm/commands",
        "topic: /arm/commands, safety_behavior: hodl",
        "robot.yaml:38: contract.actions.0.safety_behavior: 'hodl' is not one of: hold, relax",
    ),
    "contract_rate": (
        "rate_hz: 30",
        "rate_hz: 200",
        "robot.yaml:33: contract.rate_hz: 200.0 Hz is faster than the control loop, 100.0 Hz",
    ),
    "extra_observation_kind": (
        "net: {type: net}",
        (
            "net: {type: net, extra_observations: [{key: observation.images.top, topic: /s, type: "
            "std_msgs/msg/Float64MultiArray}]}"
        ),
        (
            "robot.yaml:22: models.net.extra_observations.0.key: observation.images.top needs a camera; /s "
            "carries std_msgs/msg/Float64MultiArray"
        ),
    ),
    "no_contract": (
        (
            "contract:\n"
            "  rate_hz: 30\n"
            "  observations:\n"
            "    - {key: observation.state, topic: /joint_states, select: [position.pan, position.lift, "
            "position.grip]}\n"
            "    - {key: observation.images.top, peripheral: top, align: {strategy: asof, tol_ms: 100}}\n"
            "  actions:\n"
            "    - {executor: arm_position, topic: /arm/commands}\n"
            "    - {executor: grip_position, topic: /grip/commands}\n"
        ),
        "",
        (
            "robot.yaml:25: control_modes.policy.executors.0: no action of the contract drives executor "
            "'arm_position'; add one under contract.actions\n"
            "robot.yaml:25: control_modes.policy.executors.1: no action of the contract drives executor "
            "'grip_position'; add one under contract.actions"
        ),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, faults_of_edit: Callable[[str, str], str]) -> None:
    old, new, expected = CASES[case]

    assert faults_of_edit(old, new) == expected
