"""What must hold between sections: joints, groups, hardware, peripherals, executors, modes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

NAME = "a name is not empty and has no slash, control character or space at its ends"
# The fault, the replaced text of the base YAML, its replacement, and the whole error.
CASES = {
    "package_file_missing": (
        "    poses:",
        "    urdf: package://ibrobot_core/arm.urdf\n    poses:",
        (
            "robot.yaml:11: robot.description.urdf: the Python package 'ibrobot_core' has no file 'arm.urdf'; "
            "check its version and the path"
        ),
    ),
    "package_form": (
        "    poses:",
        "    urdf: package://ibrobot_core\n    poses:",
        ("robot.yaml:11: robot.description.urdf: expected package://PACKAGE/path, got 'package://ibrobot_core'"),
    ),
    "file_missing": (
        "    poses:",
        "    mjcf: arm.xml\n    poses:",
        (
            "robot.yaml:11: robot.description.mjcf: no such file: FOLDER/arm.xml; a relative path starts at the "
            "folder of the YAML file"
        ),
    ),
    "limits_swapped": (
        "pan, lower: -1.0, upper: 1.0",
        "pan, lower: 1.0, upper: -1.0",
        "robot.yaml:4: robot.joints.pan: lower (1.0) must be below upper (-1.0)",
    ),
    "no_joint_velocity": (
        "pan, lower: -1.0, upper: 1.0, max_velocity: 2.0",
        "pan, lower: -1.0, upper: 1.0, max_velocity: 0",
        "robot.yaml:4: robot.joints.pan.max_velocity: 0.0 is too small, must be above 0 rad/s",
    ),
    "robot_name_slash": ("name: mini", "name: ../mini", f"robot.yaml:2: robot.name: {NAME}, got '../mini'"),
    "group_name_control_character": (
        "    gripper: [grip]",
        '    gripper: [grip]\n    "a\\e[2J": [grip]',
        f"robot.yaml:10: robot.groups.a\\x1b[2J: {NAME}, got 'a\\x1b[2J'",
    ),
    "pose_name_empty": (
        "poses: {home: [0, 0, 0]}",
        'poses: {home: [0, 0, 0], "": [0, 0, 0]}',
        f"robot.yaml:11: robot.description.poses.: {NAME}, got ''",
    ),
    "joint_twice": (
        "name: lift",
        "name: pan",
        (
            "robot.yaml:5: robot.joints.pan.name: a second joint named 'pan'\n"
            "robot.yaml:8: robot.groups.arm.1: unknown joint 'lift'; known: pan, pan, grip\n"
            "robot.yaml:35: contract.observations.0.select.1: unknown joint 'lift'; known: pan, pan, grip"
        ),
    ),
    "joint_in_no_group": (
        "    arm: [pan, lift]",
        "    arm: [pan]",
        (
            "robot.yaml:5: robot.joints.lift: joint 'lift' is in no group, so no executor can own it; add it to "
            "one under robot.groups"
        ),
    ),
    "group_unknown_joint": (
        "    arm: [pan, lift]",
        "    arm: [pan, lift, gripp]",
        "robot.yaml:8: robot.groups.arm.2: unknown joint 'gripp', did you mean 'grip'?",
    ),
    "group_joint_twice": (
        "    arm: [pan, lift]",
        "    arm: [pan, lift, pan]",
        "robot.yaml:8: robot.groups.arm.2: joint 'pan' is given twice",
    ),
    "pose_length": (
        "home: [0, 0, 0]",
        "home: [0, 0]",
        "robot.yaml:11: robot.description.poses.home: expected a position for each joint, 3, got 2",
    ),
    "pose_above": (
        "home: [0, 0, 0]",
        "home: [1.5, 0, 0]",
        "robot.yaml:11: robot.description.poses.home.0: 1.5 rad is outside the limits of pan, -1.0 to 1.0",
    ),
    "pose_outside": (
        "home: [0, 0, 0]",
        "home: [0, 0, -0.5]",
        "robot.yaml:11: robot.description.poses.home.2: -0.5 rad is outside the limits of grip, 0.0 to 1.0",
    ),
    "executor_unknown_group": (
        "grip_position: {type: position, group: gripper}",
        "grip_position: {type: position, group: griper}",
        "robot.yaml:19: executors.grip_position.group: unknown group 'griper', did you mean 'gripper'?",
    ),
    "mode_unknown_executor": (
        "plan: {executors: [arm_trajectory]",
        "plan: {executors: [arm_trajectry]",
        (
            "robot.yaml:28: control_modes.plan.executors.0: unknown executor 'arm_trajectry', did you mean "
            "'arm_trajectory'?"
        ),
    ),
    "mode_claims_twice": (
        "teleop: {executors: [arm_position, grip_position]",
        "teleop: {executors: [arm_position, arm_trajectory]",
        (
            "robot.yaml:27: control_modes.teleop.executors.1: executors 'arm_position' and 'arm_trajectory' both "
            "claim joint 'pan'\n"
            "robot.yaml:27: control_modes.teleop.executors.1: executor 'arm_trajectory' takes goals, but teleop "
            "sends setpoints; use one that takes setpoints"
        ),
    ),
    "mode_executor_twice": (
        "plan: {executors: [arm_trajectory]",
        "plan: {executors: [arm_trajectory, arm_trajectory]",
        "robot.yaml:28: control_modes.plan.executors.1: executor 'arm_trajectory' is given twice",
    ),
    "mode_without_executors": (
        "plan: {executors: [arm_trajectory]",
        "plan: {executors: []",
        "robot.yaml:28: control_modes.plan.executors: a mode needs at least one executor",
    ),
    "mode_unknown_teleop": (
        "teleop: stick}",
        "teleop: stik}",
        ("robot.yaml:27: control_modes.teleop.teleop: unknown teleoperation device 'stik', did you mean 'stick'?"),
    ),
    "mode_unknown_model": (
        "{model: net}",
        "{model: nets}",
        "robot.yaml:26: control_modes.policy.inference.model: unknown model 'nets', did you mean 'net'?",
    ),
    "mode_goal_executor_for_teleop": (
        "[arm_position, grip_position], teleop: stick",
        "[arm_trajectory, grip_position], teleop: stick",
        (
            "robot.yaml:27: control_modes.teleop.executors.0: executor 'arm_trajectory' takes goals, but teleop "
            "sends setpoints; use one that takes setpoints"
        ),
    ),
    "mode_stream_executor_for_planner": (
        "plan: {executors: [arm_trajectory]",
        "plan: {executors: [arm_position]",
        (
            "robot.yaml:28: control_modes.plan.executors.0: executor 'arm_position' takes setpoints, but planner "
            "sends goals; use one that takes goals"
        ),
    ),
    "mode_two_sources": (
        "teleop: stick}",
        "teleop: stick, planner: {type: straight}}",
        "robot.yaml:27: control_modes.teleop.planner: teleop already drives this mode; make a mode for each",
    ),
    "mode_dispatch_alone": (
        "teleop: stick}",
        "teleop: stick, dispatch: {watermark: 5}}",
        "robot.yaml:27: control_modes.teleop.dispatch: applies only to a mode with inference",
    ),
    "watermark_word": (
        "{model: net}",
        "{model: net}\n    dispatch: {watermark: early}",
        "robot.yaml:27: control_modes.policy.dispatch.watermark: expected a whole number or auto, got 'early'",
    ),
    "watermark_negative": (
        "{model: net}",
        "{model: net}\n    dispatch: {watermark: -1}",
        "robot.yaml:27: control_modes.policy.dispatch.watermark: -1 is too small, must be at least 0 actions, or auto",
    ),
    "strategy": (
        "{model: net}",
        "{model: net}\n    dispatch: {strategy: blend}",
        "robot.yaml:27: control_modes.policy.dispatch.strategy: 'blend' is not one of: replace, ensemble, rtc",
    ),
    "strategy_against_smoothing": (
        "{model: net}",
        "{model: net}\n    dispatch: {strategy: ensemble, smoothing: {enabled: false}}",
        (
            "robot.yaml:27: control_modes.policy.dispatch: strategy ensemble blends chunks, which "
            "smoothing: {enabled: false} excludes"
        ),
    ),
    "mode_planner_missing": (
        "planner: {type: straight}",
        "planner: {type: ompll}",
        "robot.yaml:28: control_modes.plan.planner.type: unknown planner type 'ompll'; installed: straight",
    ),
    "execution_mode": (
        "{model: net}",
        "{model: net, execution_mode: cloud}",
        "robot.yaml:26: control_modes.policy.inference.execution_mode: unknown engine type 'cloud'; installed: "
        "far, monolithic",
    ),
    "execution_mode_nearly": (
        "{model: net}",
        "{model: net, execution_mode: monolitic}",
        "robot.yaml:26: control_modes.policy.inference.execution_mode: unknown engine type 'monolitic', did you mean "
        "'monolithic'?",
    ),
    "execution_mode_is_no_text": (
        "{model: net}",
        "{model: net, execution_mode: 5}",
        "robot.yaml:26: control_modes.policy.inference.execution_mode: expected text, got 5 (quote it: '5')",
    ),
    "execution_mode_option": (
        "{model: net}",
        "{model: net, server: big}",
        "robot.yaml:26: control_modes.policy.inference.server: unknown key with execution_mode 'monolithic'; "
        "it belongs to far",
    ),
    "execution_mode_option_value": (
        "{model: net}",
        "{model: net, execution_mode: far, server: 5}\n    dispatch: {watermark: 1}",
        "robot.yaml:26: control_modes.policy.inference.execution_mode: far needs a transport to the server, "
        "e.g. transport: {type: zenoh, connect: [tcp/127.0.0.1:7447]}\n"
        "robot.yaml:26: control_modes.policy.inference.server: expected text, got 5 (quote it: '5')",
    ),
    "execution_mode_without_a_transport": (
        "{model: net}",
        "{model: net, execution_mode: far}",
        "robot.yaml:26: control_modes.policy.inference.execution_mode: far needs a transport to the server, "
        "e.g. transport: {type: zenoh, connect: [tcp/127.0.0.1:7447]}",
    ),
    "default_mode": (
        "default_control_mode: teleop",
        "default_control_mode: telop",
        "robot.yaml:29: default_control_mode: unknown control mode 'telop', did you mean 'teleop'?",
    ),
    "stop": (
        "stop: hold}",
        "stop: halt}",
        "robot.yaml:41: control.stop: 'halt' is not one of: hold, relax, pose NAME",
    ),
    "stop_pose": (
        "stop: hold}",
        "stop: pose hme}",
        "robot.yaml:41: control.stop: unknown pose 'hme', did you mean 'home'?",
    ),
    "peripheral_twice": (
        "name: chest",
        "name: top",
        "robot.yaml:16: peripherals.top.name: a second peripheral named 'top', first in line 15",
    ),
    "peripheral_name": (
        "name: chest",
        "name: my chest",
        "robot.yaml:16: peripherals.my chest.name: a name may contain only letters, digits, _ and -, got 'my chest'",
    ),
    "peripheral_kind": (
        "kind: imu, type: gyro",
        "kind: camera, type: gyro",
        "robot.yaml:16: peripherals.chest.kind: sensor type 'gyro' is of kind 'imu'",
    ),
    "peripheral_simulated": (
        "type: webcam, fps",
        "type: virtual, fps",
        (
            "robot.yaml:15: peripherals.top.type: 'virtual' exists only in simulation; run with --sim, or name a "
            "real sensor"
        ),
    ),
    "simulation_in_hardware": (
        "hardware: {type: bus, port: /dev/null}",
        "hardware: {type: world}",
        "robot.yaml:12: hardware.type: 'world' is a simulation; it belongs in the simulation section",
    ),
    "hardware_in_simulation": (
        "simulation: {type: world}",
        "simulation: {type: bus, port: /dev/null}",
        "robot.yaml:13: simulation.type: 'bus' is not a simulation; it belongs in the hardware section",
    ),
    "hardware_joint_unowned": (
        "port: /dev/null}",
        "port: /dev/null, joints: [pan, lift]}",
        "robot.yaml:12: hardware: no hardware owns: grip",
    ),
    "hardware_joint_twice": (
        "hardware: {type: bus, port: /dev/null}",
        (
            "hardware: {left: {type: bus, port: a, joints: [pan, lift]}, right: {type: bus, port: b, joints: "
            "[lift, grip]}}"
        ),
        "robot.yaml:12: hardware.right.joints.0: joint 'lift' is already owned by hardware 'left'",
    ),
    "hardware_joints_needed": (
        "hardware: {type: bus, port: /dev/null}",
        "hardware: {left: {type: bus, port: a}, right: {type: bus, port: b, joints: [grip]}}",
        "robot.yaml:12: hardware.left.joints: required where there is more than one hardware component",
    ),
    "hardware_unknown_joint": (
        "port: /dev/null}",
        "port: /dev/null, joints: [pan, lift, grp]}",
        (
            "robot.yaml:12: hardware: no hardware owns: grip\n"
            "robot.yaml:12: hardware.joints.2: unknown joint 'grp', did you mean 'grip'?"
        ),
    ),
    "no_body": (
        "hardware: {type: bus, port: /dev/null}\nsimulation: {type: world}\n",
        "",
        "robot.yaml: needs a hardware section, a simulation section, or both",
    ),
    "norm_mode": (
        "net: {type: net}",
        "net: {type: net, norm_mode: ticks}",
        "robot.yaml:22: models.net.norm_mode: 'ticks' is not one of: radians, degrees, range_m100_100",
    ),
    "recording_topics": (
        "recording: {type: log}",
        "recording: {type: log, topics: everything}",
        "robot.yaml:40: recording.topics: 'everything' is not one of: contract, all, or a list of topics",
    ),
    "recording_no_topics": (
        "recording: {type: log}",
        "recording: {type: log, topics: []}",
        "robot.yaml:40: recording.topics: is empty; write contract for the contract's topics, or all for every topic",
    ),
    "recording_topic_name": (
        "recording: {type: log}",
        "recording: {type: log, topics: [/tf, joint_states]}",
        ("robot.yaml:40: recording.topics.1: 'joint_states' is not a full topic name, did you mean '/joint_states'?"),
    ),
    "recording_dataset_outside": (
        "recording: {type: log}",
        "recording: {type: log, dataset: ../pick}",
        ("robot.yaml:40: recording.dataset: '../pick' is not below recording.root; give a folder's name, e.g. picks"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, faults_of_edit: Callable[[str, str], str]) -> None:
    old, new, expected = CASES[case]

    assert faults_of_edit(old, new) == expected
