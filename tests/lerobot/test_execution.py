"""In this process, in a child, or on a server: the same actions as LeRobot alone, bit for bit."""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import override

import attrs
import numpy as np
import pytest
import torch
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import SEED, LeRobotPolicy
from ibrobot_serve.process import ProcessEngine
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService
from ibrobot_testing.contexts import START_NS, host_context
from ibrobot_testing.fakes import FakeTransport

from ibrobot_core.config import load_config
from ibrobot_core.inference.client import LocalEngine
from ibrobot_core.interfaces import Engine, Frame, Payload

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CONFIGS, EVERYWHERE, Theirs, save

pytestmark = pytest.mark.lerobot

PATIENCE_NS = 60_000_000_000
ROBOT = """\
robot:
  name: mini
  joints: [{{name: shoulder_pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}}]
  groups: {{arm: [shoulder_pan]}}
  description: {{mjcf: package://so101_nexus/assets/SO101_menagerie/so101.xml, poses: {{rest: [0.0]}}}}
simulation: {{type: mujoco}}
executors: {{arm_position: {{type: position, group: arm}}}}
models: {{net: {{type: lerobot, path: {path}, threads: 1, device: cpu}}}}
control_modes: {{idle: {{executors: [arm_position]}}}}
default_control_mode: idle
"""


@pytest.fixture(params=["act", pytest.param("diffusion", marks=pytest.mark.long)])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return save(CONFIGS[request.param](**EVERYWHERE), tmp_path / request.param)


class Counting(FakeTransport):
    """Knows the size of the last request."""

    size = 0

    @override
    def request(self, name: str, payload: Payload, timeout_s: float) -> Payload:
        self.size = len(payload)
        return super().request(name, payload, timeout_s)


def make(path: Path) -> LeRobotPolicy:
    return LeRobotPolicy(LeRobotPolicyOptions(path, threads=1, device="cpu"), host_context())


@pytest.fixture
def engines(path: Path, tmp_path: Path) -> Iterator[dict[str, Engine]]:
    """One of each, with weights of its own."""
    here, cloud, transport = make(path), make(path), FakeTransport()
    here.load()
    cloud.load()
    (tmp_path / "robot.yaml").write_text(textwrap.dedent(ROBOT.format(path=path)))
    service = InferenceService(cloud, transport, "net")
    service.start()
    made: dict[str, Engine] = {
        "monolithic": LocalEngine(here),
        "process": ProcessEngine(load_config(tmp_path / "robot.yaml", sim=True), "net", cloud.fingerprint()),
        "distributed": RemoteEngine(make(path), transport, "net", "mini"),
    }
    try:
        for engine in made.values():
            engine.start()
        yield made
    finally:
        for engine in made.values():
            engine.close()
        service.close()


def test_jpeg_costs_little_of_the_actions_and_most_of_the_bytes(tmp_path: Path) -> None:
    path, transport = save(CONFIGS["act"](), tmp_path / "act"), Counting()
    cloud, edge = make(path), make(path)
    cloud.load()
    service = InferenceService(cloud, transport, "net", codec=cloud.picture_codec())
    service.start()
    values = {
        key: (np.indices(shape).sum(0) * 3 % 200).astype(np.uint8 if len(shape) == 3 else np.float32)
        for key, shape in edge.spec.observations.items()
    }
    tensors = edge.preprocess(Frame(START_NS, values))
    actions, sizes = [], []
    for codec in (None, edge.picture_codec(80)):
        engine = RemoteEngine(edge, transport, "net", "mini", codec=codec)
        engine.start()
        actions.append(edge.postprocess(engine.infer(tensors, 1, time.monotonic_ns() + PATIENCE_NS)))
        sizes.append(transport.size)
        engine.close()
    service.close()
    transport.close()
    assert sizes[1] < sizes[0] / 3
    assert 0 < np.abs(actions[0] - actions[1]).max() < 0.1


def test_every_execution_mode_acts_as_lerobot_alone(path: Path, engines: dict[str, Engine]) -> None:
    torch.set_num_threads(1)
    theirs, edge = Theirs(path), make(path)
    edge.reset(11)
    rng = np.random.default_rng(2)
    past: list[Frame] = []
    selected = []
    for i in range(edge.spec.chunk_size):
        values = {
            key: rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.normal(size=shape).astype(np.float32)
            for key, shape in edge.spec.observations.items()
        }
        past.append(Frame(START_NS + i, values))
        if i == 0:
            tensors = edge.preprocess(attrs.evolve(past[0]))
        selected.append(theirs.select(values, int(tensors[SEED][0])))
    wanted = np.stack(selected).astype(np.float64)
    for mode, engine in engines.items():
        outputs = engine.infer(tensors, 1, time.monotonic_ns() + PATIENCE_NS)
        np.testing.assert_array_equal(edge.postprocess(outputs), wanted, err_msg=mode)
