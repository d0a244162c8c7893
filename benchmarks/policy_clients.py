"""Clients of openpi and GR00T, as their projects publish them, against `ibrobot serve --protocol`.

    python benchmarks/policy_clients.py [--requests 500] [--openpi PYTHON] [--gr00t PYTHON --checkout FOLDER]

The model repeats the state. PYTHON is an interpreter of another environment: for --openpi one with
`openpi-client==0.1.2` and `typing_extensions` (it needs NumPy below 2); for --gr00t one with `msgpack`, `numpy` and
`pyzmq`, where FOLDER has the module `gr00t.policy.server_client` of a checkout of Isaac GR00T. A request has two
cameras of 224x224, the state and a prompt; the answer has 50 actions. Prints the requests, those whose answer is not
the state, whether a wrong request and a wrong key are errors, and milliseconds of a request. Exits with 1 if any is
wrong.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
from contextlib import closing
from typing import Any, override

import numpy as np
from ibrobot_serve.client_model import ClientModel
from ibrobot_serve.gr00t_server import Gr00tServer
from ibrobot_serve.openpi_server import OpenpiServer
from ibrobot_testing import host_context

from ibrobot_core.interfaces import Frame, Policy, PolicySpec, Tensors

HORIZON = 50
STATE, TOP, WRIST = "observation.state", "observation.images.top", "observation.images.wrist"
IMAGE = (224, 224, 3)
KEY = "pa55word"
COMMON = """
import json, sys, time
import numpy as np
port, count = int(sys.argv[1]), int(sys.argv[2])
rng, times, wrong = np.random.default_rng(0), [], 0
images = [rng.integers(0, 256, (224, 224, 3)).astype(np.uint8) for _ in range(2)]
def fails(act):
    try:
        act()
    except Exception as error:
        return type(error).__name__
for number in range(count):
    state = rng.uniform(-1, 1, 6).astype(np.float32)
    begun = time.perf_counter()
    actions = ask(state)
    times.append((time.perf_counter() - begun) * 1e3)
    wrong += not np.array_equal(actions, np.tile(state, (50, 1)))
print(json.dumps({"requests": count, "wrong": wrong, "p50_ms": round(float(np.median(times)), 2),
                  "p99_ms": round(float(np.percentile(times, 99)), 2), "wrong_request": fails(bad),
                  "wrong_key": fails(stranger), "numpy": np.__version__}))
"""
OPENPI = """
from openpi_client.websocket_client_policy import WebsocketClientPolicy
import sys
client = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]), api_key="pa55word")
assert client.get_server_metadata()["horizon"] == 50
def ask(state):
    return client.infer({"observation.state": state, "observation.images.top": images[0],
                         "observation.images.wrist": images[1], "prompt": "pick up the cube"})["actions"]
def bad():
    client.infer({"observation.state": np.zeros(5, np.float32)})
def stranger():
    WebsocketClientPolicy("127.0.0.1", port, api_key="password")
"""
GR00T = """
import sys
sys.path.insert(0, sys.argv[3])
from gr00t.policy.server_client import PolicyClient
client = PolicyClient("127.0.0.1", int(sys.argv[1]), api_token="pa55word")
assert client.ping()
assert client.get_modality_config()["action"].delta_indices == list(range(50))
client.reset()
def ask(state):
    action, told = client.get_action({
        "state": {"state": state[None, None]},
        "video": {"top": images[0][None, None], "wrist": images[1][None, None]},
        "language": {"annotation.human.task_description": [["pick up the cube"]]},
    })
    assert told["joints"][0] == "shoulder_pan"
    return action["action"][0]
def bad():
    client.get_action({"state": {"state": np.zeros((1, 1, 5), np.float32)}})
def stranger():
    PolicyClient("127.0.0.1", port, api_token="password").get_action({})
"""


class Repeats(Policy):
    """Repeats the state."""

    def __init__(self) -> None:
        shapes = {STATE: (6,), TOP: IMAGE, WRIST: IMAGE}
        self.spec = PolicySpec(shapes, host_context().robot.joint_names, 6, HORIZON, 30.0, prompt=True)

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        return frame.values

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return {"actions": np.tile(tensors[STATE], (HORIZON, 1))}

    @override
    def postprocess(self, tensors: Tensors) -> Any:
        return np.asarray(tensors["actions"], np.float64)


def main() -> int:
    """The clients that were named; 1 if any is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--requests", type=int, default=500)
    parser.add_argument("--openpi", metavar="PYTHON")
    parser.add_argument("--gr00t", metavar="PYTHON")
    parser.add_argument("--checkout", metavar="FOLDER", default="")
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    failed = False
    for name, python, server, code in (
        ("openpi", given.openpi, OpenpiServer, OPENPI),
        ("gr00t", given.gr00t, Gr00tServer, GR00T),
    ):
        if python is None:
            continue
        model = ClientModel(Repeats(), "repeats", name)
        with closing(server(model, "127.0.0.1", 0, KEY)) as serving:
            arguments = (str(serving.port), str(given.requests), given.checkout)
            done = subprocess.run(
                [python, "-c", code + COMMON, *arguments], stdout=subprocess.PIPE, text=True, check=True
            )
        result = {"client": name, **json.loads(done.stdout), "answered": model.answered, "refused": model.failed}
        print(json.dumps(result))
        failed |= bool(result["wrong"]) or not result["wrong_request"] or not result["wrong_key"]
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
