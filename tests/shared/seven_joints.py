"""An arm with seven joints, one of which slides, and three cameras, which nothing else knows."""

from __future__ import annotations

from pathlib import Path

JOINTS = ("turn", "lift", "elbow", "roll", "pitch", "yaw", "finger")
CAMERAS = ("side", "above", "hand")
_LINK = '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.12" mass="0.2" rgba="0.2 0.5 0.7 1"/>'


def write_seven_joints(folder: Path) -> Path:
    """Write its MJCF and its robot YAML, and return the YAML."""
    inner = '<site name="tool" pos="0 0 0.08"/><camera name="hand" pos="0 0 0.03" quat="0 1 0 0"/>'
    for i, name in reversed(list(enumerate(JOINTS))):
        slides = name == "finger"
        kind, axis, reach = ("slide", "0 0 1", "0 0.05") if slides else ("hinge", ("0 0 1", "0 1 0")[i % 2], "-1.5 1.5")
        joint = f'<joint name="{name}" type="{kind}" axis="{axis}" range="{reach}" damping="1" armature="0.1"/>'
        inner = f'<body name="{name}_link" pos="0 0 0.12">{joint}{_LINK}{inner}</body>'
    drives = "".join(f'<position name="{name}" joint="{name}" kp="200" kv="20"/>' for name in JOINTS)
    cameras = '<camera name="side" pos="1.2 0 0.6" xyaxes="0 1 0 -0.4 0 1"/><camera name="above" pos="0 0 2"/>'
    (folder / "arm.xml").write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><light pos="0 0 2"/>{cameras}{inner}</worldbody>'
        f"<actuator>{drives}</actuator></mujoco>",
        encoding="utf-8",
    )
    arm = "max_velocity: 2.0, max_acceleration: 20.0"
    lines = [f"{{name: {name}, lower: -1.5, upper: 1.5, {arm}}}" for name in JOINTS[:-1]]
    lines.append("{name: finger, lower: 0.0, upper: 0.05, max_velocity: 0.05, max_acceleration: 1.0}")
    peripherals = [f"{{name: {name}, kind: camera, type: mujoco, width: 64, height: 48, fps: 10}}" for name in CAMERAS]
    path = folder / "seven.yaml"
    path.write_text(
        f"""robot:
  name: seven
  robot_type: seven
  joints: [{", ".join(lines)}]
  groups: {{arm: [{", ".join(JOINTS[:-1])}], gripper: [finger]}}
  description: {{mjcf: arm.xml, tip: tool, poses: {{home: [0, 0, 0, 0, 0, 0, 0], bent: [0, 0.5, 0.8, 0, 0.5, 0, 0]}}}}
simulation:
  type: mujoco
  scene: empty
  start_pose: bent
  objects: {{crate: {{shape: box, size: [0.1, 0.1, 0.1], position: [0.4, 0.2, 0.05]}}}}
peripherals: [{", ".join(peripherals)}]
executors:
  arm_position: {{type: position, group: arm}}
  finger_position: {{type: position, group: gripper}}
control_modes:
  web: {{executors: [arm_position, finger_position], teleop: web}}
default_control_mode: web
teleoperation:
  web: {{type: web}}
""",
        encoding="utf-8",
    )
    return path
