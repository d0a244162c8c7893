"""Policy `lerobot_server` against a server that answers, fails, hangs, lies and restarts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from typing import Any, override

import attrs
import numpy as np
import pytest

pytest.importorskip("grpc", reason="an extra of this package")
from ibrobot_policy_servers import ibrobot_policies
from ibrobot_policy_servers.lerobot_server import LerobotConnection
from ibrobot_policy_servers.options import ActionMap, LerobotServerOptions, ObservationMap
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_testing import PolicySuite, check_descriptor, host_context
from ibrobot_testing.contexts import ARM, GRIPPER

from ibrobot_core.api import Context, MissingDependency, Policy, PolicyError

from .lerobot_server import LerobotServer, Message, answered, chunk_of, grpc_in_use, ramp, storage, tensor
from .served_requests import (
    CAMERA,
    HORIZON,
    IMAGE,
    POSITIONS,
    SIZE,
    STATE,
    Damage,
    chunk,
    error_when_closed,
    expected,
    frame,
    in_time,
    refused,
)

STATE_MAP = ObservationMap(STATE, (STATE,), (SIZE,))
CAMERA_MAP = ObservationMap(CAMERA, ("observation.images.front",), IMAGE)
OPTIONS = LerobotServerOptions(
    policy_type="act",
    pretrained_name_or_path="checkpoints/act",
    observations=(STATE_MAP, CAMERA_MAP),
    actions=(ActionMap(ARM + GRIPPER),),
    horizon=HORIZON,
    rate_hz=30.0,
    timeout=30.0,
    start_timeout=30.0,
)


def make(options: LerobotServerOptions, ctx: Context | None = None) -> ServedPolicy:
    return ServedPolicy(options, ctx or host_context(), LerobotConnection(options))


@pytest.fixture(scope="module", autouse=True)
def grpc_kept() -> Iterator[None]:
    with grpc_in_use():
        yield


@pytest.fixture
def server() -> Iterator[LerobotServer]:
    with LerobotServer() as server:
        yield server


@pytest.fixture
def options(server: LerobotServer) -> LerobotServerOptions:
    return attrs.evolve(OPTIONS, address=server.address)


@pytest.fixture
def policy(options: LerobotServerOptions) -> Iterator[ServedPolicy]:
    policy = make(options)
    policy.load()
    yield policy
    policy.close()


class TestLerobotServer(PolicySuite):
    @pytest.fixture(autouse=True)
    def server(self, no_leaks: None) -> Iterator[None]:
        with LerobotServer() as server:
            self.options = attrs.evolve(OPTIONS, address=server.address)
            yield

    @override
    def make(self, ctx: Context) -> Policy:
        return make(self.options, ctx)


def test_descriptor_is_right(options: LerobotServerOptions) -> None:
    [descriptor] = [each for each in ibrobot_policies() if each.type == "lerobot_server"]
    check_descriptor(descriptor, options)


def test_instructions_observations_and_actions_are_lerobots(policy: ServedPolicy, server: LerobotServer) -> None:
    np.testing.assert_allclose(chunk(policy, frame(40)), expected(40), atol=1e-6)
    [told] = server.instructions
    names = [f"observation.state.{i}" for i in range(SIZE)]
    assert type(told).__name__ == "RemotePolicyConfig"
    assert vars(told) == {
        "policy_type": "act",
        "pretrained_name_or_path": "checkpoints/act",
        "lerobot_features": {
            STATE: {"dtype": "float32", "shape": (SIZE,), "names": names},
            "observation.images.front": {"dtype": "image", "shape": IMAGE, "names": ["height", "width", "channels"]},
        },
        "actions_per_chunk": HORIZON,
        "device": "cpu",
        "rename_map": {},
    }
    seen = server.observations[-1]
    assert type(seen).__name__ == "TimedObservation"
    assert seen.must_go
    assert seen.observation.keys() == {*names, "front", "task"}
    assert [seen.observation[name] for name in names] == POSITIONS.tolist()
    np.testing.assert_array_equal(seen.observation["front"], np.full(IMAGE, 40, np.uint8))
    assert seen.observation["task"] == "pick up the cube"
    assert [each.timestep for each in server.observations] == [1, 2]
    assert "checkpoints/act" in policy.identity()


def test_a_large_observation_travels_in_pieces(server: LerobotServer, options: LerobotServerOptions) -> None:
    shape = (1100, 2000, 3)
    policy = make(attrs.evolve(options, observations=(STATE_MAP, attrs.evolve(CAMERA_MAP, shape=shape)), prompt=()))
    policy.load()
    policy.close()
    assert server.observations[-1].observation["front"].shape == shape
    assert "task" not in server.observations[-1].observation


@pytest.mark.parametrize(
    ("kind", "dtype"), [("FloatStorage", np.float32), ("DoubleStorage", np.float64), ("HalfStorage", np.float16)]
)
def test_floats_of_all_sizes_arrive_bit_for_bit(
    policy: ServedPolicy, server: LerobotServer, kind: str, dtype: Any
) -> None:
    actions = np.random.default_rng(3).normal(size=(HORIZON, SIZE)).astype(dtype)
    server.answer = lambda seen: answered(seen, actions, kind)
    np.testing.assert_array_equal(chunk(policy), actions.astype(np.float64))


def test_bfloat16_arrives_bit_for_bit(policy: ServedPolicy, server: LerobotServer) -> None:
    actions = np.random.default_rng(3).normal(size=(HORIZON, SIZE)).astype(np.float32)
    halves = (actions.view(np.uint32) >> 16).astype(np.uint16)
    server.answer = lambda seen: answered(seen, halves, "BFloat16Storage")
    np.testing.assert_array_equal(chunk(policy), (halves.astype(np.uint32) << 16).view(np.float32).astype(np.float64))


def test_actions_with_a_stride_are_read(policy: ServedPolicy, server: LerobotServer) -> None:
    actions = np.arange(HORIZON * SIZE, dtype=np.float32).reshape(SIZE, HORIZON)
    file = storage(actions)
    tensors = [tensor(file, i, (SIZE,), (HORIZON,)) for i in range(HORIZON)]
    server.answer = lambda seen: chunk_of(seen.timestamp, seen.timestep, tensors)
    np.testing.assert_array_equal(chunk(policy), actions.T)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": (attrs.evolve(STATE_MAP, key=("state",)), CAMERA_MAP)}, r"key \['state'\] is not one of"),
        ({"observations": (STATE_MAP, attrs.evolve(CAMERA_MAP, key=("images", "front")))}, r"'images', 'front'"),
        ({"observations": (STATE_MAP, attrs.evolve(CAMERA_MAP, key=("observation.images.task",)))}, "images.task"),
        ({"observations": (STATE_MAP, attrs.evolve(CAMERA_MAP, layout="chw"))}, "in layout hwc"),
        ({"observations": (CAMERA_MAP,)}, r"needs one with the key \[observation.state\]"),
        ({"prompt": ("prompt",)}, r"expects it in \[task\], not in \['prompt'\]"),
    ],
)
def test_a_mapping_that_the_server_does_not_know_is_an_error(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        make(attrs.evolve(OPTIONS, **changes))


def test_a_robot_without_grpcio_names_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    [descriptor] = [each for each in ibrobot_policies() if each.type == "lerobot_server"]
    monkeypatch.setitem(sys.modules, "grpc", None)
    monkeypatch.delitem(sys.modules, "ibrobot_policy_servers.lerobot_server")
    with pytest.raises(MissingDependency, match=r"needs the Python package grpcio; pip install .*\[grpc\]"):
        descriptor.make(OPTIONS, host_context())


def test_an_address_without_a_port_is_an_error() -> None:
    with pytest.raises(ValueError, match="must be HOST:PORT"):
        attrs.evolve(OPTIONS, address="localhost")


def other_time(seen: Message) -> bytes:
    seen.timestamp += 1e-6
    return ramp(seen)


def other_number(seen: Message) -> bytes:
    seen.timestep -= 1
    return ramp(seen)


def ragged(seen: Message) -> bytes:
    file = storage(np.zeros(9, np.float32))
    return chunk_of(seen.timestamp, seen.timestep, [tensor(file, 0, (size,), (1,)) for size in (6, 5, 6, 6, 6)])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda seen: b"", "has no actions for the observation; its log has the reason"),
        (lambda seen: answered(seen, np.zeros((9, SIZE), np.float32)), r"shape \(9, 6\), the robot YAML states \(5, 6"),
        (lambda seen: answered(seen, np.zeros((HORIZON, 7), np.float32)), r"shape \(5, 7\)"),
        (lambda seen: answered(seen, np.full((HORIZON, SIZE), np.nan, np.float32)), "not finite"),
        (other_time, "action 0 of the answer is not the one of request .*: another client uses the server"),
        (other_number, "action 0 of the answer is not the one of request"),
        (ragged, "different sizes"),
        (lambda seen: b"\x80\x04cos\nsystem\n(X\x01\x00\x00\x00:tR.", "names 'os.system', which is not of this protoc"),
    ],
)
def test_a_wrong_answer_is_an_error_before_anything_moves_and_later(
    server: LerobotServer, options: LerobotServerOptions, answer: Any, message: str
) -> None:
    server.answer = answer
    wrong = make(options)
    with pytest.raises(PolicyError, match=message):
        wrong.load()
    wrong.close()
    server.answer = ramp
    policy = make(options)
    policy.load()
    server.answer = answer
    with pytest.raises(PolicyError, match=message):
        chunk(policy, frame())
    server.answer = ramp
    np.testing.assert_allclose(chunk(policy, frame(3)), expected(3), atol=1e-6)
    policy.close()


def test_a_checkpoint_that_the_server_does_not_load_is_an_error(
    server: LerobotServer, options: LerobotServerOptions
) -> None:
    server.refusal = "Policy type nothing not supported"
    policy = make(options)
    with pytest.raises(PolicyError, match=f"{server.address}: the server's error: .*nothing not supported"):
        policy.load()
    policy.close()


@pytest.mark.parametrize("method", ["Ready", "SendPolicyInstructions", "SendObservations", "GetActions"])
def test_a_call_that_ends_without_an_answer_is_an_error(
    server: LerobotServer, options: LerobotServerOptions, method: str
) -> None:
    server.stop()
    server.silent = method
    server.start()
    policy = make(options)
    with pytest.raises(PolicyError, match=f"{server.address}: the server ended {method} without an answer"):
        policy.load()
    policy.close()


def test_a_late_answer_reaches_no_later_request(options: LerobotServerOptions, server: LerobotServer) -> None:
    policy = make(attrs.evolve(options, timeout=0.2))
    policy.load()
    late = threading.Event()

    def slow(seen: Message) -> bytes:
        if seen.observation["front"].max() == 1:
            late.wait()
        return ramp(seen)

    server.answer = slow
    with pytest.raises(PolicyError, match=r"no answer within 0\.2 s"):
        chunk(policy, frame(1))
    late.set()
    for level in (2, 3):
        np.testing.assert_allclose(in_time(policy, frame(level)), expected(level), atol=1e-6)
    policy.close()


def test_a_server_that_was_killed_loads_its_model_again(options: LerobotServerOptions, server: LerobotServer) -> None:
    policy = make(attrs.evolve(options, start_timeout=3000.0))
    policy.load()
    server.stop()
    with pytest.raises(PolicyError, match=f"{server.address}: no LeRobot policy server, or it closed"):
        chunk(policy, frame())
    server.start()
    np.testing.assert_allclose(chunk(policy, frame(9)), expected(9), atol=1e-6)
    policy.close()
    assert len(server.instructions) == 2
    assert min(server.patience_s) > 2 * options.timeout, "loading may take longer than a request"


def test_no_server_is_an_error() -> None:
    with LerobotServer() as gone:
        pass
    policy = make(attrs.evolve(OPTIONS, address=gone.address))
    with pytest.raises(PolicyError, match=f"{gone.address}: no LeRobot policy server"):
        policy.load()
    policy.close()


def test_close_ends_a_request(options: LerobotServerOptions, server: LerobotServer) -> None:
    policy = make(attrs.evolve(options, timeout=60.0))
    policy.load()
    assert error_when_closed(policy, server) == f"{server.address}: was closed"


def test_damaged_answers_are_errors_and_the_next_answer_is_right(policy: ServedPolicy, server: LerobotServer) -> None:
    """1,000 answers with flipped or cut bytes: each is refused or has the shape, finite, of an answer."""
    damage = Damage()
    server.answer = lambda seen: damage(ramp(seen))
    assert refused(policy, 1000) > 300
    server.answer = ramp
    np.testing.assert_allclose(chunk(policy, frame(200)), expected(200), atol=1e-6)
