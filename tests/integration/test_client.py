"""A script for pymoveit2 moves a simulated SO-101 over the network: only its imports differ."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest
from ibrobot_planning.client import GripperInterface, MoveIt2, rclpy
from ibrobot_planning.client import robots as ibrobot_robots
from ibrobot_planning.client.rclpy import Node, ReentrantCallbackGroup
from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port

from ibrobot_core.api import Int8, TransportError
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

pytestmark = pytest.mark.integration
robot = ibrobot_robots.so101


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def _zenoh_runs() -> None:
    """Zenoh's own threads run, with the files that they keep."""
    zenoh = installed_plugins().find("transport", "zenoh")
    first = free_endpoint()
    router = zenoh.make(zenoh.options(mode="router", listen=(first,), shared_memory=False), host_context())
    zenoh.make(zenoh.options(connect=(first,), shared_memory=False), host_context()).close()
    router.close()


@pytest.fixture
def endpoint(_zenoh_runs: None) -> str:
    return free_endpoint()


@pytest.fixture
def arm(endpoint: str) -> Iterator[Runtime]:
    """A simulated SO-101 with a table, which shares its services."""
    registry = installed_plugins()
    config = load_config(
        find_config("so101_blind", registry),
        sim=True,
        mode="moveit_planning",
        registry=registry,
        overrides=(
            "simulation.scene=empty",
            "simulation.start_pose=home",
            "control_modes.moveit_planning.planner={type: rrt_connect}",
            "world={objects: {table: {shape: box, size: [0.8, 0.8, 0.02], position: [0.2, 0, -0.05]}}}",
            f"transport={{type: zenoh, mode: router, listen: [{endpoint}], shared_memory: false, namespace: arm1, "
            "share: {services: [/planning/, /world/, /get_planning_scene, /compute_ik, /compute_fk, /move_action, "
            "/plan_kinematic_path, /compute_cartesian_path, /execute_trajectory, /servo_node/, /set_mode]}}",
            "teleoperation.twist={type: twist}",
            "control_modes.servo={executors: [arm_position, gripper_position], teleop: twist}",
        ),
    )
    runtime = Runtime(Session(config, registry, LaunchRequest()))
    try:
        runtime.start()
        yield runtime
    finally:
        runtime.stop()


def test_script_moves_a_robot_over_the_network(arm: Runtime, endpoint: str):
    rclpy.init()
    node = Node("ex_pose_goal", f"connect=[{endpoint}]", "shared_memory=false", namespace="arm1")
    moveit2 = MoveIt2(
        node=node,
        joint_names=robot.joint_names(),
        base_link_name=robot.base_link_name(),
        end_effector_name=robot.end_effector_name(),
        group_name=robot.MOVE_GROUP_ARM,
        callback_group=ReentrantCallbackGroup(),
    )
    executor = rclpy.executors.MultiThreadedExecutor(2)
    executor.add_node(node)
    executor_thread = Thread(target=executor.spin, daemon=True, args=())
    executor_thread.start()
    node.create_rate(20.0).sleep()

    moveit2.max_velocity = 0.5
    moveit2.add_collision_box("post", (0.02, 0.02, 0.1), position=(0.25, 0.15, 0.05), quat_xyzw=(0, 0, 0, 1))
    moveit2.move_to_pose(position=[0.25, 0.0, 0.12], quat_xyzw=None)
    assert moveit2.wait_until_executed()
    pose = moveit2.compute_fk()
    assert pose is not None
    assert (pose.pose.position.x, pose.pose.position.z) == pytest.approx((0.25, 0.12), abs=0.02)
    trajectory = moveit2.plan(joint_positions=[0.3, 0.0, 0.0, 0.0, 0.0])
    assert trajectory is not None
    moveit2.execute(trajectory)
    assert moveit2.wait_until_executed()
    assert moveit2.joint_state.position[0] == pytest.approx(0.3, abs=0.05)
    gripper = GripperInterface(
        node=node,
        gripper_joint_names=robot.gripper_joint_names(),
        open_gripper_joint_positions=robot.OPEN_GRIPPER_JOINT_POSITIONS,
        closed_gripper_joint_positions=robot.CLOSED_GRIPPER_JOINT_POSITIONS,
        gripper_group_name=robot.MOVE_GROUP_GRIPPER,
    )
    gripper.open()
    assert gripper.wait_until_executed()
    assert gripper.is_open

    node.destroy_node()
    rclpy.shutdown()
    executor_thread.join(30)
    assert not executor_thread.is_alive()


def test_script_on_the_page_runs(arm: Runtime, endpoint: str):
    page = Path(__file__).parents[2] / "docs/how-to/move-a-pymoveit2-script.md"
    _, imports, script, servo = re.findall(
        r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    here = f'Node("pick", "connect=[{endpoint}]", "shared_memory=false", namespace="arm1")'
    assert 'Node("pick")' in script
    checked = f"assert moveit2.get_last_execution_error_code().val == 1\n{servo}rclpy.shutdown()"
    codes = arm.session.bus.subscribe("/servo_node/status", 100)
    text = imports + script.replace('Node("pick")', here).replace("rclpy.shutdown()", checked)
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert arm.session.state is not None
    assert arm.session.state.position[5] == pytest.approx(1.5, abs=0.1)
    twists = [received.message.data for received in codes.drain() if isinstance(received.message, Int8)]
    assert arm.session.mode == "moveit_planning"
    assert 0 in twists, "a busy machine may read some of them too late, which are refused"


def test_missing_robot_is_an_error(endpoint: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr("ibrobot_planning.client.node._CONNECT_S", 0.2)
    caplog.set_level(logging.CRITICAL)
    with pytest.raises(TransportError, match="nobody listens there"):
        Node("script", f"connect=[{endpoint}]", "shared_memory=false")


@pytest.mark.parametrize(
    ("end", "code"),
    [("", 0), ("rclpy.shutdown()", 0), ("node.destroy_node()", 0), ("sys.exit(3)", 3), ("raise ValueError", 1)],
    ids=["nothing", "shutdown", "destroyed", "exit", "error"],
)
def test_script_ends_however_it_ends(arm: Runtime, endpoint: str, end: str, code: int):
    """With a node that nobody destroys, and a thread that spins."""
    text = f"""\
import sys
from threading import Thread
from ibrobot_planning.client import rclpy, Node
node = Node("pick", "connect=[{endpoint}]", "shared_memory=false", namespace="arm1")
executor = rclpy.executors.MultiThreadedExecutor(2)
executor.add_node(node)
Thread(target=executor.spin, daemon=True).start()
node.call("/get_planning_scene")
{end}
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == code, done.stderr
    assert ("ValueError" in done.stderr) == (code == 1)
