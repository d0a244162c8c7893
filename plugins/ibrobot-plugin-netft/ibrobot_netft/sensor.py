"""The sensor: a thread receives records and keeps the newest."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from typing import override

from ibrobot_sensor_messages.messages import Wrench, WrenchStamped

from ibrobot_core.api import Context, Header, Sensor, SensorError, Vector3
from ibrobot_netft import NetFtOptions
from ibrobot_netft.protocol import ERROR_BITS, START, STOP, Record, request

_POLL_S = 0.05
"""How often the thread looks whether it shall end [s]."""
_NUMBERS = 1 << 32
"""How many numbers of records there are before they begin again."""
_ASK_S = 0.25
"""How often a silent sensor is asked to stream again [s]: it forgets that when its power was off."""


class NetFt(Sensor):
    """A force-torque sensor that streams records over UDP.

    A message has the time at which its record arrived. Records that come late, twice or damaged are left out, and so
    are those whose status says that the values are wrong.

    Args:
        options: options from the YAML.
        ctx: its name is that of the peripheral.
    """

    message_type = WrenchStamped

    def __init__(self, options: NetFtOptions, ctx: Context) -> None:
        self.topic = f"/force/{ctx.name}/wrench"
        self._options = options
        self._ctx = ctx
        self._frame = options.frame or f"{ctx.name}_frame"
        self._changed = threading.Condition()
        self._newest: WrenchStamped | None = None
        self._error: SensorError | None = None
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._last_ns = 0

    @override
    def open(self) -> None:
        options = self._options
        try:
            ((family, _, _, _, address), *_) = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_DGRAM)
            connection = socket.socket(family, socket.SOCK_DGRAM)
        except OSError as error:
            raise SensorError(f"{self._place}: {error}; check host and the network") from None
        try:
            connection.connect(address)
            connection.settimeout(_POLL_S)
            connection.send(request(START))
        except OSError as error:
            connection.close()
            raise SensorError(f"{self._place}: {error}; check host and the network") from None
        self._ended.clear()
        self._newest = self._error = None
        self._thread = threading.Thread(target=self._run, args=(connection,), name=f"force {self._ctx.name}")
        self._thread.start()

    @override
    def read(self, timeout_s: float) -> WrenchStamped | None:
        if self._thread is None:
            raise SensorError(f"{self._place}: not open")
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._error is not None, timeout_s)
            message, self._newest = self._newest, None
            if message is None and self._error is not None:
                raise self._error
            return message

    @override
    def close(self) -> None:
        thread, self._thread = self._thread, None
        if thread is not None:
            self._ended.set()
            thread.join()

    @property
    def _place(self) -> str:
        return f"force sensor {self._ctx.name} ({self._options.host}:{self._options.port})"

    def _run(self, connection: socket.socket) -> None:
        newest, heard_s = 0, time.monotonic()
        asked_s = heard_s
        with connection:
            while not self._ended.is_set():
                now_s = time.monotonic()
                if now_s - heard_s > self._options.silence:
                    self._fail(f"no record for {self._options.silence:g} s; check its power and its cable")
                    heard_s = now_s
                if now_s - asked_s > _ASK_S and now_s - heard_s > _ASK_S:
                    asked_s, newest = now_s, 0
                    with suppress(OSError):
                        connection.send(request(START))
                try:
                    record = Record.decode(connection.recv(64))
                except (TimeoutError, ConnectionError, SensorError):
                    continue
                except OSError as error:
                    self._fail(f"{error}; check the network")
                    continue
                if not 0 < (record.sequence - newest) % _NUMBERS < _NUMBERS // 2:
                    continue
                newest, heard_s = record.sequence, time.monotonic()
                if record.status & ERROR_BITS:
                    self._fail(f"it reports the error {record.status:#010x}: a gauge is saturated, or it is damaged")
                else:
                    self._keep(record)
            with suppress(OSError):
                connection.send(request(STOP))

    def _keep(self, record: Record) -> None:
        force, torque = self._options.counts_per_force, self._options.counts_per_torque
        x, y, z, around_x, around_y, around_z = record.counts
        wrench = Wrench(
            Vector3(x / force, y / force, z / force), Vector3(around_x / torque, around_y / torque, around_z / torque)
        )
        with self._changed:
            self._last_ns = stamp_ns = max(self._ctx.clock.now_ns(), self._last_ns + 1)
            self._newest, self._error = WrenchStamped(Header(stamp_ns, self._frame), wrench), None
            self._changed.notify_all()

    def _fail(self, reason: str) -> None:
        with self._changed:
            self._newest, self._error = None, SensorError(f"{self._place}: {reason}")
            self._changed.notify_all()
