"""LeRobot's own policy server: our chunks are those of LeRobot's own client, bit for bit."""

from __future__ import annotations

import contextlib
import importlib
import logging
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import attrs
import grpc
import numpy as np
import pytest
import torch
from ibrobot_policy_servers.lerobot_server import LerobotConnection
from ibrobot_policy_servers.options import ActionMap, LerobotServerOptions, ObservationMap
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_testing import host_context, ibrobot_command
from ibrobot_testing.contexts import ARM, GRIPPER
from lerobot.configs import FeatureType, PolicyFeature
from numpy.typing import NDArray

from ibrobot_core.app import installed_plugins
from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Frame

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CHUNK, EVERYWHERE, STATE, TOP, WRIST, act, features, save

pytestmark = pytest.mark.lerobot

JOINTS = ARM + GRIPPER
IMAGE, LARGE = (96, 96, 3), (120, 160, 3)
"""The large one is resized by the server."""
PATIENCE_S = 300.0
THREADS = 4
"""Of LeRobot's server, for requests."""


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(act(**features(STATE, TOP, WRIST)), tmp_path_factory.mktemp("checkpoint") / "act")


def imported(name: str, folder: Path) -> ModuleType:
    """A module of LeRobot's server or client, which opens a log file and changes all logging when it is imported."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    with contextlib.chdir(folder):
        module = importlib.import_module(f"lerobot.async_inference.{name}")
    for handler in root.handlers:
        if handler not in before:
            handler.close()
    root.handlers[:] = before
    root.setLevel(level)
    return module


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """LeRobot's server, in this process, which has torch already; all its threads run before a test begins."""
    module = imported("policy_server", tmp_path_factory.mktemp("server"))
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = free.getsockname()[1]
    config = module.PolicyServerConfig(host="127.0.0.1", port=port, inference_latency=0.0, obs_queue_timeout=0.2)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    pool, begun = ThreadPoolExecutor(THREADS), threading.Barrier(THREADS + 1)
    for _ in range(THREADS):
        pool.submit(begun.wait)
    begun.wait()
    server = grpc.server(pool)
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr(grpc, "server", lambda executor: server)
        serving = threading.Thread(target=module.serve, args=(config,))
        serving.start()
        try:
            until_it_listens(port, serving)
            yield f"127.0.0.1:{port}"
        finally:
            server.stop(0).wait()
            serving.join()
            pool.shutdown()
            torch.set_num_threads(threads)


def until_it_listens(port: int, serving: threading.Thread) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port)).close()
        except ConnectionRefusedError:
            assert serving.is_alive()
            assert time.monotonic() < deadline_s
            time.sleep(0.05)


def options_of(address: str, checkpoint: Path, **changes: Any) -> LerobotServerOptions:
    options = LerobotServerOptions(
        address=address,
        policy_type="act",
        pretrained_name_or_path=str(checkpoint),
        observations=(
            ObservationMap(STATE, (STATE,), (len(JOINTS),)),
            ObservationMap(TOP, (TOP,), IMAGE),
            ObservationMap(WRIST, (WRIST,), LARGE),
        ),
        actions=(ActionMap(JOINTS),),
        horizon=CHUNK,
        rate_hz=30.0,
        timeout=PATIENCE_S,
        start_timeout=PATIENCE_S,
    )
    return attrs.evolve(options, **changes)


@contextlib.contextmanager
def loaded(options: LerobotServerOptions) -> Iterator[ServedPolicy]:
    policy = ServedPolicy(options, host_context(), LerobotConnection(options))
    try:
        policy.load()
        yield policy
    finally:
        policy.close()


def seen(count: int) -> list[dict[str, NDArray[Any]]]:
    """Observations."""
    rng = np.random.default_rng(4)
    return [
        {
            STATE: rng.uniform(-1, 1, len(JOINTS)).astype(np.float32),
            TOP: rng.integers(0, 256, IMAGE, np.uint8),
            WRIST: rng.integers(0, 256, LARGE, np.uint8),
        }
        for _ in range(count)
    ]


@pytest.fixture(scope="module")
def robot_client(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """The module of LeRobot's client."""
    return imported("robot_client", tmp_path_factory.mktemp("client"))


class Robot:
    """A robot of LeRobot with what the test sets."""

    values: dict[str, NDArray[Any]]

    def __init__(self) -> None:
        self.action_features = {f"{joint}.pos": float for joint in JOINTS}
        self.observation_features = self.action_features | {"top": IMAGE, "wrist": LARGE}

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        joints = {f"{joint}.pos": float(value) for joint, value in zip(JOINTS, self.values[STATE], strict=True)}
        return joints | {"top": self.values[TOP], "wrist": self.values[WRIST]}


def lerobots_chunk(robot_client: ModuleType, address: str, checkpoint: Path) -> NDArray[np.float32]:
    """What LeRobot's own client gets for its first observation, shape (N, A)."""
    config = robot_client.RobotClientConfig(
        policy_type="act", pretrained_name_or_path=str(checkpoint), robot=None, actions_per_chunk=CHUNK,
        server_address=address,
    )  # fmt: skip
    client = robot_client.RobotClient(config)
    assert client.start()
    receiver = threading.Thread(target=client.receive_actions)
    receiver.start()
    try:
        client.start_barrier.wait()
        client.control_loop_observation("pick up the cube")
        deadline_s = time.monotonic() + PATIENCE_S
        while not client.actions_available() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        return torch.stack([each.get_action() for each in client.action_queue.queue]).numpy()
    finally:
        client.shutdown_event.set()
        receiver.join()
        client.stop()


def test_chunks_are_those_of_lerobots_own_client(
    robot_client: ModuleType, address: str, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, observations = Robot(), seen(3)
    monkeypatch.setattr(robot_client, "make_robot_from_config", lambda config: robot)
    with loaded(options_of(address, checkpoint)) as policy:
        ours = [
            policy.postprocess(policy.infer(policy.preprocess(Frame(1, each, prompt="pick up the cube"))))
            for each in observations
        ]
    for chunk, each in zip(ours, observations, strict=True):
        robot.values = each
        theirs = lerobots_chunk(robot_client, address, checkpoint)
        assert theirs.shape == (CHUNK, len(JOINTS))
        np.testing.assert_array_equal(chunk, theirs.astype(np.float64))
    assert np.abs(ours[0] - ours[1]).max() > 1e-4, "the network answers to what it sees"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": CHUNK + 1}, rf"shape \({CHUNK}, 6\), the robot YAML states \({CHUNK + 1}, 6\)"),
        ({"actions": (ActionMap(ARM),)}, rf"shape \({CHUNK}, 6\), the robot YAML states \({CHUNK}, 5\)"),
        ({"pretrained_name_or_path": "/nowhere/at/all"}, "the server's error: "),
        ({"policy_type": "nothing"}, "the server's error: .*nothing not supported"),
        ({"observations": (ObservationMap(STATE, (STATE,), (6,)),)}, "has no actions for the observation"),
        (
            {
                "observations": (
                    ObservationMap(STATE, (STATE,), (6,)),
                    ObservationMap(TOP, ("observation.images.other",), IMAGE),
                )
            },
            "has no actions for the observation",
        ),
    ],
)
def test_a_model_that_does_not_fit_is_an_error_before_anything_moves(
    address: str, checkpoint: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(PolicyError, match=message), loaded(options_of(address, checkpoint, **changes)):
        pass


def positions(out: Path, model: str) -> NDArray[np.float64]:
    """Positions of the simulated arm in each tick of an episode with a model, shape (T, J)."""
    mode = "control_modes.model_inference={executors: [arm_position, gripper_position], inference: {model: net}}"
    settings = (mode, f"models.net={model}", "contract.max_duration_s=1")
    sets = [word for each in settings for word in ("--set", each)]
    counts = ("--episodes", "1", "--seed", "3", "--jobs", "1", "--videos", "0", "--mode", "model_inference")
    command = (*ibrobot_command(), "eval", "so101", "--sim", *sets, *counts, "--out", str(out))
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    reader = installed_plugins().open_episode(out / "episodes/model_inference/seed_000003")
    states = [each.message.position for each in reader.messages(("/joint_states",))]  # type: ignore[attr-defined]
    reader.close()
    return np.array(states)


@pytest.mark.long  # the chunks are equal, see above; runs with servers: tests/integration/test_policy_servers.py
def test_the_simulated_robot_moves_as_with_the_model_in_its_own_process(address: str, tmp_path: Path) -> None:
    inputs = features(STATE, TOP)
    inputs["input_features"][TOP] = PolicyFeature(FeatureType.VISUAL, (3, 240, 320))
    joints = {"mean": np.array([0, -1.3, 1.2, 0.8, 0, 0.3], np.float32), "std": np.full(len(JOINTS), 0.3, np.float32)}
    colours = {"mean": np.full((3, 1, 1), 0.4, np.float32), "std": np.full((3, 1, 1), 0.2, np.float32)}
    path = save(act(**inputs, **EVERYWHERE), tmp_path / "act", {STATE: joints, "action": joints, TOP: colours})
    mapping = (
        f"observations: [{{observation: {STATE}, key: [{STATE}], shape: [6]}}, "
        f"{{observation: {TOP}, key: [{TOP}], shape: [240, 320, 3]}}], actions: [{{joints: [{', '.join(JOINTS)}]}}]"
    )
    served = positions(
        tmp_path / "served",
        f"{{type: lerobot_server, address: '{address}', policy_type: act, pretrained_name_or_path: {path}, {mapping}, "
        f"horizon: {CHUNK}, rate_hz: 30, prompt: [], timeout: {PATIENCE_S}}}",
    )
    here = positions(tmp_path / "here", f"{{type: lerobot, path: {path}, device: cpu, threads: 1}}")
    assert np.ptp(served, axis=0).max() > 0.1, "the arm did not move"
    np.testing.assert_array_equal(served, here)
