"""`ibrobot damiao emulate`: an slcan adapter with emulated motors, on a socket."""

from __future__ import annotations

import socket
import socketserver
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Self, override

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo, go_real_time, on_signals
from ibrobot_damiao.emulator.motors import EmulatedMotor, EmulatedMotors, Frame

_PRIORITY = 70
"""Real-time priority, above that of a control process, which waits for the motors."""
_LONGEST = 64
"""Longest line of the adapter's protocol [bytes]."""


def lines(pending: bytearray) -> Iterator[str]:
    """Take complete lines out of what has arrived; bytes that are no line of slcan are skipped."""
    while (end := pending.find(b"\r")) >= 0:
        line = bytes(pending[:end])
        del pending[: end + 1]
        yield line.decode("ascii", errors="replace")
    if len(pending) > _LONGEST:
        pending.clear()


def frame_of(line: str) -> Frame | None:
    """The classic data frame with a standard id in a line of slcan (`tIIILDD…`), None if it is something else."""
    if line[:1] not in ("t", "d", "b"):
        return None
    try:
        arbitration_id, size = int(line[1:4], 16), int(line[4:5], 16)
        data = bytes.fromhex(line[5 : 5 + 2 * size])
    except ValueError:
        return None
    return (arbitration_id, data) if len(data) == size <= 8 and arbitration_id <= 0x7FF else None


def line_of(frame: Frame) -> bytes:
    """The line of slcan with a frame."""
    arbitration_id, data = frame
    return f"t{arbitration_id:03X}{len(data)}{data.hex().upper()}\r".encode()


class SlcanServer(socketserver.ThreadingTCPServer):
    """An slcan adapter on a loopback port, with emulated motors on its bus; a context manager.

    Args:
        motors: the motors.
        port: TCP port; 0 for a free one.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, motors: EmulatedMotors, port: int = 0) -> None:
        self.motors = motors
        self._connections: set[socketserver.StreamRequestHandler] = set()
        super().__init__(("127.0.0.1", port), _Adapter)

    @property
    def channel(self) -> str:
        """What python-can's slcan opens."""
        return f"socket://127.0.0.1:{self.server_address[1]}"

    @override
    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self.serve_forever, args=(0.05,), name="emulated CAN", daemon=True)
        self._thread.start()
        return self

    @override
    def __exit__(self, *error: object) -> None:
        self.unplug()
        self.shutdown()
        self._thread.join()
        self.server_close()

    @override
    def service_actions(self) -> None:
        """Let the motors turn while nobody asks them anything; making up for it would delay the next answer."""
        self.motors.settle()

    def unplug(self) -> None:
        """Close the connections, as when a USB cable is pulled."""
        for adapter in list(self._connections):
            with suppress(OSError):
                adapter.connection.shutdown(socket.SHUT_WR)


class _Adapter(socketserver.StreamRequestHandler):
    disable_nagle_algorithm = True
    server: SlcanServer

    @override
    def handle(self) -> None:
        self.server._connections.add(self)
        pending = bytearray()
        is_open = False
        try:
            while received := self.connection.recv(4096):
                pending += received
                out = b""
                for line in lines(pending):
                    if line[:1] in ("O", "L", "C"):
                        is_open = line[0] != "C"
                    elif is_open and (frame := frame_of(line)) is not None:
                        out += b"".join(line_of(answer) for answer in self.server.motors.receive(*frame))
                if out:
                    self.connection.sendall(out)
        except OSError:
            return  # the program is gone, or the cable was pulled
        finally:
            self.server._connections.discard(self)


@attrs.frozen(kw_only=True)
class Emulate:
    """Emulate an slcan adapter with Damiao motors on its bus.

    The first line of the output is the CHANNEL for the robot YAML and other commands. Ctrl-C ends it.
    """

    motors: int = option(7, ge=1, le=126, help="how many motors, ids from 1")
    port: int = option(0, ge=0, le=65535, help="TCP port on the loopback interface; by default a free one")
    silent: tuple[int, ...] = option((), typed="--silent ID", help="a motor that does not answer")
    blocked: tuple[int, ...] = option((), typed="--blocked ID", help="a motor whose joint does not move")
    hot: tuple[int, ...] = option((), typed="--hot ID", help="a motor at 100 deg C")
    load: float = option(0.0, unit="Nm", help="torque of each joint's load, e.g. its weight")

    def __call__(self) -> None:
        """Serve until a signal."""
        made = [EmulatedMotor(motor, load=self.load) for motor in range(1, self.motors + 1)]
        for motor in made:
            motor.silent, motor.blocked = motor.id in self.silent, motor.id in self.blocked
            motor.coil = 100.0 if motor.id in self.hot else motor.coil
        for name in ("silent", "blocked", "hot"):
            for motor_id in getattr(self, name):
                if not 1 <= motor_id <= self.motors:
                    raise RequestError(f"--{name}: no motor {motor_id}; ids are 1 to {self.motors}")
        ended = threading.Event()
        on_signals(ended.set)
        try:
            server = SlcanServer(EmulatedMotors(made), self.port)
        except OSError as error:
            raise RequestError(f"--port {self.port}: {error}; choose another, or leave it out") from None
        with server:
            for refused in go_real_time(_PRIORITY):
                echo(refused, err=True)
            echo(server.channel)
            echo(f"{counted(self.motors, 'motor')}; Ctrl-C ends it", err=True)
            ended.wait()
