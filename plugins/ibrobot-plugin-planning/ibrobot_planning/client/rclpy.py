"""The functions of rclpy that scripts for pymoveit2 call. Nothing has to be spun here: a `Node` works by itself."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from types import SimpleNamespace

from ibrobot_planning.client.node import BaseNode, Node

__all__ = [
    "MultiThreadedExecutor", "Node", "ReentrantCallbackGroup", "SingleThreadedExecutor", "callback_groups",
    "create_node", "executors", "init", "node", "ok", "shutdown", "spin", "spin_once",
]  # fmt: skip

_running = threading.Event()
_running.set()


class ReentrantCallbackGroup:
    """Has no effect: calls need no callbacks."""


class SingleThreadedExecutor:
    """Executes nothing: `spin` waits for `shutdown`."""

    def __init__(self, num_threads: int | None = None) -> None:
        self._ended = threading.Event()

    def add_node(self, node: BaseNode) -> None:
        """Do nothing."""

    def spin(self) -> None:
        """Wait until `shutdown`."""
        while _running.is_set() and not self._ended.wait(0.05):
            pass

    def shutdown(self) -> None:
        """End `spin`."""
        self._ended.set()


MultiThreadedExecutor = SingleThreadedExecutor
executors = SimpleNamespace(MultiThreadedExecutor=MultiThreadedExecutor, SingleThreadedExecutor=SingleThreadedExecutor)
callback_groups = SimpleNamespace(ReentrantCallbackGroup=ReentrantCallbackGroup)
node = SimpleNamespace(Node=Node)


def init(args: Sequence[str] | None = None) -> None:
    """Begin."""
    _running.set()


def shutdown() -> None:
    """End `spin` of all executors, and `ok`."""
    _running.clear()


def ok() -> bool:
    """Whether `shutdown` was not called yet."""
    return _running.is_set()


def create_node(name: str) -> Node:
    """A node that connects to a robot on this machine."""
    return Node(name)


def spin(spun: BaseNode) -> None:
    """Wait until `shutdown`."""
    SingleThreadedExecutor().spin()


def spin_once(spun: BaseNode, *, timeout_sec: float = 0.02) -> None:
    """Let time pass."""
    spun.wait(timeout_sec)
