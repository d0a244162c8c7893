"""A simulation's signals over a Unix socket: from the process that emulates an arm to the one that runs it."""

from __future__ import annotations

import select
import shlex
import socket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import override

import numpy as np

from ibrobot_core.api import Context, Float64MultiArray, Hardware, Sensor, SensorError, Signal
from ibrobot_feetech.options import EmulatedSignalOptions

_LONGEST = 1 << 16


class SignalServer:
    """Sends every value of a signal, as float64, to the clients of its topic. Slow clients miss some values.

    Args:
        path: path of the socket; a stale socket is replaced.
        signals: the available signals.
    """

    def __init__(self, path: Path, signals: Sequence[Signal]) -> None:
        self._path = path
        self._signals = tuple(signals)
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen()
        self._listener.setblocking(False)
        self._clients: dict[socket.socket, str] = {}

    def publish(self, hardware: Hardware) -> None:
        """Send the hardware's present signals."""
        with suppress(BlockingIOError):
            while True:
                client, _ = self._listener.accept()
                client.setblocking(False)
                self._clients[client] = ""
        for index, signal in enumerate(self._signals):
            if not self._clients:
                return
            values = np.empty(signal.size)
            hardware.read_signal(index, values)
            for client in list(self._clients):
                self._send(client, signal.topic, values.tobytes())

    def close(self) -> None:
        """Stop, and remove the socket."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _send(self, client: socket.socket, topic: str, values: bytes) -> None:
        try:
            if not self._clients[client]:
                self._clients[client] = client.recv(_LONGEST).decode() or "?"
            if self._clients[client] == topic:
                client.send(values)
        except BlockingIOError:
            return
        except OSError:
            client.close()
            del self._clients[client]


class EmulatedSignal(Sensor):
    """Publishes a signal of the simulation that moves an emulated arm, under the signal's topic."""

    message_type = Float64MultiArray

    def __init__(self, options: EmulatedSignalOptions, ctx: Context) -> None:
        self.topic = options.signal
        self._path = options.socket
        self._name = ctx.name
        robot, port = shlex.quote(ctx.source or "CONFIG"), shlex.quote(options.socket.removesuffix(".signals"))
        self._remedy = f"start `ibrobot feetech emulate --physics {robot} --link {port}`, which makes it"
        self._socket: socket.socket | None = None

    @override
    def open(self) -> None:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.connect(self._path)
            connection.send(self.topic.encode())
        except OSError as error:
            connection.close()
            raise SensorError(f"{self._name}: {self._path}: {error.strerror}; {self._remedy}") from None
        self._socket = connection

    @override
    def read(self, timeout_s: float) -> Float64MultiArray | None:
        if self._socket is None:
            raise SensorError(f"{self._name}: not open")
        ready, _, _ = select.select((self._socket,), (), (), timeout_s)
        newest = b""
        while ready:
            try:
                received = self._socket.recv(_LONGEST)
            except OSError as error:
                raise SensorError(f"{self._name}: {self._path}: {error.strerror}") from None
            if not received:
                raise SensorError(f"{self._name}: {self._path}: the emulator has ended")
            newest = received
            ready, _, _ = select.select((self._socket,), (), (), 0)
        return Float64MultiArray(np.frombuffer(newest)) if newest else None

    @override
    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
