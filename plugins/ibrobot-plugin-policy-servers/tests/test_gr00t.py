"""Policy `gr00t` against a server that answers, fails, hangs, lies and restarts."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, override

import attrs
import msgpack
import numpy as np
import pytest
from ibrobot_policy_servers import ibrobot_policies
from ibrobot_policy_servers.gr00t import Gr00tConnection
from ibrobot_policy_servers.options import ActionMap, Gr00tOptions, ObservationMap
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_policy_wire import pack_npy, unpack_npy
from ibrobot_testing import PolicySuite, check_descriptor, host_context
from ibrobot_testing.contexts import ARM, GRIPPER

from ibrobot_core.api import Context, Policy, PolicyError

from .gr00t_server import Gr00tServer, ramp
from .served_requests import (
    CAMERA,
    HORIZON,
    IMAGE,
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

OPTIONS = Gr00tOptions(
    observations=(
        ObservationMap(STATE, ("state", "joints"), (SIZE,), joints=ARM + GRIPPER),
        ObservationMap(CAMERA, ("video", "front"), IMAGE),
    ),
    actions=(ActionMap(ARM, ("single_arm",)), ActionMap(GRIPPER, ("gripper",))),
    prompt=("language", "annotation.human.task_description"),
    horizon=HORIZON,
    rate_hz=30.0,
    timeout=30.0,
    start_timeout=30.0,
)


def make(options: Gr00tOptions) -> ServedPolicy:
    return ServedPolicy(options, host_context(), Gr00tConnection(options))


@pytest.fixture
def server() -> Iterator[Gr00tServer]:
    with Gr00tServer() as server:
        yield server


@pytest.fixture
def options(server: Gr00tServer) -> Gr00tOptions:
    return attrs.evolve(OPTIONS, address=server.address)


@pytest.fixture
def policy(options: Gr00tOptions) -> Iterator[ServedPolicy]:
    policy = make(options)
    policy.load()
    yield policy
    policy.close()


class TestGr00t(PolicySuite):
    @pytest.fixture(autouse=True)
    def server(self, no_leaks: None) -> Iterator[None]:
        with Gr00tServer() as server:
            self.options = attrs.evolve(OPTIONS, address=server.address)
            yield

    @override
    def make(self, ctx: Context) -> Policy:
        return ServedPolicy(self.options, ctx, Gr00tConnection(self.options))


def test_descriptor_is_right(options: Gr00tOptions) -> None:
    [descriptor] = [each for each in ibrobot_policies() if each.type == "gr00t"]
    check_descriptor(descriptor, options)


def test_request_and_actions_are_those_of_version_1_6(policy: ServedPolicy, server: Gr00tServer) -> None:
    np.testing.assert_allclose(chunk(policy, frame(40)), expected(40), atol=1e-6)
    seen = server.requests[-1]["data"]["observation"]
    assert seen["video"]["front"].shape == (1, 1, *IMAGE)
    assert seen["state"]["joints"].shape == (1, 1, SIZE)
    assert seen["state"]["joints"].dtype == np.float32
    assert seen["language"] == {"annotation.human.task_description": [["pick up the cube"]]}


def test_a_text_with_a_key_of_its_own_is_a_list_in_version_1_6(server: Gr00tServer, options: Gr00tOptions) -> None:
    policy = make(attrs.evolve(options, prompt=("annotation.human.task_description",)))
    policy.load()
    try:
        chunk(policy, frame(40))
    finally:
        policy.close()
    seen = server.requests[-1]["data"]["observation"]
    assert seen["annotation.human.task_description"] == ["pick up the cube"]
    assert seen["state"]["joints"].shape == (1, 1, SIZE)


def test_request_and_actions_are_those_of_version_1_5(server: Gr00tServer, options: Gr00tOptions) -> None:
    flat = attrs.evolve(
        options,
        version="1.5",
        observations=(
            ObservationMap(STATE, ("state.single_arm",), (SIZE,)),
            ObservationMap(CAMERA, ("video.front",), IMAGE),
        ),
        actions=(ActionMap(ARM, ("action.single_arm",)), ActionMap(GRIPPER, ("action.gripper",))),
        prompt=("annotation.human.task_description",),
    )
    arm = np.tile(np.arange(5.0), (HORIZON, 1))
    server.answer = lambda data: {"action.single_arm": arm, "action.gripper": arm[:, :1]}
    policy = make(flat)
    policy.load()
    policy.reset(1)
    np.testing.assert_array_equal(chunk(policy, frame())[0], [0, 1, 2, 3, 4, 0])
    policy.close()
    data = server.requests[-1]["data"]
    assert data["video.front"].shape == (1, *IMAGE)
    assert data["annotation.human.task_description"] == ["pick up the cube"]
    assert "reset" not in {each["endpoint"] for each in server.requests}


def test_an_episode_resets_the_server(policy: ServedPolicy, server: Gr00tServer) -> None:
    policy.reset(3)
    assert server.requests[-1]["endpoint"] == "reset"


def test_the_token_is_sent_and_a_wrong_one_is_an_error(server: Gr00tServer, options: Gr00tOptions) -> None:
    server.token = "pa55word"
    allowed = make(attrs.evolve(options, api_token="pa55word"))
    allowed.load()
    allowed.close()
    other = make(options)
    with pytest.raises(PolicyError, match="the server's error: Unauthorized"):
        other.load()
    other.close()


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ([{"single_arm": np.zeros((1, HORIZON, 5))}, {}], "no numbers under 'gripper'; it has: single_arm"),
        ([{"single_arm": np.zeros((1, 9, 5)), "gripper": np.zeros((1, 9, 1))}, {}], r"shape \(9, 5\)"),
        ([{"single_arm": np.full((1, HORIZON, 5), np.nan), "gripper": np.zeros((1, HORIZON, 1))}, {}], "not finite"),
        ({"error": "CUDA out of memory"}, "the server's error: CUDA out of memory"),
        ([], "answered with list"),
        (b"ERROR", "cannot be read"),
    ],
)
def test_a_wrong_answer_is_an_error_before_anything_moves_and_later(
    server: Gr00tServer, options: Gr00tOptions, answer: Any, message: str
) -> None:
    server.answer = lambda data: answer
    wrong = make(options)
    with pytest.raises(PolicyError, match=message):
        wrong.load()
    wrong.close()
    server.answer = ramp
    policy = make(options)
    policy.load()
    server.answer = lambda data: answer
    with pytest.raises(PolicyError, match=message):
        chunk(policy, frame())
    server.answer = ramp
    np.testing.assert_allclose(chunk(policy, frame(3)), expected(3), atol=1e-6)
    policy.close()


def test_a_late_answer_reaches_no_later_request(options: Gr00tOptions, server: Gr00tServer) -> None:
    policy = make(attrs.evolve(options, timeout=0.2))
    policy.load()
    late = threading.Event()

    def slow(data: dict[str, Any]) -> Any:
        if data["observation"]["video"]["front"].max() == 1:
            late.wait()
        return ramp(data)

    server.answer = slow
    with pytest.raises(PolicyError, match=r"no answer within 0\.2 s"):
        chunk(policy, frame(1))
    late.set()
    for level in (2, 3):
        np.testing.assert_allclose(in_time(policy, frame(level)), expected(level), atol=1e-6)
    policy.close()


def test_a_server_that_is_killed_is_used_again_unless_it_has_another_model(
    options: Gr00tOptions, server: Gr00tServer
) -> None:
    policy = make(options)
    policy.load()
    server.stop()
    with pytest.raises(PolicyError, match=f"{server.address}: .*closed the connection"):
        chunk(policy, frame())
    server.start()
    np.testing.assert_allclose(chunk(policy, frame(9)), expected(9), atol=1e-6)
    server.stop()
    server.description = {"action": {"modality_keys": ["other"]}}
    server.start()
    with pytest.raises(PolicyError, match=server.address):
        chunk(policy, frame())
    for _ in range(2):
        with pytest.raises(PolicyError, match=r"restarted with another model.*other.*previously.*single_arm"):
            chunk(policy, frame())
    policy.close()


def test_no_server_is_an_error() -> None:
    with Gr00tServer() as gone:
        pass
    policy = make(attrs.evolve(OPTIONS, address=gone.address))
    with pytest.raises(PolicyError, match=f"{gone.address}: no GR00T server"):
        policy.load()
    policy.close()


def test_close_ends_a_request(options: Gr00tOptions, server: Gr00tServer) -> None:
    policy = make(attrs.evolve(options, timeout=60.0))
    policy.load()
    assert error_when_closed(policy, server) == f"{server.address}: was closed"


def test_damaged_answers_are_errors_and_the_next_answer_is_right(policy: ServedPolicy, server: Gr00tServer) -> None:
    """1,000 answers with flipped, cut or repeated bytes: each is refused or has the shape, finite, of an answer."""
    damage = Damage()
    zeros = {"state": {"joints": np.zeros((1, 1, SIZE), np.float32)}, "video": {"front": np.zeros((1, 1, *IMAGE))}}
    good = pack_npy(ramp({"observation": zeros}))

    def answer(data: dict[str, Any]) -> Any:
        return ramp(data) if data["observation"]["video"]["front"].max() == 200 else damage(good)

    server.answer, count = answer, 0
    for _ in range(10):
        count += refused(policy, 100)
        np.testing.assert_allclose(chunk(policy, frame(200)), expected(200), atol=1e-6)
    assert count > 300


def test_arrays_survive() -> None:
    for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3)), np.array(3, np.uint8)):
        np.testing.assert_array_equal(unpack_npy(pack_npy({"a": array}))["a"], array)


def test_pickles_and_lying_headers_are_refused() -> None:
    def message(content: bytes) -> bytes:
        return bytes(msgpack.packb({"__ndarray_class__": True, "as_npy": content}))

    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776,), }"
    pickled = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
    for text in (header, pickled):
        content = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + b"cos\nsystem\n"
        with pytest.raises(PolicyError, match="cannot be read"):
            unpack_npy(message(content))
