"""Policy `vla_eval` against a server of its protocol."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self, override

import attrs
import numpy as np
import pytest
from ibrobot_policy_servers import ibrobot_policies
from ibrobot_policy_servers.options import ActionMap, ObservationMap, VlaEvalOptions
from ibrobot_policy_servers.served import ServedPolicy
from ibrobot_policy_servers.vla_eval import VlaEvalConnection
from ibrobot_policy_wire import pack_named, unpack_named
from ibrobot_testing import PolicySuite, check_descriptor, host_context
from ibrobot_testing.contexts import ARM, GRIPPER
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from ibrobot_core.api import Context, Policy, PolicyError

from .served_requests import CAMERA, IMAGE, POSITIONS, SIZE, STATE, Damage, chunk, refused

OPTIONS = VlaEvalOptions(
    observations=(
        ObservationMap(STATE, ("states",), (SIZE,)),
        ObservationMap(CAMERA, ("images", "agentview"), IMAGE),
    ),
    actions=(ActionMap(ARM + GRIPPER),),
    horizon=1,
    rate_hz=10.0,
    timeout=30.0,
    start_timeout=30.0,
)


class Server:
    """Answers each observation with its state; `changed` may change an answer."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []
        self.changed: Callable[[dict[str, Any]], Any] = lambda answer: answer

    def __enter__(self) -> Self:
        self._server = serve(self._handle, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=0.1)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._server.shutdown()
        self._thread.join()

    def _handle(self, connection: ServerConnection) -> None:
        try:
            for data in connection:
                assert isinstance(data, bytes)
                message = unpack_named(data)
                self.messages.append(message)
                answer = {"seq": message["seq"], "timestamp": 0.0}
                if message["type"] == "hello":
                    answer |= {"type": "hello", "payload": {"protocol_version": 1, "model_server": "Test"}}
                elif message["type"] == "observation":
                    answer |= {"type": "action", "payload": {"actions": message["payload"]["states"]}}
                else:
                    continue
                sent = self.changed(answer)
                connection.send(sent if isinstance(sent, bytes | str) else pack_named(sent))
        except ConnectionClosed:
            pass


def make(options: VlaEvalOptions, ctx: Context | None = None) -> ServedPolicy:
    return ServedPolicy(options, ctx or host_context(), VlaEvalConnection(options), stateful=True)


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as server:
        yield server


@pytest.fixture
def policy(server: Server) -> Iterator[ServedPolicy]:
    policy = make(attrs.evolve(OPTIONS, url=server.url))
    policy.load()
    yield policy
    policy.close()


class TestVlaEval(PolicySuite):
    ignores = frozenset({"observation.images.top"})  # the server of the tests computes with the state

    @pytest.fixture(autouse=True)
    def server(self, no_leaks: None) -> Iterator[None]:
        with Server() as server:
            self.options = attrs.evolve(OPTIONS, url=server.url)
            yield

    @override
    def make(self, ctx: Context) -> Policy:
        return make(self.options, ctx)


def test_descriptor_is_right() -> None:
    [descriptor] = [each for each in ibrobot_policies() if each.type == "vla_eval"]
    check_descriptor(descriptor, OPTIONS)


def test_messages_are_those_of_version_1(policy: ServedPolicy, server: Server) -> None:
    policy.reset(4)
    np.testing.assert_allclose(chunk(policy), [POSITIONS], atol=1e-6)
    kinds = [each["type"] for each in server.messages]
    assert kinds == ["hello", "episode_start", "observation", "episode_end", "episode_start", "observation"]
    assert [each["seq"] for each in server.messages] == list(range(1, 7))
    assert server.messages[0]["payload"]["protocol_version"] == 1
    payload = server.messages[-1]["payload"]
    assert payload["task_description"] == "pick up the cube"
    assert payload["images"]["agentview"].shape == IMAGE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seq": 99}, "expected 'action'"),
        ({"type": "hello"}, "with 'hello' to message"),
        (
            {"type": "error", "payload": {"error": "observation_failed: KeyError"}},
            "error: observation_failed: KeyError",
        ),
        ({"payload": 3}, "without a payload"),
        ({"payload": {"actions": np.zeros(5)}}, r"shape \(1, 5\), the robot YAML states \(1, 6\)"),
        ({"payload": {"actions": np.full(SIZE, np.nan)}}, "not finite"),
    ],
)
def test_a_wrong_answer_is_an_error_and_the_next_one_is_used(
    policy: ServedPolicy, server: Server, change: dict[str, Any], message: str
) -> None:
    server.changed = lambda answer: answer | (change if answer["type"] == "action" else {})
    with pytest.raises(PolicyError, match=message):
        chunk(policy)
    server.changed = lambda answer: answer
    assert chunk(policy).shape == (1, SIZE)


@pytest.mark.parametrize(
    ("hello", "message"),
    [
        (
            {"type": "hello", "seq": 1, "payload": {"protocol_version": 2}},
            "version 2 of the protocol, the robot version 1",
        ),
        (b"\xc1", "cannot be read"),
        ("hello", "sent text, must be binary"),
    ],
)
def test_another_protocol_is_an_error(server: Server, hello: Any, message: str) -> None:
    server.changed = lambda answer: hello
    policy = make(attrs.evolve(OPTIONS, url=server.url))
    with pytest.raises(PolicyError, match=message):
        policy.load()
    policy.close()


def test_damaged_answers_are_errors_and_the_next_answer_is_right(policy: ServedPolicy, server: Server) -> None:
    """1,000 answers with flipped or cut bytes: each is refused or has the shape, finite, of an answer."""
    damage = Damage()
    server.changed = lambda answer: damage(pack_named(answer)) if answer["type"] == "action" else answer
    assert refused(policy, 1000, horizon=1) > 300
    server.changed = lambda answer: answer
    np.testing.assert_allclose(chunk(policy), [POSITIONS], atol=1e-6)
