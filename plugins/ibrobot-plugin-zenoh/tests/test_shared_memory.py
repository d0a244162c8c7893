"""Large messages through shared memory, as by default between processes of one machine."""

from __future__ import annotations

import os

import pytest

from .pair import WAIT_S, client, free_endpoint, router, settle


@pytest.fixture
def no_leaks() -> None:
    """Zenoh keeps its shared memory open after the last session has ended."""


@pytest.mark.parametrize("size", [10, 100_000, 2_000_000, 30_000_000])
def test_whole_messages_both_ways(size: int):
    payload = os.urandom(1000) * (size // 1000 or 1)
    endpoint = free_endpoint()
    server, robot = router(endpoint, shared_memory=True), client(endpoint, shared_memory=True)
    server.serve("echo", lambda asked, _: asked)
    settle(robot, server)
    assert robot.request("echo", payload, WAIT_S) == payload
    robot.close()
    server.close()
