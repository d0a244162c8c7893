"""Ports for servers of tests."""

from __future__ import annotations

import socket

import pytest
from ibrobot_testing.ports import free_port


def test_a_port_belongs_to_the_test_and_a_server_can_listen_on_it() -> None:
    port = free_port()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", port))
    with socket.create_server(("127.0.0.1", port)), socket.create_connection(("127.0.0.1", port)):
        pass
    assert free_port() != port
