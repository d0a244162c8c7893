"""Policy `openpi` against a server that answers, fails, hangs, lies and restarts."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any, override

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_policy_servers import ibrobot_policies
from ibrobot_policy_servers.openpi import OpenpiConnection
from ibrobot_policy_servers.options import ActionMap, ObservationMap, OpenpiOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_policy_wire import pack
from ibrobot_testing import PolicySuite, check_descriptor, host_context
from ibrobot_testing.contexts import ARM, GRIPPER
from openpi_server import OpenpiServer, ramp

from ibrobot_core.api import Context, Policy, PolicyError

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

JOINTS = ARM + GRIPPER
OPTIONS = OpenpiOptions(
    observations=(
        ObservationMap(STATE, ("observation/state",), (SIZE,), joints=JOINTS),
        ObservationMap(CAMERA, ("observation/image",), IMAGE),
    ),
    actions=(ActionMap(JOINTS),),
    horizon=HORIZON,
    rate_hz=15.0,
    timeout=30.0,
    start_timeout=30.0,
)


def make(options: OpenpiOptions) -> ServedPolicy:
    ctx = host_context()
    return ServedPolicy(options, ctx, OpenpiConnection(options, ctx.log))


@pytest.fixture
def server() -> Iterator[OpenpiServer]:
    with OpenpiServer() as server:
        yield server


@pytest.fixture
def options(server: OpenpiServer) -> OpenpiOptions:
    return attrs.evolve(OPTIONS, url=server.url)


@pytest.fixture
def policy(options: OpenpiOptions) -> Iterator[ServedPolicy]:
    policy = make(options)
    policy.load()
    yield policy
    policy.close()


class TestOpenpi(PolicySuite):
    @pytest.fixture(autouse=True)
    def server(self, no_leaks: None) -> Iterator[None]:
        with OpenpiServer() as server:
            self.options = attrs.evolve(OPTIONS, url=server.url)
            yield

    @override
    def make(self, ctx: Context) -> Policy:
        return ServedPolicy(self.options, ctx, OpenpiConnection(self.options, ctx.log))


def test_descriptor_is_right(options: OpenpiOptions) -> None:
    [descriptor] = [each for each in ibrobot_policies() if each.type == "openpi"]
    check_descriptor(descriptor, options)


def test_request_and_actions_are_those_of_the_mapping(policy: ServedPolicy, server: OpenpiServer) -> None:
    np.testing.assert_allclose(chunk(policy, frame(40)), expected(40), atol=1e-6)
    request = server.requests[-1]
    assert request.keys() == {"observation/state", "observation/image", "prompt"}
    assert request["prompt"] == "pick up the cube"
    assert request["observation/image"].shape == IMAGE
    assert policy.spec.rate_hz == 15.0


def test_nested_keys_layout_and_units(server: OpenpiServer, options: OpenpiOptions) -> None:
    mapped = attrs.evolve(
        options,
        observations=(
            ObservationMap(STATE, ("state",), (SIZE,), joints=JOINTS, scale=(2.0,) * SIZE, offset=(1.0,) * SIZE),
            ObservationMap(CAMERA, ("images", "cam_high"), IMAGE, layout="chw"),
        ),
        actions=(
            ActionMap(GRIPPER, ("gripper",), scale=(0.5,), offset=(0.25,)),
            ActionMap(ARM[::-1], ("arm",), size=8, relative=ARM),
        ),
        prompt=(),
    )
    arm = np.tile(np.arange(8, dtype=np.float64), (HORIZON, 1))
    server.answer = lambda request: {"gripper": np.full((HORIZON, 1), 3.0), "arm": arm}
    policy = make(mapped)
    policy.load()
    actions = chunk(policy, frame(prompt=""))
    policy.close()
    request = server.requests[-1]
    assert request["images"]["cam_high"].shape == (3, 8, 10)
    state = np.linspace(-0.5, 0.5, SIZE, dtype=np.float32)
    np.testing.assert_allclose(request["state"], 2 * state + 1, atol=1e-6)
    np.testing.assert_allclose(actions[0], [*(state[:5] + np.arange(5)[::-1]), 0.5 * 3 + 0.25], atol=1e-6)


KEYS = st.lists(st.sampled_from(("a", "b")), min_size=1, max_size=3).map(tuple)


@settings(max_examples=300, deadline=None)
@given(st.lists(KEYS, min_size=1, max_size=3), st.just(()) | KEYS, st.lists(KEYS, min_size=1, max_size=2))
def test_no_value_of_a_mapping_overwrites_another(
    observations: list[tuple[str, ...]], prompt: tuple[str, ...], actions: list[tuple[str, ...]]
) -> None:
    """300 mappings: every value of an accepted one stands in the request, and every answer is a vector of its own."""
    mapped = tuple(ObservationMap(f"observation.{i}", key, (1,)) for i, key in enumerate(observations))
    moved = tuple(ActionMap((JOINTS[i],), key) for i, key in enumerate(actions))
    sent = [*observations, *([prompt] if prompt else [])]
    clash = any(
        one[: len(other)] == other
        for keys in (sent, actions)
        for i, one in enumerate(keys)
        for j, other in enumerate(keys)
        if i != j
    )
    options = attrs.evolve(OPTIONS, observations=mapped, prompt=prompt, actions=moved)
    if clash:
        with pytest.raises(PolicyError, match=r"have (the same key|keys inside one another) of the (request|answer)"):
            make(options)
    else:
        make(options)


def test_observation_cannot_be_sent_twice() -> None:
    twice = (ObservationMap(STATE, ("a",), (SIZE,)), ObservationMap(STATE, ("b",), (SIZE,)))
    with pytest.raises(PolicyError, match=r"observations: observation.state stands twice"):
        make(attrs.evolve(OPTIONS, observations=twice))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": (ActionMap(("elbow_flx",)),)}, "the robot has no joint 'elbow_flx', did you mean 'elbow_flex'"),
        ({"actions": (ActionMap(ARM), ActionMap(ARM[:1]))}, "shoulder_pan stand twice"),
        ({"actions": (ActionMap(ARM, relative=GRIPPER),)}, "relative names gripper"),
        ({"actions": (ActionMap(JOINTS, size=3),)}, "size is 3, must be at least that of joints, 6"),
        ({"actions": (ActionMap(JOINTS, scale=(1.0,)),)}, "scale has 1 numbers, must have 6"),
        (
            {"actions": (ActionMap(JOINTS, relative=ARM),), "observations": OPTIONS.observations[1:]},
            "no observation names these joints",
        ),
        ({"observations": (ObservationMap(STATE, ("s",), (2,), joints=JOINTS),)}, r"has shape \[2\], must be \[6\]"),
    ],
)
def test_a_mapping_that_does_not_fit_the_robot_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        make(attrs.evolve(OPTIONS, **changes))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"actions": np.zeros((HORIZON + 1, SIZE))}, r"shape \(6, 6\), the robot YAML states \(5, 6\): horizon"),
        ({"actions": np.zeros((HORIZON, SIZE + 1))}, r"shape \(5, 7\)"),
        ({"actions": np.zeros(SIZE)}, r"shape \(6,\)"),
        ({"actions": np.full((HORIZON, SIZE), np.nan)}, "not finite"),
        ({"actions": np.full((HORIZON, SIZE), np.inf)}, "not finite"),
        ({"actions": [[0.0] * SIZE] * HORIZON}, "no numbers under 'actions'; it has: actions"),
        ({"action": np.zeros((HORIZON, SIZE))}, "no numbers under 'actions'; it has: action"),
        ({"actions": np.zeros((HORIZON, SIZE), bool)}, "no numbers"),
        ("Traceback (most recent call last):\n KeyError: 'x'", "the server's error: .*KeyError: 'x'"),
        (b"\xc1", "cannot be read"),
        (pack([1, 2]), "sent list, must be a dictionary"),
    ],
)
def test_a_wrong_answer_is_an_error_before_anything_moves_and_later(
    server: OpenpiServer, options: OpenpiOptions, answer: Any, message: str
) -> None:
    server.answer = lambda request: answer
    wrong = make(options)
    with pytest.raises(PolicyError, match=message):
        wrong.load()
    wrong.close()
    server.answer = ramp
    policy = make(options)
    policy.load()
    server.answer = lambda request: answer
    with pytest.raises(PolicyError, match=message):
        chunk(policy, frame())
    server.answer = ramp
    np.testing.assert_allclose(chunk(policy, frame(3)), expected(3), atol=1e-6)
    policy.close()


@pytest.mark.parametrize(
    ("metadata", "message"), [(b"\xc1", "cannot be read"), ("sorry", "error: sorry"), (b"\x01", "int")]
)
def test_wrong_metadata_is_an_error(metadata: Any, message: str) -> None:
    with OpenpiServer(metadata=metadata) as server:
        policy = make(attrs.evolve(OPTIONS, url=server.url))
        with pytest.raises(PolicyError, match=message):
            policy.load()
        policy.close()


def test_metadata_is_compared_with_what_the_robot_expects(options: OpenpiOptions) -> None:
    policy = make(attrs.evolve(options, expect=("config=pi05_droid", "x=1")))
    with pytest.raises(PolicyError, match=r"config\n +server: pi05_test\n +robot: pi05_droid\n +x\n +server: nothing"):
        policy.load()
    policy.close()
    fits = make(attrs.evolve(options, expect=("config=pi05_test",)))
    fits.load()
    fits.close()


def test_no_server_is_an_error() -> None:
    with OpenpiServer() as gone:
        pass
    policy = make(attrs.evolve(OPTIONS, url=gone.url))
    with pytest.raises(PolicyError, match=f"{gone.url}: no openpi server"):
        policy.load()


def test_a_late_answer_reaches_no_later_request(options: OpenpiOptions, server: OpenpiServer) -> None:
    policy = make(attrs.evolve(options, timeout=0.2))
    policy.load()
    late, answered = threading.Event(), threading.Event()

    def slow(request: dict[str, Any]) -> dict[str, Any]:
        if request["observation/image"].max() == 1:
            late.wait()
            answered.set()
        return ramp(request)

    server.answer = slow
    with pytest.raises(PolicyError, match=r"no answer within 0\.2 s"):
        chunk(policy, frame(1))
    late.set()
    answered.wait()
    for level in (2, 3):
        np.testing.assert_allclose(in_time(policy, frame(level)), expected(level), atol=1e-6)
    policy.close()


def test_a_server_that_is_killed_is_used_again(policy: ServedPolicy, server: OpenpiServer) -> None:
    server.stop()
    for _ in range(2):
        with pytest.raises(PolicyError, match=server.url):
            chunk(policy, frame())
    server.start()
    np.testing.assert_allclose(chunk(policy, frame(9)), expected(9), atol=1e-6)


def test_another_model_after_a_restart_is_refused(
    policy: ServedPolicy, server: OpenpiServer, options: OpenpiOptions, caplog: pytest.LogCaptureFixture
) -> None:
    lenient = make(attrs.evolve(options, accept_new_model=True))
    lenient.load()
    weights = policy.weights()
    server.stop()
    server.metadata = {"config": "pi05_other"}
    server.start()
    with pytest.raises(PolicyError, match="the connection ended"):
        chunk(policy, frame())
    for _ in range(2):
        with pytest.raises(PolicyError, match=r"restarted with another model.*pi05_other.*previously.*pi05_test"):
            chunk(policy, frame())
    assert policy.weights() == weights
    with pytest.raises(PolicyError, match="the connection ended"):
        chunk(lenient, frame())
    with caplog.at_level(logging.WARNING):
        chunk(lenient, frame())
    assert "pi05_other" in caplog.text
    assert lenient.weights() != weights
    lenient.close()
    server.stop()
    server.metadata = {"config": "pi05_test"}
    server.start()
    np.testing.assert_allclose(chunk(policy, frame(9)), expected(9), atol=1e-6)


def test_close_ends_a_request(options: OpenpiOptions, server: OpenpiServer) -> None:
    policy = make(attrs.evolve(options, timeout=60.0))
    policy.load()
    assert error_when_closed(policy, server)


def test_the_key_is_sent_and_not_shown(
    server: OpenpiServer, options: OpenpiOptions, caplog: pytest.LogCaptureFixture
) -> None:
    secret = attrs.evolve(options, api_key="pa55word")
    policy = make(secret)
    policy.load()
    policy.close()
    assert server.headers == ["Api-Key pa55word"]
    assert "pa55word" not in repr(secret) + caplog.text
    make(attrs.evolve(secret, url="ws://192.0.2.1:8000"))
    assert "the API key is sent without encryption" in caplog.text


def test_a_request_from_another_machine_is_checked(policy: ServedPolicy) -> None:
    tensors = dict(policy.preprocess(frame()))
    for wrong in ({STATE: np.zeros(3, np.float32)}, {CAMERA: np.zeros(IMAGE, np.float32)}, {"task": np.zeros(2)}):
        with pytest.raises(PolicyError, match="the request's tensors"):
            policy.infer({**tensors, **wrong})
    del tensors[STATE]
    with pytest.raises(PolicyError, match=f"{STATE} is missing"):
        policy.infer(tensors)


def test_a_prompt_is_needed(policy: ServedPolicy) -> None:
    with pytest.raises(PolicyError, match="needs a prompt"):
        policy.preprocess(frame(prompt=""))


def test_damaged_answers_are_errors_and_the_next_answer_is_right(policy: ServedPolicy, server: OpenpiServer) -> None:
    """1,000 answers with flipped, cut or repeated bytes: each is refused or has the shape, finite, of an answer."""
    damage = Damage()
    good = pack(ramp({"observation/state": np.zeros(SIZE, np.float32), "observation/image": np.zeros(IMAGE, np.uint8)}))

    def answer(request: dict[str, Any]) -> bytes | dict[str, Any]:
        return ramp(request) if request["observation/image"].max() == 200 else damage(good)

    server.answer, count = answer, 0
    for _ in range(10):
        count += refused(policy, 100)
        np.testing.assert_allclose(chunk(policy, frame(200)), expected(200), atol=1e-6)
    assert count > 300
