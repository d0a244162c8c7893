"""Connections to a running robot: over its transport, or within the process."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self, override

import attrs
from ibrobot_ros2.services import Answer, Call, decode_answer, decode_call, encode_answer, encode_call, endpoint

from ibrobot_core.api import Context, IbrobotError, PlanningError, RealClock, Robot, Transport, TransportDescriptor
from ibrobot_core.app import Runtime, installed_plugins, single_options

_DEFAULT = "connect=[tcp/127.0.0.1:7447]"
_TIMEOUT_S = 60.0
"""Longest time for an answer; plans take at most `planning_time`."""
_CONNECT_S = 5.0
_AGAIN_S = 0.1
_POLL_S = 0.02


class BaseNode(ABC):
    """A connection to a robot. Use it as a context manager, or call `destroy_node` at the end."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._logger = logging.getLogger(name)

    @abstractmethod
    def call(self, service: str, request: Any = None) -> Any:
        """Call a service; request and answer are plain data: None, text, numbers, lists and mappings.

        Raises:
            PlanningError: with the robot's reason if it refuses the request.
            TransportError: if the robot does not answer.
        """

    @abstractmethod
    def wait(self, duration_s: float) -> None:
        """Let time pass [s]."""

    def get_name(self) -> str:
        """The name of this node."""
        return self._name

    def get_logger(self) -> logging.Logger:
        """The logger of this node."""
        return self._logger

    def create_rate(self, frequency: float) -> Rate:
        """An object whose `sleep` waits for one period of a frequency [Hz]."""
        return Rate(self, frequency)

    def destroy_node(self) -> None:
        """End the connection. Safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.destroy_node()


@attrs.frozen
class Rate:
    """A frequency to wait at."""

    node: BaseNode
    frequency: float
    """[Hz]."""

    def sleep(self) -> None:
        """Wait for one period."""
        self.node.wait(1.0 / self.frequency)


class Node(BaseNode):
    """A connection to a robot over the network.

    The robot's YAML needs a transport that shares its services: `transport.share.services`.

    Args:
        name: name of the script.
        options: the transport's options, e.g. `connect=[tcp/192.168.1.5:7447]`; by default a robot on this machine.
        namespace: the robot's namespace, e.g. `arm1`.
        transport: type of the transport; by default the installed one.

    Raises:
        PluginError: if no transport is installed.
        ConfigError: for wrong options.
        TransportError: if no robot answers.
    """

    def __init__(self, name: str, *options: str, namespace: str = "", transport: str = "") -> None:
        super().__init__(name)
        registry = installed_plugins()
        descriptor = registry.find("transport", transport or registry.default("transport"))
        assert isinstance(descriptor, TransportDescriptor)
        parsed = single_options(descriptor.options, options or (_DEFAULT,), "transport", "options of Node:")
        log = logging.getLogger(f"ibrobot.{name}")
        self._transport: Transport = descriptor.make(parsed, Context(name, RealClock(), log, Robot(name, ())))
        self._endpoint = endpoint(namespace)
        self._await_robot()

    def _await_robot(self) -> None:
        """Wait until the robot answers: connecting takes a moment."""
        deadline = time.monotonic() + _CONNECT_S
        while True:
            try:
                self.call("/rosapi/services")
            except IbrobotError:
                if time.monotonic() > deadline:
                    self.destroy_node()
                    raise
                time.sleep(_AGAIN_S)
            else:
                return

    @override
    def call(self, service: str, request: Any = None) -> Any:
        return _values(self._transport.request(self._endpoint, encode_call(Call(service, request)), _TIMEOUT_S))

    @override
    def wait(self, duration_s: float) -> None:
        time.sleep(duration_s)

    @override
    def destroy_node(self) -> None:
        self._transport.close()


class LocalNode(BaseNode):
    """A connection to a run in this process, e.g. in lockstep: waiting steps the run.

    Args:
        runtime: a started run.
        name: name of the script.
        on_step: called after each step.
    """

    def __init__(self, runtime: Runtime, name: str = "script", on_step: Callable[[], None] = lambda: None) -> None:
        super().__init__(name)
        self._runtime = runtime
        self._on_step = on_step

    @override
    def call(self, service: str, request: Any = None) -> Any:
        # Encoded as for a network, so that a script behaves the same.
        call = decode_call(encode_call(Call(service, request)))
        try:
            answer = Answer(self._runtime.session.bus.call(call.service, call.request))
        except IbrobotError as error:
            answer = Answer(str(error), result=False)
        return _values(encode_answer(answer))

    @override
    def wait(self, duration_s: float) -> None:
        session = self._runtime.session
        if not session.request.lockstep:
            time.sleep(duration_s)
            return
        for _ in range(max(1, round(duration_s * session.config.control.rate_hz))):
            self._runtime.step()
            self._on_step()


def _values(payload: Any) -> Any:
    answer = decode_answer(payload)
    if not answer.result:
        raise PlanningError(str(answer.values))
    return answer.values
