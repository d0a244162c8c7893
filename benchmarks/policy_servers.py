"""Request to chunk from an openpi, vla-eval or GR00T server, beside a bare socket that carries the same bytes.

    python benchmarks/policy_servers.py [--requests 500]
        [--openpi PYTHON | --vla-eval PYTHON | --gr00t PYTHON --checkout FOLDER]

The server does nothing but repeat the state. By default it is one of ours that speaks openpi's protocol. Otherwise it
is the project's own, and PYTHON an interpreter of another environment: with `openpi-server==0.1.0`, `openpi-
client==0.1.2` (which need NumPy below 2) and `typing_extensions`; with `vla-eval==0.8.0`; or with `msgpack`, `numpy`
and `pyzmq`, where FOLDER has the module `gr00t.policy.server_client` of a checkout of Isaac GR00T. A request has two
raw cameras of 224x224, the state and a prompt; the answer has 50 actions, or 1 with vla-eval. Prints milliseconds of
both, taken in turn, and exits with 1 if an action is not the state.
"""

from __future__ import annotations

import argparse
import json
import logging
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
from ibrobot_policy_servers.gr00t import Gr00tConnection
from ibrobot_policy_servers.openpi import OpenpiConnection
from ibrobot_policy_servers.options import ActionMap, Gr00tOptions, ObservationMap, OpenpiOptions, VlaEvalOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_policy_servers.vla_eval import VlaEvalConnection
from ibrobot_policy_wire import pack
from ibrobot_testing import host_context
from ibrobot_testing.contexts import ARM, GRIPPER

from ibrobot_core.interfaces import Frame

HORIZON = 50
STATE, TOP, WRIST = "observation.state", "observation.images.top", "observation.images.wrist"
IMAGE = (224, 224, 3)
START_S = 60.0
OURS = """
import sys
from ibrobot_policy_wire import pack, unpack
from websockets.sync.server import serve
def handle(connection):
    connection.send(pack({"server": "ours"}))
    for message in connection:
        state = unpack(message)["observation/state"]
        connection.send(pack({"actions": state[None].repeat(50, 0)}))
with serve(handle, "127.0.0.1", int(sys.argv[1]), compression=None, max_size=None) as server:
    server.serve_forever()
"""
THEIRS = """
import sys
from openpi_server.websocket_policy_server import WebsocketPolicyServer
class Policy:
    def infer(self, obs):
        return {"actions": obs["observation/state"][None].repeat(50, 0)}
WebsocketPolicyServer(Policy(), "127.0.0.1", int(sys.argv[1]), {"server": "openpi"}).serve_forever()
"""
VLA_EVAL = """
import sys
from vla_eval.model_servers.base import ModelServer
from vla_eval.model_servers.serve import serve
class Repeats(ModelServer):
    async def on_observation(self, obs, ctx):
        await ctx.send_action({"actions": obs["observation/state"]})
    async def on_episode_start(self, config, ctx):
        pass
serve(Repeats(), "127.0.0.1", int(sys.argv[1]))
"""
GR00T = """
import sys
sys.path.insert(0, sys.argv[2])
from gr00t.policy.server_client import PolicyServer
class Repeats:
    def get_action(self, observation, options):
        return {"action": observation["state"]["state"].repeat(50, 1)}, {}
    def reset(self, options):
        return {}
PolicyServer(Repeats(), "127.0.0.1", int(sys.argv[1])).run()
"""


def free_port() -> int:
    """A port of loopback that nobody uses."""
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        return int(server.getsockname()[1])


@contextmanager
def served(python: str, code: str, checkout: str = "") -> Iterator[int]:
    """A server in another process; its port."""
    port = free_port()
    process = subprocess.Popen([python, "-c", code, str(port), checkout], stdout=subprocess.DEVNULL)
    try:
        yield port
    finally:
        process.terminate()
        process.wait()


def policy_of(kind: str, port: int) -> ServedPolicy:
    """The robot's side, once the server is up."""
    ctx = host_context()
    common: dict[str, Any] = {"horizon": 1 if kind == "vla_eval" else HORIZON, "rate_hz": 30.0}
    if kind == "gr00t":
        gr00t = Gr00tOptions(
            address=f"tcp://127.0.0.1:{port}",
            observations=(
                ObservationMap(STATE, ("state", "state"), (6,)),
                ObservationMap(TOP, ("video", "top"), IMAGE),
                ObservationMap(WRIST, ("video", "wrist"), IMAGE),
            ),
            actions=(ActionMap(ARM + GRIPPER, ("action",)),),
            prompt=("language", "annotation.human.task_description"),
            **common,
        )
        policy = ServedPolicy(gr00t, ctx, Gr00tConnection(gr00t))
    else:
        mapping: dict[str, Any] = {
            "url": f"ws://127.0.0.1:{port}",
            "observations": (
                ObservationMap(STATE, ("observation/state",), (6,)),
                ObservationMap(TOP, ("observation/image",), IMAGE),
                ObservationMap(WRIST, ("observation/wrist_image",), IMAGE),
            ),
            "actions": (ActionMap(ARM + GRIPPER),),
            **common,
        }
        if kind == "vla_eval":
            vla_eval = VlaEvalOptions(**mapping)
            policy = ServedPolicy(vla_eval, ctx, VlaEvalConnection(vla_eval), stateful=True)
        else:
            openpi = OpenpiOptions(**mapping)
            policy = ServedPolicy(openpi, ctx, OpenpiConnection(openpi, ctx.log))
    deadline_s = time.monotonic() + START_S
    while True:
        try:
            policy.load()
            return policy
        except Exception:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.1)


class BareSocket:
    """A thread that answers each request of a fixed size."""

    def __init__(self, request: int, answer: int) -> None:
        self._request, self._answer = bytes(request), bytes(answer)
        listener = socket.create_server(("127.0.0.1", 0))
        self._client = socket.create_connection(listener.getsockname())
        self._server, _ = listener.accept()
        listener.close()
        for each in (self._client, self._server):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while self._read(self._server, len(self._request)):
            self._server.sendall(self._answer)

    @staticmethod
    def _read(connection: socket.socket, size: int) -> bool:
        return len(connection.recv(size, socket.MSG_WAITALL)) == size

    def ask(self) -> None:
        """One request and its answer."""
        self._client.sendall(self._request)
        self._read(self._client, len(self._answer))


def main() -> int:
    """Both; 1 if an answer is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--requests", type=int, default=500)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--openpi", metavar="PYTHON", help="interpreter with openpi-server and openpi-client")
    which.add_argument("--vla-eval", metavar="PYTHON", help="interpreter with vla-eval")
    which.add_argument("--gr00t", metavar="PYTHON", help="interpreter with msgpack, numpy and pyzmq")
    parser.add_argument("--checkout", metavar="FOLDER", default="", help="folder with the package gr00t")
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    kind, python, code = next(
        (
            each
            for each in (
                ("openpi", given.openpi, THEIRS),
                ("vla_eval", given.vla_eval, VLA_EVAL),
                ("gr00t", given.gr00t, GR00T),
            )
            if each[1]
        ),
        ("ours", sys.executable, OURS),
    )
    rng, wrong = np.random.default_rng(0), 0
    with served(python, code, given.checkout) as port:
        policy = policy_of(kind, port)
        length = policy.spec.chunk_size
        images = {key: rng.integers(0, 256, IMAGE, np.uint8) for key in (TOP, WRIST)}
        state = rng.uniform(-1, 1, 6).astype(np.float32)
        request: dict[str, Any] = {"observation/state": state, "prompt": "pick up the cube"}
        request |= {"observation/image": images[TOP], "observation/wrist_image": images[WRIST]}
        bare = BareSocket(len(pack(request)), len(pack({"actions": np.zeros((length, 6), np.float32)})))
        times_ms: dict[str, list[float]] = {"socket": [], "policy": []}
        for number in range(given.requests):
            begun_s = time.perf_counter()
            bare.ask()
            asked_s = time.perf_counter()
            state = rng.uniform(-1, 1, 6).astype(np.float32)
            frame = Frame(number, {STATE: state, **images}, prompt="pick up the cube")
            made_s = time.perf_counter()
            actions = policy.postprocess(policy.infer(policy.preprocess(frame)))
            times_ms["policy"].append((time.perf_counter() - made_s) * 1e3)
            times_ms["socket"].append((asked_s - begun_s) * 1e3)
            wrong += not np.array_equal(actions, np.tile(state.astype(np.float64), (length, 1)))
        policy.close()
    medians = {name: float(np.median(values)) for name, values in times_ms.items()}
    result = {
        "server": kind,
        "requests": given.requests,
        "bytes": len(pack(request)),
        **{f"{name}_p50_ms": round(medians[name], 2) for name in medians},
        **{f"{name}_p99_ms": round(float(np.percentile(values, 99)), 2) for name, values in times_ms.items()},
        "times_the_socket": round(medians["policy"] / medians["socket"], 2),
        "wrong": wrong,
    }
    print(json.dumps(result))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
