"""LeRobot's own asynchronous inference with a stub policy, for `inference_transport.py`, which runs this file.

It runs where `lerobot[async]==0.6.1` is installed, in two processes: its PolicyServer as it is but for a policy that
does nothing and no artificial latency, and its RobotClient with a robot that has its observation at hand. Measured is
`control_loop_observation`, which its control loop calls, and the time from there until the actions are in its queue.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import threading
import time
from concurrent import futures
from pathlib import Path
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np

PAYLOADS = {
    "2x640x480 uint8": ((480, 640, 3), np.uint8),
    "2x224x224 float32": ((224, 224, 3), np.float32),
    "2 JPEGs": ((80, 160, 3), np.uint8),  # LeRobot has no JPEG on this way: raw pictures of as many bytes
}
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CHUNK = 50


class StubPolicy:
    """Answers with zeros."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        import torch

        image = SimpleNamespace(shape=(shape[2], shape[0], shape[1]))
        self.config = SimpleNamespace(image_features={f"observation.images.{name}": image for name in ("top", "wrist")})
        self._chunk = torch.zeros(1, CHUNK, len(JOINTS))

    def predict_action_chunk(self, observation: Any) -> Any:
        """Shape (1, CHUNK, J)."""
        return self._chunk


class StubRobot:
    """Has its observation at hand."""

    def __init__(self, shape: tuple[int, int, int], dtype: Any) -> None:
        state = {f"{name}.pos": float for name in JOINTS}
        self.observation_features = {**state, "top": shape, "wrist": shape}
        self.action_features = state
        pictures = np.random.default_rng(0).integers(0, 255, (2, *shape)).astype(dtype)
        self._observation = {**dict.fromkeys(state, 0.5), "top": pictures[0], "wrist": pictures[1]}

    def connect(self) -> None:
        """There is nothing to connect."""

    def disconnect(self) -> None:
        """There is nothing to disconnect."""

    def get_observation(self) -> dict[str, Any]:
        """The same each time."""
        return dict(self._observation)


def features(shape: tuple[int, int, int], dtype: Any) -> Any:
    """LeRobot's own description of the observation."""
    from lerobot.async_inference.helpers import map_robot_keys_to_lerobot_features

    return map_robot_keys_to_lerobot_features(StubRobot(shape, dtype))


def serve(port: int, payload: str) -> None:
    """The server, until its standard input ends."""
    import grpc
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.policy_server import PolicyServer
    from lerobot.transport import services_pb2, services_pb2_grpc

    shape, dtype = PAYLOADS[payload]

    class Server(PolicyServer):  # type: ignore[misc]  # LeRobot brings no types
        """Its policy is there from the beginning."""

        def SendPolicyInstructions(self, request: Any, context: Any) -> Any:
            """Nothing is loaded."""
            return services_pb2.Empty()

    servicer = Server(PolicyServerConfig(port=port, inference_latency=0.0))
    servicer.device, servicer.policy_type, servicer.actions_per_chunk = "cpu", "act", CHUNK
    servicer.lerobot_features, servicer.policy = features(shape, dtype), StubPolicy(shape)
    servicer.preprocessor = servicer.postprocessor = lambda value: value
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(servicer, server)
    server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    print("ready", flush=True)
    sys.stdin.read()
    server.stop(None)


def cpu_s(pid: int | str = "self") -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def measure(port: int, payload: str, count: int, pause_s: float) -> dict[str, Any]:
    """Latencies [ms], how long the control loop was blocked [ms], and processor time a request [ms]."""
    from lerobot.async_inference import robot_client
    from lerobot.async_inference.configs import RobotClientConfig

    shape, dtype = PAYLOADS[payload]
    command = [sys.executable, __file__, "--serve", str(port), "--payload", payload]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    while "ready" not in (line := server.stdout.readline()):
        if not line:
            raise SystemExit("the server did not start")
    robot_client.make_robot_from_config = lambda config: StubRobot(shape, dtype)
    config = RobotClientConfig("act", "none", None, CHUNK, server_address=f"127.0.0.1:{port}")
    client = robot_client.RobotClient(config)
    client.start()
    receiver = threading.Thread(target=client.receive_actions, daemon=True)
    receiver.start()
    client.start_barrier.wait()
    latencies, blocked = [], []
    for number in range(count + 20):
        if number == 20:
            begun_s = cpu_s() + cpu_s(server.pid)
        time.sleep(pause_s)
        with client.action_queue_lock:
            client.action_queue = Queue()
        client.must_go.set()
        asked_s = time.perf_counter()
        client.control_loop_observation("")
        blocked.append((time.perf_counter() - asked_s) * 1e3)
        while not client.actions_available():
            time.sleep(0.0001)
        latencies.append((time.perf_counter() - asked_s) * 1e3)
    used_s = cpu_s() + cpu_s(server.pid) - begun_s
    client.shutdown_event.set()
    server.kill()
    server.wait()
    return {"latencies": latencies[20:], "blocked": blocked[20:], "cpu_ms": used_s / count * 1e3}


def main() -> None:
    """Print one JSON line for each payload."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--port", type=int, default=50171)
    parser.add_argument("--serve", type=int)
    parser.add_argument("--payload", default="")
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if given.serve:
        serve(given.serve, given.payload)
        return
    for number, payload in enumerate(PAYLOADS):
        measured = measure(given.port + number, payload, given.count, given.pause)
        print(json.dumps({"payload": payload, **measured}), flush=True)


if __name__ == "__main__":
    main()
