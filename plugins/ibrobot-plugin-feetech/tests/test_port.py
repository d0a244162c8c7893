"""A serial port that takes no bytes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator

import pytest
from ibrobot_feetech.errors import PortError
from ibrobot_feetech.port import SerialPort

PATIENCE_S = 30.0
REQUEST = bytes(100)
MORE_THAN_IT_HOLDS = 5000
"""Requests of `REQUEST`, far beyond what a terminal keeps for a reader."""


@pytest.fixture
def unread() -> Iterator[tuple[SerialPort, int]]:
    """An open port whose other end nobody reads, and that end."""
    far, near = os.openpty()
    port = SerialPort(os.ttyname(near), 1_000_000)
    port.open()
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


def until_refused(act: Callable[[], object]) -> list[str]:
    """Repeat it in a thread, where it may hang; the errors."""
    refused: list[str] = []

    def write() -> None:
        try:
            for _ in range(MORE_THAN_IT_HOLDS):
                act()
        except PortError as error:
            refused.append(str(error))

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive(), "the write hangs"
    return refused


def test_a_write_that_the_port_does_not_take_fails_and_names_the_port(unread):
    port, _ = unread

    [error] = until_refused(lambda: port.write(REQUEST))
    assert error.startswith(f"{port.path}: the port takes no bytes: a request was not sent within 0.05 s")


def test_so_does_an_exchange(unread):
    port, _ = unread

    assert "takes no bytes" in until_refused(lambda: port.exchange(REQUEST, 8, 0))[0]


def test_a_port_that_takes_bytes_again_is_written_to_again(unread):
    port, far = unread
    until_refused(lambda: port.write(REQUEST))
    os.set_blocking(far, False)
    while True:
        try:
            os.read(far, 65536)
        except BlockingIOError:
            break
    port.write(b"hello")
    os.set_blocking(far, True)

    assert os.read(far, 100).endswith(b"hello")
