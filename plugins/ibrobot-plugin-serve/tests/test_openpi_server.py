"""A model for openpi's clients."""

from __future__ import annotations

import urllib.request
from collections.abc import Iterator
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_policy_wire import pack, unpack
from ibrobot_serve.client_model import ClientModel
from ibrobot_serve.command import _host_and_port
from ibrobot_serve.openpi_server import OpenpiServer
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ibrobot_core.api import Frame, PolicyError
from ibrobot_core.app import RequestError

from .client_requests import STATE, damaged


@pytest.fixture
def server(model: ClientModel) -> Iterator[OpenpiServer]:
    server = OpenpiServer(model, "127.0.0.1", 0)
    yield server
    server.close()


def asked(server: OpenpiServer, *messages: Any, key: str = "") -> list[Any]:
    """What a client gets: the metadata, and an answer to each message."""
    headers = {"Authorization": f"Api-Key {key}"} if key else {}
    with connect(f"ws://127.0.0.1:{server.port}", compression=None, additional_headers=headers) as client:
        answers: list[Any] = [client.recv()]
        for message in messages:
            client.send(message if isinstance(message, bytes | str) else pack(message))
            answers.append(client.recv())
    return [unpack(each) if isinstance(each, bytes) else each for each in answers]


def test_chunks_are_those_of_the_policy(server: OpenpiServer, model: ClientModel) -> None:
    state = np.linspace(-0.5, 0.5, 6, dtype=np.float32)
    metadata, answer = asked(server, {STATE: state, "prompt": "pick up the cube"})
    assert metadata["model"] == "net"
    assert metadata["horizon"] == 10
    assert metadata["observations"] == {STATE: [6]}
    assert metadata["actions"] == list(host_context().robot.joint_names)
    policy = model.policy
    expected = policy.postprocess(policy.infer(policy.preprocess(Frame(0, {STATE: state}))))
    np.testing.assert_allclose(answer["actions"], expected, atol=1e-6)
    assert answer["server_timing"]["infer_ms"] > 0


@pytest.mark.parametrize("rate", [None, 30.0])
@pytest.mark.parametrize("actions", [None, (), host_context().robot.joint_names])
def test_what_a_model_does_not_know_is_not_stated_but_said_at_the_start(
    caplog: pytest.LogCaptureFixture, actions: tuple[str, ...] | None, rate: float | None
) -> None:
    """A folder without the dataset's note has neither joints nor a rate, and an empty list says that it moves none."""
    policy = FakePolicy(host_context())
    policy.load()
    policy.spec = attrs.evolve(policy.spec, actions=actions, rate_hz=rate)
    with caplog.at_level("WARNING", "ibrobot.serve"):
        server = OpenpiServer(ClientModel(policy, "net", "openpi"), "127.0.0.1", 0)
    try:
        (metadata,) = asked(server)
    finally:
        server.close()
    known = {key: each for key, each in (("actions", list(actions or ())), ("rate_hz", rate)) if each}
    assert {key: metadata[key] for key in ("actions", "rate_hz") if key in metadata} == known
    assert metadata["action_size"] == 6
    lacking = " and ".join(word for key, word in (("actions", "joints"), ("rate_hz", "rate")) if key not in known)
    said = f"model 'net' does not state the {lacking} of its actions: clients get only their size, "
    assert [record.getMessage() for record in caplog.records] == ([f"{said}6 numbers"] if lacking else [])


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({}, "'observation.state' is missing, must be numbers (6,)"),
        ({STATE: np.zeros(5, np.float32)}, "'observation.state' is float32 (5,)"),
        ({STATE: [0.0] * 6}, "'observation.state' is missing"),
        ({STATE: np.zeros(6), "observation.stat": np.zeros(6)}, "'observation.stat' is unknown"),
        ({STATE: np.zeros(6), "prompt": 3}, "the prompt must be text"),
        (b"\xc1", "cannot be read"),
        (b"\x01", "must be a dictionary, got int"),
        ("text", "must be binary"),
    ],
)
def test_a_wrong_request_is_answered_by_a_text_and_the_next_one_by_a_chunk(
    server: OpenpiServer, model: ClientModel, request_: Any, message: str
) -> None:
    _, refused, answer = asked(server, request_, {STATE: np.zeros(6)})
    assert message in refused
    assert answer["actions"].shape == (10, 6)
    assert (model.answered, model.failed) == (1, 1)


def test_damaged_requests_harm_no_other(server: OpenpiServer) -> None:
    requests = damaged(pack({STATE: np.zeros(6, np.float32), "prompt": "pick"}))
    _, *answers, last = asked(server, *requests, {STATE: np.zeros(6)})
    assert sum(isinstance(each, str) for each in answers) > 500
    assert last["actions"].shape == (10, 6)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("stage", ["request", "preprocess", "infer", "postprocess"])
def test_numbers_that_are_not_finite_are_errors_of_their_stage(
    server: OpenpiServer, model: ClientModel, monkeypatch: pytest.MonkeyPatch, stage: str, value: float
) -> None:
    def spoiled(result: Any) -> Any:
        if isinstance(result, dict):
            return {name: spoiled(array) for name, array in result.items()}
        return np.where(np.arange(result.size).reshape(result.shape) == 1, value, result)

    state = np.zeros(6)
    if stage == "request":
        state[2] = value
    else:
        step = getattr(model.policy, stage)
        monkeypatch.setattr(model.policy, stage, lambda *arguments: spoiled(step(*arguments)))
    answer = asked(server, {STATE: state})[1]
    assert answer.startswith("the request: " if stage == "request" else f"the policy's {stage}: ")
    assert answer.endswith(f"is {value}, must be finite")
    assert (model.answered, model.failed) == (0, 1)


@pytest.mark.usefixtures("broken")
def test_a_fault_of_the_policy_is_answered_by_a_text(server: OpenpiServer) -> None:
    assert asked(server, {STATE: np.zeros(6)})[1] == "ZeroDivisionError: not today"


def test_clients_need_the_key(model: ClientModel) -> None:
    server = OpenpiServer(model, "127.0.0.1", 0, "pa55word")
    try:
        for wrong in ("", "password"):
            with pytest.raises(InvalidStatus, match="401"):
                asked(server, key=wrong)
        assert asked(server, {STATE: np.zeros(6)}, key="pa55word")[1]["actions"].shape == (10, 6)
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/healthz") as answer:
            assert answer.read() == b"OK\n"
    finally:
        server.close()


def test_a_policy_that_needs_earlier_observations_is_refused(model: ClientModel) -> None:
    model.policy.spec = attrs.evolve(model.policy.spec, history=2)
    with pytest.raises(PolicyError, match="uses earlier observations, which do not fit into requests of openpi"):
        ClientModel(model.policy, "net", "openpi")


def test_the_address_is_checked() -> None:
    assert _host_and_port((), None) == ("127.0.0.1", 8000)
    assert _host_and_port(("0.0.0.0:9000",), "key") == ("0.0.0.0", 9000)
    with pytest.raises(RequestError, match="set IBROBOT_API_KEY"):
        _host_and_port(("0.0.0.0:9000",), None)
    for wrong in (("8000",), ("127.0.0.1:x",), ("127.0.0.1:70000",), ("127.0.0.1:1", "127.0.0.1:2")):
        with pytest.raises(RequestError, match="must be one HOST:PORT"):
            _host_and_port(wrong, None)
