"""Emulated servos at the end of a line in memory, in a time of its own: late is what is meant to be late, no more."""

from __future__ import annotations

import heapq
import itertools
import time
from types import SimpleNamespace
from typing import Any, ClassVar, override

import pytest
from ibrobot_feetech import bus, follower, sync
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.errors import Place, PortError
from ibrobot_feetech.port import SerialPort

from ibrobot_core.api import seconds

_REQUEST_S = 1e-4
"""What a request takes on its way."""


class Line(Emulator):
    """Carries requests out in the thread that sends them. Time passes while a reader waits, and at each request."""

    now_s: ClassVar[float] = 1000.0
    served: ClassVar[dict[str, Line]] = {}
    _numbers: ClassVar[itertools.count[int]] = itertools.count()

    gone = False
    """Whether its cable is unplugged."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.port = f"line {next(Line._numbers)}"
        self._coming: list[tuple[float, int, bytes]] = []
        self._count = 0

    @classmethod
    def clock_s(cls) -> float:
        """What `time.monotonic` is to a bus: of real ports where there is no line."""
        return cls.now_s if cls.served else time.monotonic()

    @override
    def start(self) -> None:
        self.settle()
        Line.served[self.port] = self

    @override
    def stop(self) -> None:
        del Line.served[self.port]

    @override
    def unplug(self) -> None:
        self.gone = True

    def ask(self, request: bytes) -> None:
        Line.now_s += _REQUEST_S
        for after_s, reply in self._carry_out(request):
            self.push(Line.now_s + after_s, reply)

    def push(self, due_s: float, reply: bytes) -> None:
        heapq.heappush(self._coming, (due_s, self._count, reply))
        self._count += 1

    def take(self, size: int, deadline_s: float) -> bytes:
        """All that is there, once it is `size` bytes or the time is over."""
        received = b""
        while self._coming and (self._coming[0][0] <= Line.now_s or len(received) < size):
            if self._coming[0][0] > max(deadline_s, Line.now_s):
                break
            due_s, _, reply = heapq.heappop(self._coming)
            Line.now_s = max(Line.now_s, due_s)
            received += reply
        if len(received) < size:
            Line.now_s = max(Line.now_s, deadline_s)
        return received

    @override
    def _now_s(self) -> float:
        return Line.now_s if self._clock is None else seconds(self._clock.now_ns())

    @override
    def _host_rate(self) -> int:
        return self._default_rate


class LinePort(SerialPort):
    """The port of a line; of anything else a serial port."""

    _line: Line | None = None

    def _unplugged(self) -> None:
        if self._line is not None and self._line.gone:
            raise PortError(Place(self.path), "the port is gone")

    @property
    @override
    def is_open(self) -> bool:
        return self._line is not None or super().is_open

    @override
    def open(self) -> None:
        self._line = Line.served.get(self.path)
        if self._line is None:
            super().open()

    @override
    def close(self) -> None:
        self._line = None
        super().close()

    @override
    def write(self, request: bytes) -> None:
        self._unplugged()
        if self._line is None:
            super().write(request)
        else:
            self._line.ask(request)

    @override
    def read(self, size: int, deadline: float) -> bytes:
        self._unplugged()
        return super().read(size, deadline) if self._line is None else self._line.take(size, deadline)

    @override
    def exchange(self, request: bytes, size: int, timeout_ms: int) -> bytes:
        self._unplugged()
        if self._line is None:
            return super().exchange(request, size, timeout_ms)
        self._line.ask(request)
        received = self._line.take(size, Line.now_s + timeout_ms / 1e3)
        if len(received) > size:
            self._line.push(0.0, received[size:])
        return received[:size]

    @override
    def discard(self) -> int:
        return super().discard() if self._line is None else len(self._line.take(0, 0.0))


def lay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have every bus made from now on find the lines there are, and live in their time."""
    monkeypatch.setattr(bus, "SerialPort", LinePort)
    for module in (bus, sync, follower):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=Line.clock_s))
