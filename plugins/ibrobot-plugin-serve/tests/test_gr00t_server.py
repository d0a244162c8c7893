"""A model for GR00T's clients, 1.6 and 1.5."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from ibrobot_policy_wire import pack_npy, unpack_npy
from ibrobot_serve.client_model import ClientModel
from ibrobot_serve.gr00t_server import TASK, Gr00tServer
from ibrobot_testing import host_context

from ibrobot_core.api import Frame

from .client_requests import STATE, damaged

ZEROS: dict[str, Any] = {"observation": {"state": {"state": np.zeros((1, 1, 6), np.float32)}}, "options": None}


@pytest.fixture
def server(model: ClientModel) -> Iterator[Gr00tServer]:
    server = Gr00tServer(model, "127.0.0.1", 0)
    yield server
    server.close()


class Client:
    """A REQ socket, as GR00T's clients have."""

    def __init__(self, server: Gr00tServer) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(f"tcp://127.0.0.1:{server.port}")

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._context.term()

    def sent(self, content: bytes) -> Any:
        self._socket.send(content)
        return unpack_npy(self._socket.recv())

    def call(self, endpoint: str, data: Any = None, **more: Any) -> Any:
        return self.sent(pack_npy({"endpoint": endpoint, "data": data, **more}))


@pytest.fixture
def client(server: Gr00tServer) -> Iterator[Client]:
    with Client(server) as client:
        yield client


def test_chunks_are_those_of_the_policy(client: Client, model: ClientModel) -> None:
    state = np.linspace(-0.5, 0.5, 6, dtype=np.float32)
    policy = model.policy
    expected = policy.postprocess(policy.infer(policy.preprocess(Frame(0, {STATE: state}))))
    observation = {"state": {"state": state[None, None]}, "language": {TASK: [["pick up the cube"]]}}
    action, told = client.call("get_action", {"observation": observation, "options": None})
    np.testing.assert_allclose(action["action"], expected[None], atol=1e-6)
    assert told["joints"] == list(host_context().robot.joint_names)
    flat = client.call("get_action", {"state.state": state[None], TASK: ["pick up the cube"]})
    np.testing.assert_allclose(flat["action.action"], expected, atol=1e-6)


def test_the_other_endpoints_answer_as_the_clients_expect(client: Client) -> None:
    assert client.call("ping")["status"] == "ok"
    assert client.call("reset", {"options": None}) == {}
    described = client.call("get_modality_config")
    assert described["state"] == {"delta_indices": [0], "modality_keys": ["state"]}
    assert described["action"]["delta_indices"] == list(range(10))
    assert described["language"]["modality_keys"] == [TASK]
    assert "no endpoint 'kill'" in client.call("kill")["error"]
    assert client.call("ping")["status"] == "ok", "no client ends the server"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "must have data"),
        ({"observation": 3}, "a dictionary of dictionaries"),
        ({"observation": {}}, "'observation.state' is missing, must be numbers (6,)"),
        ({"observation": {"state": {"state": np.zeros((1, 1, 5), np.float32)}}}, "'observation.state' is float32 (5,)"),
        ({"observation": {"state": {"state": np.zeros((2, 1, 6), np.float32)}}}, "one batch and one time step"),
        ({"observation": {"state": {"state": [0.0] * 6}}}, "an array is list"),
        ({"observation": {"state": {"stat": np.zeros((1, 1, 6))}}}, "state.stat unknown; there are state.state"),
        ({"observation": {**ZEROS["observation"], "language": {TASK: [["a"], ["b"]]}}}, "must be one text"),
    ],
)
def test_a_wrong_request_is_answered_by_an_error_and_the_next_one_by_a_chunk(
    client: Client, model: ClientModel, data: Any, message: str
) -> None:
    assert message in client.call("get_action", data)["error"]
    assert client.call("get_action", ZEROS)[0]["action"].shape == (1, 10, 6)
    assert (model.answered, model.failed) == (1, 1)


def test_damaged_requests_harm_no_other(client: Client) -> None:
    answers = map(client.sent, damaged(pack_npy({"endpoint": "get_action", "data": ZEROS})))
    assert sum(isinstance(each, dict) and "error" in each for each in answers) > 500
    assert client.call("get_action", ZEROS)[0]["action"].shape == (1, 10, 6)


def test_an_array_is_never_unpickled(client: Client) -> None:
    pickled = msgpack.packb(
        {
            "endpoint": "get_action",
            "data": {"__ndarray_class__": True, "as_npy": b"\x93NUMPY\x01\x00\x10\x00{'descr': '|O'}  cos\nsystem\n"},
        }
    )
    assert "header" in client.sent(pickled)["error"]


def test_a_huge_message_is_refused_unread(client: Client, server: Gr00tServer) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        # The greeting of ZMTP 3.0 without security, a READY command of a REQ socket, and the header of a frame of 1 GB.
        ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
        connection.sendall(b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48))
        connection.sendall(b"\x04" + bytes([len(ready)]) + ready + b"\x02" + struct.pack(">Q", 1 << 30))
        while connection.recv(1 << 16):
            pass  # the server closes the connection
    assert client.call("ping")["status"] == "ok"


def test_other_protocols_harm_no_client(client: Client, server: Gr00tServer) -> None:
    random = np.random.default_rng(0)
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
    http = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 99\r\n\r\n{}"
    for _ in range(50):
        for content in (http, greeting, b"\x16\x03\x01\x02\x00", random.bytes(2000)):
            with socket.create_connection(("127.0.0.1", server.port)) as connection:
                connection.sendall(content)
    assert client.call("get_action", ZEROS)[0]["action"].shape == (1, 10, 6)
    with Client(server) as later:
        assert later.call("get_action", ZEROS)[0]["action"].shape == (1, 10, 6)


def test_clients_need_the_key(model: ClientModel) -> None:
    server = Gr00tServer(model, "127.0.0.1", 0, "pa55word")
    try:
        with Client(server) as client:
            for wrong in ({}, {"api_token": "password"}, {"api_token": 3}):
                assert "Unauthorized" in client.call("ping", **wrong)["error"]
            assert client.call("get_action", ZEROS, api_token="pa55word")[0]["action"].shape == (1, 10, 6)
    finally:
        server.close()


@pytest.mark.usefixtures("broken")
def test_a_fault_of_the_policy_is_answered_by_an_error(client: Client) -> None:
    assert client.call("get_action", ZEROS)["error"] == "ZeroDivisionError: not today"


def test_an_address_in_use_is_an_error(server: Gr00tServer, model: ClientModel) -> None:
    with pytest.raises(OSError, match="in use"):
        Gr00tServer(model, "127.0.0.1", server.port)
