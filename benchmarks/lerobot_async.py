"""LeRobot's policy server with a stub policy: its own client beside our policy `lerobot_server`, and alone.

    python benchmarks/lerobot_async.py [--count 200] [--pause 0]

It runs where `lerobot[async]==0.6.1` is installed. The server is LeRobot's PolicyServer, in a process of its own, as it
is but for a policy that does nothing and no artificial latency. LeRobot's RobotClient has a robot that has its
observation at hand; measured is `control_loop_observation`, which its control loop calls, and the time from there until
the actions are in its queue. `lerobot_server` is measured from the observation to the chunk, at a server of its own.
Both ask in pairs, each first in turn. Where the packages here are not installed, LeRobot is measured alone: so
`inference_transport.py` runs this file. Exits with 1 if the median of the pairs' ratios, ours to LeRobot's, is over 1,
or if a chunk is wrong.
"""

from __future__ import annotations

import argparse
import json
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from concurrent import futures
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np
from apparatus import cpu_s, report, started

PAYLOADS = {
    "2x640x480 uint8": ((480, 640, 3), np.uint8),
    "2x224x224 float32": ((224, 224, 3), np.float32),
    "2 JPEGs": ((80, 160, 3), np.uint8),  # LeRobot has no JPEG on this way: raw pictures of as many bytes
}
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CHUNK = 50
WARM_UP = 20


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


def features(way: str, shape: tuple[int, int, int]) -> dict[str, Any]:
    """LeRobot's description of a client's observation."""
    names = [f"observation.state.{i}" for i in range(len(JOINTS))] if way == "lerobot_server" else [
        f"{joint}.pos" for joint in JOINTS
    ]  # fmt: skip
    picture = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    state = {"dtype": "float32", "shape": (len(JOINTS),), "names": names}
    return {"observation.state": state, "observation.images.top": picture, "observation.images.wrist": picture}


def serve(port: int, payload: str, way: str) -> None:
    """The server, until its standard input ends."""
    import grpc
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.policy_server import PolicyServer
    from lerobot.transport import services_pb2, services_pb2_grpc

    shape, _ = PAYLOADS[payload]

    class Server(PolicyServer):  # type: ignore[misc]  # LeRobot brings no types
        """Its policy is there from the beginning."""

        def SendPolicyInstructions(self, request: Any, context: Any) -> Any:
            """Nothing is loaded."""
            return services_pb2.Empty()

    servicer = Server(PolicyServerConfig(port=port, inference_latency=0.0))
    servicer.device, servicer.policy_type, servicer.actions_per_chunk = "cpu", "act", CHUNK
    servicer.lerobot_features, servicer.policy = features(way, shape), StubPolicy(shape)
    servicer.preprocessor = servicer.postprocessor = lambda value: value
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(servicer, server)
    server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    print("ready", flush=True)
    sys.stdin.read()
    server.stop(None)


@contextmanager
def served(payload: str, way: str) -> Iterator[tuple[str, int]]:
    """A server in another process: its address and process."""
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = int(free.getsockname()[1])
    with started(__file__, "--serve", port, "--payload", payload, "--way", way, says="ready") as (server, _):
        yield f"127.0.0.1:{port}", server.pid


class Theirs:
    """LeRobot's own client."""

    def __init__(self, address: str, payload: str) -> None:
        from lerobot.async_inference import robot_client
        from lerobot.async_inference.configs import RobotClientConfig

        robot_client.make_robot_from_config = lambda config: StubRobot(*PAYLOADS[payload])
        self._client = robot_client.RobotClient(RobotClientConfig("act", "none", None, CHUNK, server_address=address))
        self._client.start()
        threading.Thread(target=self._client.receive_actions, daemon=True).start()
        self._client.start_barrier.wait()

    def ask(self) -> float:
        """A request; how long the control loop was blocked [s]."""
        with self._client.action_queue_lock:
            self._client.action_queue = Queue()
        self._client.must_go.set()
        asked_s = time.perf_counter()
        self._client.control_loop_observation("")
        blocked_s = time.perf_counter() - asked_s
        while not self._client.actions_available():
            time.sleep(0.0001)
        return blocked_s

    def close(self) -> None:
        """Let its thread end."""
        self._client.shutdown_event.set()


class Ours:
    """The policy `lerobot_server`."""

    def __init__(self, address: str, payload: str) -> None:
        from ibrobot_policy_servers.lerobot_server import LerobotConnection
        from ibrobot_policy_servers.options import ActionMap, LerobotServerOptions, ObservationMap
        from ibrobot_policy_servers.served import ServedPolicy
        from ibrobot_testing import host_context

        from ibrobot_core.interfaces import Frame

        shape, _ = PAYLOADS[payload]
        state, top, wrist = "observation.state", "observation.images.top", "observation.images.wrist"
        options = LerobotServerOptions(
            address=address, policy_type="act", pretrained_name_or_path="none", horizon=CHUNK, rate_hz=30.0,
            observations=(
                ObservationMap(state, (state,), (len(JOINTS),)), ObservationMap(top, (top,), shape),
                ObservationMap(wrist, (wrist,), shape),
            ),
            actions=(ActionMap(JOINTS),),
        )  # fmt: skip
        pictures = np.random.default_rng(0).integers(0, 255, (2, *shape), np.uint8)
        values = {state: np.full(len(JOINTS), 0.5, np.float32), top: pictures[0], wrist: pictures[1]}
        self._frame = Frame(1, values, prompt="pick")
        self._policy = ServedPolicy(options, host_context(), LerobotConnection(options))
        self._policy.load()

    def ask(self) -> float:
        """A request, which blocks until its answer, in a thread of its own in a run."""
        policy = self._policy
        chunk = policy.postprocess(policy.infer(policy.preprocess(self._frame)))
        if chunk.shape != (CHUNK, len(JOINTS)) or chunk.any():
            raise SystemExit(f"a wrong chunk: {chunk}")
        return 0.0

    def close(self) -> None:
        """Close the connection."""
        self._policy.close()


def measure(payload: str, count: int, pause_s: float) -> Iterator[dict[str, Any]]:
    """Latencies of each client [ms], how long the control loop was blocked [ms], and processor time a request [ms]."""
    ways: dict[str, type[Theirs | Ours]] = {"lerobot": Theirs}
    if find_spec("ibrobot_policy_servers") and PAYLOADS[payload][1] is np.uint8:
        ways["lerobot_server"] = Ours
    with ExitStack() as stack:
        clients, servers = {}, {}
        for way, kind in ways.items():
            address, servers[way] = stack.enter_context(served(payload, way))
            clients[way] = kind(address, payload)
            stack.callback(clients[way].close)
        rows: dict[str, dict[str, Any]] = {way: {"latencies": [], "blocked": [], "cpu": []} for way in ways}
        for number in range(count + WARM_UP):
            for way in sorted(ways, reverse=bool(number % 2)):
                time.sleep(pause_s)
                used_s, asked_s = cpu_s() + cpu_s(servers[way]), time.perf_counter()
                rows[way]["blocked"].append(clients[way].ask() * 1e3)
                rows[way]["latencies"].append((time.perf_counter() - asked_s) * 1e3)
                rows[way]["cpu"].append(cpu_s() + cpu_s(servers[way]) - used_s)
    for way, row in rows.items():
        kept = {key: row[key][WARM_UP:] for key in ("latencies", "blocked")}
        yield {"payload": payload, "way": way, **kept, "cpu_ms": sum(row["cpu"][WARM_UP:]) / count * 1e3}


def main() -> int:
    """Print one JSON line for each payload and client, and what the pairs say; 1 if ours is slower."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--payload", default="", help=argparse.SUPPRESS)
    parser.add_argument("--way", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if given.serve:
        serve(given.serve, given.payload, given.way)
        return 0
    figures: dict[str, float] = {}
    for payload in PAYLOADS:
        rows = list(measure(payload, given.count, given.pause))
        for row in rows:
            print(json.dumps(row), flush=True)
        if len(rows) > 1:
            theirs, ours = (np.array(row["latencies"]) for row in rows)
            name = payload.replace(" ", "_")
            figures[f"{name}_ratio"] = float(np.median(ours / theirs))
            for way, latencies in (("lerobot", theirs), ("ours", ours)):
                for percent in (50, 99):
                    figures[f"{name}_{way}_p{percent}_ms"] = float(np.percentile(latencies, percent))
    if figures:
        report(**figures)
    return int(any(value > 1 for name, value in figures.items() if name.endswith("_ratio")))


if __name__ == "__main__":
    sys.exit(main())
