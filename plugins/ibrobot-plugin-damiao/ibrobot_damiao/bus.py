"""Damiao motors on a CAN bus: requests, feedback, and errors that name the motor and what to check."""

from __future__ import annotations

import select
import shlex
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import attrs
import can
from can.interfaces.slcan import slcanBus
from serial import SerialException

from ibrobot_core.api import HardwareError
from ibrobot_damiao.protocol import (
    DEFAULT_BITRATE,
    DISABLE,
    ERRORS,
    FEEDBACK_ID,
    MAX_POSITION,
    MAX_TORQUE,
    MAX_VELOCITY,
    MOTOR_ID,
    OFF,
    REGISTER_ID,
    Feedback,
    MitCommand,
    Ranges,
    Register,
    command,
    refresh,
    save,
)

_ANSWER_S = 0.02
"""How long a request outside the control loop waits for its answer [s]; a motor needs less than 1 ms."""
_TOGETHER_S = 0.05
"""How long the answers of several motors with one id are awaited [s], on a busy machine too."""
_SETTLE_S = 0.1
"""How long an adapter on a serial port is given after it is opened [s]."""
_BUS_OFF = 0x40
"""Bit of the id of an error frame (`linux/can/error.h`, CAN_ERR_BUSOFF)."""
_SERIAL_S = 0.0002
"""How long one read of an slcan port waits for a byte [s]."""
_SOCKET_S = 0.0003
"""How long a frame that has arrived takes to be read from a socket [s], of which pyserial reads one byte at a time."""
_DRAIN = 4096
"""Most frames that are thrown away at once: on a bus that someone floods, emptying the queue would never end."""
_LATE = 64
"""Most frames that are read after the time for an answer is over: the answer may be queued behind those of others."""
_MOST = Ranges(200.0, 1000.0, 1000.0)
"""Widest plausible ranges: a frame has steps of 1/65535 of a position's range, and of 1/4095 of the others."""
_LEAST = 0.1
"""Narrowest plausible range."""


class BusError(HardwareError):
    """The adapter or the whole bus fails."""


class NoAnswer(HardwareError):
    """A motor does not answer."""


class TorqueStaysOn(HardwareError):
    """A motor still reports torque after it was switched off."""


@attrs.frozen
class Channel:
    """How to reach a bus."""

    name: str
    """A network interface, e.g. `can0`; or a serial port, or `socket://HOST:PORT`, of an adapter that speaks slcan."""
    interface: str = ""
    """Interface type of python-can; empty: `slcan` for ports and sockets, else `socketcan`."""
    bitrate: int = DEFAULT_BITRATE
    """[bit/s]; on socketcan `ip link` sets it."""
    data_bitrate: int | None = None
    """Rate of the data in CAN FD frames [bit/s]; None: classic frames."""

    @property
    def kind(self) -> str:
        """Interface type of python-can."""
        return self.interface or ("slcan" if "/" in self.name else "socketcan")

    @property
    def arguments(self) -> str:
        """Arguments of `ibrobot damiao` commands for it, quoted for a shell."""
        more = f" --interface {shlex.quote(self.interface)}" if self.interface else ""
        more += f" --bitrate {self.bitrate}" if self.bitrate != DEFAULT_BITRATE else ""
        more += f" --data-bitrate {self.data_bitrate}" if self.data_bitrate is not None else ""
        return shlex.quote(self.name) + more

    @property
    def remedy(self) -> str:
        """What to check if the bus fails."""
        if self.kind == "socketcan":
            return (
                f"check the adapter's cable, then `sudo ip link set {self.name} up type can bitrate {self.bitrate}"
                f"{f' dbitrate {self.data_bitrate} fd on' if self.data_bitrate else ''} restart-ms 100`"
            )
        return "check the adapter's cable, and that no other program has it open"


@attrs.frozen
class Motor:
    """A motor that was found on the bus."""

    id: int
    feedback_id: int
    ranges: Ranges


class DamiaoBus:
    """A CAN bus with Damiao motors.

    Args:
        channel: how to reach it.
        names: motor id -> joint, for messages.
        retries: retries of requests outside the control loop.
    """

    def __init__(self, channel: Channel, names: Mapping[int, str] | None = None, retries: int = 2) -> None:
        self.channel = channel
        self._names = dict(names or {})
        self.retries = retries
        self._bus: can.BusABC | None = None
        self.motors: dict[int, Motor] = {}
        """Motors that `find` has found, by id."""
        self._strange: dict[int, str] = {}
        """Motor -> why its last feedback cannot be used."""
        self.counters = {"error_frames": 0, "strange_frames": 0}

    @property
    def is_open(self) -> bool:
        """Whether it is open."""
        return self._bus is not None

    def place(self, motor: int | None = None) -> str:
        """The place of an error: channel, motor, joint."""
        joint = self._names.get(motor, "") if motor is not None else ""
        return self.channel.name + ("" if motor is None else f", motor {motor}") + (f" ({joint})" if joint else "")

    def open(self) -> None:
        """Open the adapter.

        Raises:
            BusError: if it cannot be opened; says what to check.
        """
        channel = self.channel
        more: dict[str, Any] = {}
        if channel.kind == "slcan":
            more |= {"sleep_after_open": _SETTLE_S, "timeout": _SERIAL_S}
        if channel.data_bitrate is not None:
            more |= {"fd": True, "data_bitrate": channel.data_bitrate}
        try:
            self._bus = can.Bus(channel.name, interface=channel.kind, bitrate=channel.bitrate, **more)
        except can.CanInterfaceNotImplementedError as error:
            raise BusError(f"{self.place()}: {error}; interface types: {', '.join(can.interfaces.BACKENDS)}") from None
        except (can.CanError, SerialException, OSError, ValueError, TypeError, ImportError, NameError) as error:
            # the latter three: a type that lacks its library, or needs more than a channel
            raise BusError(f"{self.place()}: cannot be opened: {error}; {channel.remedy}") from error

    def close(self) -> None:
        """Release the adapter; changes no torque."""
        bus, self._bus = self._bus, None
        if bus is None:
            return
        with suppress(can.CanError, SerialException, OSError):
            bus.shutdown()
        if isinstance(bus, slcanBus):
            bus.serialPortOrig.close()  # `shutdown` leaves it open if the cable is gone

    def find(self, motor: int) -> Motor:
        """Ask a motor for its feedback id and the ranges of its numbers.

        Raises:
            NoAnswer: if none has this id.
            HardwareError: if two have it, or its ranges are none.
        """
        self._drain()
        self.send(REGISTER_ID, Register(motor, FEEDBACK_ID).encode())
        time.sleep(_TOGETHER_S)  # so that a second motor with this id has answered, too
        answers = [(message, register) for message in self._queued() if (register := self._of(message, motor))]
        for _ in range(self.retries):
            answers = answers or self._answers(Register(motor, FEEDBACK_ID), motor)
        if not answers:
            raise NoAnswer(
                f"{self.place(motor)}: does not answer; check its power, its cable, and with `ibrobot damiao scan "
                f"{self.channel.arguments}` its id"
            )
        if len(answers) > 1:
            raise HardwareError(
                f"{self.place(motor)}: {len(answers)} motors have this id; connect one at a time, and give each an id "
                f"of its own with `ibrobot damiao set-id {self.channel.arguments} {motor} NEW`"
            )
        spans = [self.read(motor, register) for register in (MAX_POSITION, MAX_VELOCITY, MAX_TORQUE)]
        if not all(_LEAST <= span <= most for span, most in zip(spans, attrs.astuple(_MOST), strict=True)):
            most = ", ".join(f"{most:g}" for most in attrs.astuple(_MOST))
            raise HardwareError(
                f"{self.place(motor)}: its registers PMAX, VMAX, TMAX are {', '.join(f'{span:g}' for span in spans)}; "
                f"they must be {_LEAST:g} to {most}: set them with the motor's software"
            )
        made = Motor(motor, answers[0][0].arbitration_id, Ranges(*spans))
        for other in self.motors.values():
            for one, heard in ((made, other), (other, made)):
                if other.id != motor and one.feedback_id == heard.id:
                    raise HardwareError(
                        f"{self.place(heard.id)}: has the feedback id of motor {one.id}, and would take its answers "
                        "for commands; connect it alone, and give it an id below 17 with `ibrobot damiao set-id "
                        f"{self.channel.arguments} {heard.id} NEW`"
                    )
            if other.id != motor and _key(other) == _key(made):
                raise HardwareError(
                    f"{self.place(motor)}: answers like motor {other.id}: both have feedback id "
                    f"{made.feedback_id:#x}; `ibrobot damiao set-id {self.channel.arguments} {motor} {motor}` gives it "
                    f"{motor + 0x10:#x}"
                )
        self.motors[motor] = made
        return made

    def read(self, motor: int, register: int) -> float:
        """The value of a register.

        Raises:
            NoAnswer: if the motor does not answer.
        """
        for _ in range(self.retries + 1):
            if answers := self._answers(Register(motor, register), motor):
                return answers[0][1].value
        raise NoAnswer(f"{self.place(motor)}: does not answer a request for register {register}; check its cable")

    def write(self, motor: int, register: int, value: float) -> None:
        """Set a register until power-off.

        Raises:
            HardwareError: if it did not keep the value.
        """
        self._answers(Register(motor, register, value, write=True), motor)
        if (kept := self.read(motor, register)) != value:
            raise HardwareError(f"{self.place(motor)}: register {register} was set to {value:g} and is {kept:g}")

    def set_id(self, motor: int, new: int) -> None:
        """Give a motor, whose torque is off, another id, and 16 more as feedback id, and make it keep them.

        Raises:
            HardwareError: if it does not answer to the new id.
        """
        self.write(motor, FEEDBACK_ID, new + 0x10)
        self.send(REGISTER_ID, Register(motor, MOTOR_ID, new, write=True).encode())
        if self.read(new, MOTOR_ID) != new:
            raise HardwareError(f"{self.place(motor)}: did not take id {new}; switch its power off and on")
        self.send(REGISTER_ID, save(new))
        self.motors.pop(motor, None)
        self.find(new)

    def ask(self, motor: int, data: bytes | None = None) -> Feedback:
        """Send a frame to a motor, or a request for feedback, and return the feedback.

        Raises:
            NoAnswer: if the motor does not answer.
        """
        for _ in range(self.retries + 1):
            self._drain()
            if data is None:
                self.send(REGISTER_ID, refresh(motor))
            else:
                self.send(motor, data)
            if motor in (replies := self.collect((motor,), time.monotonic() + _ANSWER_S)):
                return replies[motor]
        raise NoAnswer(f"{self.place(motor)}: {self.silence(motor)}")

    def silence(self, motor: int, when: str = "") -> str:
        """What is wrong with a motor without usable feedback, and what to check."""
        if motor in self._strange:
            return f"answers what this driver does not know{when}: {self._strange[motor]}; check the motor's firmware"
        return f"does not answer{when}; check its power and its cable"

    def refresh(self, motors: Collection[int], wait_s: float) -> dict[int, Feedback]:
        """The present feedback of motors, as far as it comes within `wait_s` [s] after the last was asked.

        Raises:
            BusError: if the adapter fails or is bus-off.
        """
        self._drain()
        for motor in motors:
            self.send(REGISTER_ID, refresh(motor))
        return self.collect(motors, time.monotonic() + wait_s)

    def collect(self, motors: Collection[int], until_s: float) -> dict[int, Feedback]:
        """Wait for feedback of motors, up to `until_s` of `time.monotonic`."""
        owners = {_key(self.motors[motor]): motor for motor in motors}
        replies: dict[int, Feedback] = {}
        for motor in motors:
            self._strange.pop(motor, None)
        for message in self._until(until_s):
            if not message.data or (owner := owners.get((message.arbitration_id, message.data[0] & 0xF))) is None:
                self.counters["strange_frames"] += 1
                continue
            try:
                replies[owner] = Feedback.decode(bytes(message.data), self.motors[owner].ranges)
            except HardwareError as error:
                self.counters["strange_frames"] += 1
                self._strange[owner] = str(error)
            if len(replies) == len(owners):
                break
        return replies

    def command(self, motor: int, mit: MitCommand) -> None:
        """Send a command in MIT mode, without waiting for the feedback."""
        self.send(motor, mit.encode(self.motors[motor].ranges))

    def switch_off(self, motors: Sequence[int]) -> None:
        """Switch the torque of motors off, and confirm it.

        Each gets the command before the first has to confirm it.

        Raises:
            TorqueStaysOn: if a motor still reports torque.
            NoAnswer: if one does not confirm it.
            BusError: if the bus fails; the others have got the command as far as it takes frames.
        """
        for motor in motors:
            with suppress(BusError):  # a full queue keeps no other motor's torque on; the second command reports it
                self.send(motor, command(DISABLE))
        trouble: list[HardwareError] = []
        for motor in motors:
            try:
                state = self.ask(motor, command(DISABLE)).state
            except HardwareError as error:
                trouble.append(error)
                continue
            if state != OFF and state not in ERRORS:
                stays = f"{self.place(motor)}: its torque stays on; cut its power before you touch the arm"
                trouble.insert(0, TorqueStaysOn(stays))
        if trouble:
            raise trouble[0]

    def send(self, arbitration_id: int, data: bytes) -> None:
        """Send a frame.

        Raises:
            BusError: if the adapter does not take it.
        """
        fd = self.channel.data_bitrate is not None
        message = can.Message(
            arbitration_id=arbitration_id, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd
        )
        try:
            self._opened().send(message)
        except (can.CanError, SerialException, OSError) as error:
            raise BusError(f"{self.place()}: does not take a frame: {error}; {self.channel.remedy}") from error

    def _answers(self, request: Register, motor: int) -> list[tuple[can.Message, Register]]:
        """The answers to a request for a register, which stop at the first."""
        self._drain()
        self.send(REGISTER_ID, request.encode())
        for message in self._until(time.monotonic() + _ANSWER_S):
            register = self._of(message, motor)
            if register is not None and register.register == request.register:
                return [(message, register)]
        return []

    def _of(self, message: can.Message, motor: int) -> Register | None:
        """The register that a motor has answered with."""
        register = Register.decode(bytes(message.data)) if message.arbitration_id != REGISTER_ID else None
        return register if register is not None and register.motor == motor else None

    def _until(self, until_s: float) -> Iterator[can.Message]:
        """Frames up to a time of `time.monotonic`, and the first of those that are queued then."""
        late = 0
        while late < _LATE and (message := self._receive(max(0.0, until_s - time.monotonic()))) is not None:
            late += time.monotonic() > until_s
            yield message

    def _queued(self) -> list[can.Message]:
        """What has arrived already."""
        messages: list[can.Message] = []
        timeout_s = _SOCKET_S if "://" in self.channel.name else 0.0
        for _ in range(_DRAIN):
            arrived = self._has_arrived()
            if arrived is False:
                break
            if (message := self._receive(timeout_s)) is not None:
                messages.append(message)
            elif arrived is None:
                break
        return messages

    def _has_arrived(self) -> bool | None:
        """Whether at least a part of a frame can be read now; None if only a read can tell."""
        try:
            return bool(select.select([self._opened()], [], [], 0)[0])
        except (NotImplementedError, ValueError, OSError, can.CanError):  # no file descriptor, or one that is gone
            return None

    def _drain(self) -> None:
        """Throw away what came unasked, e.g. the feedback to commands."""
        self._queued()

    def _receive(self, timeout_s: float) -> can.Message | None:
        """The next frame; None if none comes in time.

        Raises:
            BusError: if the adapter fails, or the bus is off.
        """
        until_s = time.monotonic() + timeout_s
        for _ in range(_DRAIN):
            try:
                message = self._opened().recv(max(0.0, until_s - time.monotonic()))
            except (can.CanError, SerialException, OSError) as error:
                bus = self._opened()
                if not (isinstance(bus, slcanBus) and isinstance(error.__cause__, UnicodeError)):
                    raise BusError(f"{self.place()}: has failed: {error}; {self.channel.remedy}") from error
                bus._buffer.clear()  # a damaged line that is no text, which python-can would read again and again
                self.counters["strange_frames"] += 1
                continue
            except (ValueError, IndexError):  # another damaged line of a serial adapter
                self.counters["strange_frames"] += 1
                continue
            if message is None or not message.is_error_frame:
                return message
            self.counters["error_frames"] += 1
            if message.arbitration_id & _BUS_OFF:
                raise BusError(
                    f"{self.place()}: bus-off: the adapter has left the bus after too many errors; check that both "
                    f"ends have their 120 ohm, and the bit rates; {self.channel.remedy}"
                )
        return None

    def _opened(self) -> can.BusABC:
        if self._bus is None:
            raise BusError(f"{self.place()}: is not open")
        return self._bus


def _key(motor: Motor) -> tuple[int, int]:
    """What feedback of this motor has: its feedback id, and four bits of its id."""
    return motor.feedback_id, motor.id & 0xF
