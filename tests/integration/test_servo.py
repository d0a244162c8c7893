"""Mode `servo` in a run: twists of another process come over Zenoh and move the tool, and its pose goes out."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path
from socket import create_connection

import pytest
import yaml
from ibrobot_testing.ports import free_port

pytestmark = pytest.mark.integration

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
TWIST = "{header: {frame_id: base_link}, twist: {linear: {z: 0.1}}}"


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def listens(endpoint: str) -> bool:
    host, port = endpoint.removeprefix("tcp/").split(":")
    try:
        create_connection((host, int(port)), timeout=1).close()
    except OSError:
        return False
    return True


def test_twists_from_another_process_move_the_tool(tmp_path: Path, ibrobot: tuple[str, ...], endpoint: str) -> None:
    document = yaml.safe_load(CONFIG.read_text())
    document["control_modes"]["servo"] = {"executors": ["arm_position", "gripper_position"], "teleop": "twist"}
    document["teleoperation"]["twist"] = {"type": "twist"}
    share = {"publish": ["/robot_status/ee_pose"], "subscribe": ["/servo_node/delta_twist_cmds"]}
    document["transport"] = {
        "type": "zenoh",
        "mode": "router",
        "listen": [endpoint],
        "namespace": "arm1",
        "share": share,
    }
    config = tmp_path / "robot.yaml"
    config.write_text(yaml.safe_dump(document))
    run = [*ibrobot, "launch", str(config), "--sim", "--headless", "--mode", "servo", "--json"]
    topic = [*ibrobot, "topic"]

    def height() -> float:
        echo = [*topic, "echo", "/arm1/robot_status/ee_pose", "--endpoint", endpoint, "-n", "1"]
        text = subprocess.run(echo, capture_output=True, text=True, timeout=60, check=True).stdout
        message = yaml.safe_load(text.split("---")[0])
        assert message["header"]["frame_id"] == "base_link"
        return float(message["pose"]["position"]["z"])

    with subprocess.Popen(run, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as launched:
        try:
            while not listens(endpoint):
                assert launched.poll() is None
                time.sleep(0.1)
            before = height()
            pub = [*topic, "pub", "/arm1/servo_node/delta_twist_cmds", "geometry_msgs/msg/TwistStamped", TWIST]
            deadline = time.monotonic() + 60
            while height() < before + 0.03:  # on a busy machine, few of them may come in time
                assert time.monotonic() < deadline, "the tool does not move"
                subprocess.run(
                    [*pub, "--endpoint", endpoint, "--rate", "50", "-n", "50"],
                    timeout=60,
                    check=True,
                    capture_output=True,
                )
        finally:
            launched.terminate()
            out, err = launched.communicate(timeout=120)
    assert json.loads(out.splitlines()[-1])["faults"] == [], err
